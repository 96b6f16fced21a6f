"""Stage ``scene`` from artefact to artefact."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.config import SceneSettings
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.output.export.motion import z_up_frame
from intercap_core.scene import camera_verdicts
from intercap_core.schemas import SCENE
from intercap_core.stages import scene
from tests.helpers.synthetic_capture import (
    FURNITURE,
    extrinsics_error,
    perturbed,
    ring,
    room_depth,
    to_millimetres,
    write_frames,
)
from tests.helpers.synthetic_people import seen_by, walking, write_detections

TRUTH, UP = ring()
MIDDLE = apply(invert(UP), np.array([[0, 0, 0.8]]))[0]
T = 6


def run(paths: dict[str, Path], **changes) -> None:
    scene.run(**paths, **({"settings": SceneSettings(), "floor": None} | changes))


@cache
def depth_images() -> list[np.ndarray]:
    """Noisy depth images (T, H, W) of each camera; tests only read them."""
    rng = np.random.default_rng(0)
    clean = [room_depth(camera, UP, FURNITURE) for camera in TRUTH]
    return [np.stack([to_millimetres(depth, rng) for _ in range(T)]) for depth in clean]


def capture(tmp_path: Path, rig: Rig, depths: list[np.ndarray] | None = None) -> dict[str, Path]:
    body = seen_by(walking(T, np.array([-0.3, -0.2]), np.array([0.1, 0.08]), 0.1), TRUTH, UP)
    body[..., :2] += np.random.default_rng(2).normal(0, 3, body[..., :2].shape)
    people = [[[body[t, c]] for c in range(len(TRUTH))] for t in range(T)]
    return {
        "frames": write_frames(tmp_path / "frames.h5", rig, num_sets=T, depths=depths),
        "detections": write_detections(tmp_path / "detections.h5", TRUTH, people),
        "output": tmp_path / "scene.h5",
    }


def test_cameras_floor_and_background_of_a_furnished_room(tmp_path):
    start = perturbed(TRUTH, np.random.default_rng(0), 0.01, 0.3)
    paths = capture(tmp_path, start, depth_images())
    run(paths)
    rig = Rig.from_scene(paths["output"])
    assert extrinsics_error(rig, TRUTH, MIDDLE)[1:].mean() < 0.006
    with artefacts.read(paths["output"], SCENE) as found:
        attributes = found.attributes
        assert attributes["extrinsics_refined"] and attributes["ground_found"]
        assert attributes["ground_source"] == "fitted" and attributes["ground_rms"] < 0.005
        assert (found["pair_residual_after"] < found["pair_residual_before"]).all()
        height = apply(UP, found["ground_point"][None])[0, 2]
        assert abs(height) < 0.003 and found["ground_normal"] @ UP[2, :3] > np.cos(np.radians(0.2))
        np.testing.assert_array_equal(found["master_from_colour_start"], start.master_from_colour)
        background = found["cameras/k2/background"].astype(float) / 1000
        truth = room_depth(TRUTH[1], UP, FURNITURE)
        assert np.median(np.abs(background - truth)[truth > 0]) < 0.005
    first = paths["output"].read_bytes()
    run(paths)
    assert paths["output"].read_bytes() == first


def test_correct_pose_is_kept_while_others_are_refined(tmp_path, monkeypatch):
    # surfaces of six sets alone: nothing moves, and there is no second half of the keypoints
    monkeypatch.setattr(camera_verdicts, "DOUBTFUL_RATIO", 0.35)
    start = perturbed(TRUTH, np.random.default_rng(0), 0.01, 0.3)
    poses = start.master_from_colour.copy()
    poses[3] = TRUTH.master_from_colour[3]
    start = start.moved(poses)
    run(capture(tmp_path, start, depth_images()))
    with artefacts.read(tmp_path / "scene.h5", SCENE) as found:
        assert found["camera_refined"].tolist() == [False, True, True, False, True, True]
        np.testing.assert_array_equal(found["master_from_colour"][3], poses[3])
        verdicts, slides = found.text("camera_verdict"), found["camera_slide"]
        known = np.linalg.norm(slides, axis=1)
    assert verdicts[3].startswith("as given") and verdicts[1].startswith("refined")
    assert known[0] == 0 and (known[1:] > 0).all() and (known < 0.02).all()
    error = extrinsics_error(Rig.from_scene(tmp_path / "scene.h5"), TRUTH, MIDDLE)
    assert error[1:].mean() < 0.006


def test_refinement_can_be_turned_off_and_the_floor_annotated(tmp_path):
    start = perturbed(TRUTH, np.random.default_rng(0), 0.01, 0.3)
    paths = capture(tmp_path, start, depth_images())
    floor = apply(invert(UP), np.array([[0, 0, 0.005], [1, 0, 0.005], [0, 1, 0.005]]))
    settings = SceneSettings(refine_extrinsics=False)
    run(paths, settings=settings, floor=[tuple(p) for p in floor])
    with artefacts.read(paths["output"], SCENE) as found:
        assert not found.attributes["extrinsics_refined"]
        assert "switched off" in found.attributes["verdict"]
        assert not found["camera_refined"].any()
        assert all("switched off" in verdict for verdict in found.text("camera_verdict")[1:])
        np.testing.assert_array_equal(found["pair_residual_before"], found["pair_residual_after"])
        assert found.attributes["ground_source"] == "annotated"
        np.testing.assert_array_equal(found["master_from_colour"], start.master_from_colour)
        np.testing.assert_allclose(apply(UP, found["ground_point"][None])[0, 2], 0.005, atol=1e-9)


def test_without_depth_the_start_stays_and_feet_show_the_floor(tmp_path):
    paths = capture(tmp_path, TRUTH)
    run(paths)
    with artefacts.read(paths["output"], SCENE) as found:
        assert found.attributes["ground_source"] == "feet" and found.keys("cameras/") == []
        assert found.attributes["up_source"] == "cameras, feet, balance"
        assert 0.5 < found.attributes["up_deviation_deg"] < 4
        assert np.degrees(np.arccos(min(1, found["ground_normal"] @ UP[2, :3]))) < 3
        assert abs(apply(UP, found["ground_point"][None])[0, 2]) < 0.01
    assert extrinsics_error(Rig.from_scene(paths["output"]), TRUTH, MIDDLE).max() < 0.02


ORIGIN = apply(invert(UP), np.zeros((1, 3)))[0]
STATED = {"stated_up": UP[2, :3], "stated_floor": ORIGIN}


def ground_of(paths: dict[str, Path], depths: list[np.ndarray] | None = None, **stated) -> dict:
    """Attributes, floor height and z_up_frame of the scene for a row with stated up and floor."""
    write_frames(paths["frames"], TRUTH, num_sets=T, stated=stated, depths=depths)
    run(paths)
    with artefacts.read(paths["output"], SCENE) as found:
        height = apply(UP, found["ground_point"][None])[0, 2]
        return found.attributes | {"height": height, "frame": z_up_frame(found)}


def test_stated_floor_is_used_unless_feet_contradict_it(tmp_path):
    paths = capture(tmp_path, TRUTH)
    agrees = ground_of(paths, **STATED)
    assert agrees["ground_source"] == "stated" and abs(agrees["height"]) < 1e-9
    assert "ground_note" not in agrees and "up from the calibration, +-2" in agrees["frame"]
    denied = ground_of(paths, **STATED | {"stated_floor": ORIGIN + 0.4 * UP[2, :3]})
    assert denied["ground_source"] == "feet" and abs(denied["height"]) < 0.02
    assert "0.4" in denied["ground_note"] and "below the stated one" in denied["ground_note"]
    with pytest.raises(UserError, match="sequence test: calibration_up is 90 degrees"):
        ground_of(paths, stated_up=UP[0, :3])


def test_measured_floor_is_kept_and_compared_with_the_stated_one(tmp_path):
    paths = capture(tmp_path, TRUTH)
    raised = ground_of(paths, depth_images(), **STATED | {"stated_floor": ORIGIN + 0.2 * UP[2, :3]})
    assert raised["ground_source"] == "fitted" and abs(raised["height"]) < 0.005
    assert raised["ground_note"] == "the floor is 0.20 m below the stated one"


def test_source_of_up_is_stated_without_a_floor(tmp_path):
    paths = capture(tmp_path, TRUTH)
    write_detections(paths["detections"], TRUTH, [[[] for _ in TRUTH] for _ in range(T)])
    by_cameras, stated = ground_of(paths), ground_of(paths, stated_up=UP[2, :3])
    assert by_cameras["up_source"] == "cameras" and stated["up_source"] == "stated"
    assert "cameras taken to be level" in by_cameras["frame"] and "no floor" in by_cameras["frame"]
    assert "from the calibration, +-2.0 degrees; no floor" in stated["frame"]


def test_missing_images_and_collinear_floors_are_rejected(tmp_path):
    paths = capture(tmp_path, TRUTH)
    with pytest.raises(UserError, match="sequence test: annotation floor"):
        run(paths, floor=[(0, 0, 1), (0, 0, 2), (0, 0, 3)])
    write_frames(paths["frames"], TRUTH, num_sets=T, colour_index=np.full((T, 6), -1))
    with pytest.raises(UserError, match="no image of any camera"):
        run(paths)


@pytest.mark.parametrize("with_people", [True, False])
def test_rig_without_overlap_is_reported_and_not_degraded(tmp_path, with_people):
    start = perturbed(TRUTH, np.random.default_rng(5), 0.01, 0.3)
    rng, depths = np.random.default_rng(1), []
    for c, camera in enumerate(TRUTH):
        depth = room_depth(camera, UP, np.zeros((0, 2, 3)), None)
        rays = np.dstack([camera.depth.rays, np.ones(depth.shape)]) * depth[..., None]
        world = apply(UP @ camera.master_from_depth, rays.reshape(-1, 3)).reshape(rays.shape)
        sector = np.arctan2(world[..., 1], world[..., 0]) - 2 * np.pi * c / 6
        depth[np.abs((sector + np.pi) % (2 * np.pi) - np.pi) > np.radians(20)] = 0
        depths.append(np.stack([to_millimetres(depth, rng) for _ in range(T)]))
    paths = capture(tmp_path, start, depths)
    if not with_people:
        nobody = [[[] for _ in TRUTH] for _ in range(T)]
        write_detections(paths["detections"], TRUTH, nobody)
    run(paths)
    with artefacts.read(paths["output"], SCENE) as found:
        notes, refined = found.text("note"), found.attributes["extrinsics_refined"]
        assert len(found["pairs"]) == 0 and refined == with_people
    assert all("shares no surface" in note for note in notes[1:])
    before = extrinsics_error(start, TRUTH, MIDDLE)[1:].mean()
    after = extrinsics_error(Rig.from_scene(paths["output"]), TRUTH, MIDDLE)[1:].mean()
    assert after < (0.6 * before if with_people else before + 1e-9)


def standing(tmp_path: Path, sets: int = 30, sound: np.ndarray | None = None) -> dict[str, Path]:
    """A motionless person in cameras without depth; ``sound`` (C,): their starts, seconds."""
    heard = {} if sound is None else {"sound_start": sound, "sound_start_sigma": 0 * sound + 0.03}
    rng = np.random.default_rng(1)
    still = seen_by(walking(sets, np.array([-0.3, -0.2]), np.zeros(2), 0.0), TRUTH, UP)
    still[..., :2] += rng.normal(0, 2, still[..., :2].shape)
    people = [[[still[t, c]] for c in range(len(TRUTH))] for t in range(sets)]
    return {
        "frames": write_frames(
            tmp_path / "frames.h5", TRUTH, num_sets=sets, colour_times=True, sound=heard
        ),
        "detections": write_detections(tmp_path / "detections.h5", TRUTH, people),
        "output": tmp_path / "scene.h5",
    }


def test_stated_start_aligns_cameras_without_motion(tmp_path):
    """Cameras started by hand; only the annotation knows of it."""
    paths = standing(tmp_path)
    starts = {"k1": (3600.0, 0.02), "k2": (3600.48, 0.02), "k3": (3599.8, 0.04)}
    run(paths, starts=starts)
    with artefacts.read(paths["output"], SCENE) as found:
        notes, slip = found.text("note"), found["slip"]
        offset, sigma = found["time_offset"], found["time_offset_sigma"]
        image_of = found["image_of"]
    late = slip.mean(0) / 15 - offset
    np.testing.assert_allclose(late[:3], [0, -0.48, 0.2], atol=0.02)  # of keypoints, noise
    assert (slip == slip[0]).all()
    np.testing.assert_allclose(sigma[1:3], [0.028, 0.045], rtol=0.25)
    assert "its start is that of the annotation: 0.4" in notes[1]
    assert "s later than its times say, known to 0.02" in notes[1]
    assert "s earlier than its times say, known to 0.03" in notes[2]
    # nobody states when the others started: they are set aside, and it is said what to do
    assert "state when it started" in notes[3] and (image_of[:, 3] == -1).all()


def test_starts_without_common_time_are_rejected(tmp_path):
    paths = standing(tmp_path)
    starts = {"k1": (0.0, 0.02), "k2": (480.0, 0.02)}  # milliseconds
    with pytest.raises(UserError, match=r"sequence test: .* k2 started 480\.000 s later .* 1\.9 s"):
        run(paths, starts=starts)


def test_sound_aligns_cameras_without_motion(tmp_path):
    heard = np.array([0.0, 0.48, -0.2, 0.02, 0.3, np.nan])
    paths = standing(tmp_path, sound=heard)
    run(paths, starts={"k1": (0, 0.02), "k2": (0.9, 0.02)})
    with artefacts.read(paths["output"], SCENE) as found:
        notes, late = found.text("note"), found["slip"].mean(0) / 15 - found["time_offset"]
        seen = (found["image_of"] >= 0).any(0)
    np.testing.assert_allclose(late[:5], [0, -0.9, 0.2, -0.02, -0.3], atol=0.03)
    assert seen.tolist() == [True] * 5 + [False]
    assert "its start is that of the sound: 0." in notes[2]
    assert "its start is that of the annotation: 0." in notes[1]


def test_sound_does_not_change_synchronised_cameras(tmp_path):
    """Devices lay sound tens of milliseconds beside their images: times of one clock are better."""
    (tmp_path / "heard").mkdir()
    quiet, heard = (
        standing(tmp_path),
        standing(tmp_path / "heard", sound=np.array([0.0, 0.05, -0.06, 0.02, 0.08, np.nan])),
    )
    for paths in (quiet, heard):
        run(paths)
    assert quiet["output"].read_bytes() == heard["output"].read_bytes()
