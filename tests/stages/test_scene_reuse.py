"""Stage ``scene`` with the cameras of another sequence as start and prior (column rig_from)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.config import SceneSettings
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
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
GIVEN = perturbed(TRUTH, np.random.default_rng(0), 0.01, 0.3)
MIDDLE = apply(invert(UP), np.array([[0, 0, 0.8]]))[0]
T = 6


@cache
def depth_images(rig: Rig = TRUTH, boxes: bool = True) -> list[np.ndarray]:
    """Noisy depth images (T, H, W) of each camera of a furnished or bare room."""
    rng = np.random.default_rng(0)
    room = FURNITURE if boxes else np.zeros((0, 2, 3))
    clean = [room_depth(camera, UP, room) for camera in rig]
    return [np.stack([to_millimetres(depth, rng) for _ in range(T)]) for depth in clean]


def run(
    folder: Path,
    rig: Rig = GIVEN,
    *,
    truth: Rig = TRUTH,
    depths: list[np.ndarray] | None = None,
    noise_px: float = 3.0,
    rig_from: Path | None = None,
) -> Path:
    """Write the scene of a recording by the cameras ``truth`` whose calibration is ``rig``."""
    folder.mkdir()
    body = seen_by(walking(T, np.array([-0.3, -0.2]), np.array([0.1, 0.08]), 0.1), truth, UP)
    body[..., :2] += np.random.default_rng(2).normal(0, noise_px, body[..., :2].shape)
    people = [[[body[t, c]] for c in range(len(rig))] for t in range(T)]
    scene.run(
        frames=write_frames(
            folder / "frames.h5", rig, num_sets=T, depths=depths, sequence=folder.name
        ),
        detections=write_detections(folder / "detections.h5", rig, people),
        output=folder / "scene.h5",
        settings=SceneSettings(),
        floor=None,
        rig_from=rig_from,
    )
    return folder / "scene.h5"


def errors(path: Path, truth: Rig = TRUTH) -> np.ndarray:
    """Errors (C - 1,) of the cameras without the master, metres."""
    return extrinsics_error(Rig.from_scene(path), truth, MIDDLE)[1:]


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scene of a recording that shows the furnished room."""
    return run(tmp_path_factory.mktemp("day") / "long", depths=depth_images())


def test_recording_that_does_not_determine_the_cameras_gets_those_of_another(
    tmp_path: Path, long: Path
) -> None:
    """The short recording has no depth, and six sets of noisy keypoints."""
    alone = run(tmp_path / "alone", noise_px=10.0)
    reused = run(tmp_path / "short", noise_px=10.0, rig_from=long)
    assert errors(reused).mean() < 0.5 * errors(alone).mean()
    assert errors(reused).mean() < 1.2 * errors(long).mean()
    with artefacts.read(alone, SCENE) as one, artefacts.read(reused, SCENE) as other:
        variances = [np.einsum("cici->ci", s["camera_covariance"])[1:] for s in (one, other)]
        assert (variances[1] < variances[0]).all()
        assert "the given poses are those of sequence long" in other.attributes["verdict"]
        np.testing.assert_array_equal(other["master_from_colour_start"], GIVEN.master_from_colour)


def test_evidence_of_both_recordings_adds_up(tmp_path: Path, long: Path) -> None:
    reused = run(tmp_path / "second", depths=depth_images(), rig_from=long)
    with artefacts.read(long, SCENE) as one, artefacts.read(reused, SCENE) as other:
        first, both = (np.einsum("cici->ci", s["camera_covariance"])[1:] for s in (one, other))
    assert (both <= first * 1.001).all()
    assert errors(reused).mean() < 1.2 * errors(long).mean()


def test_camera_that_was_moved_is_noticed_and_follows_its_own_evidence(
    tmp_path: Path, long: Path
) -> None:
    poses = TRUTH.master_from_colour.copy()
    poses[3, :3, 3] += [0.03, 0.0, 0.02]
    truth = TRUTH.moved(poses)
    reused = run(tmp_path / "bumped", truth=truth, depths=depth_images(truth), rig_from=long)
    assert errors(reused, truth).max() < 0.01
    with artefacts.read(reused, SCENE) as found:
        notes = found.text("note")
    assert ["it was moved after sequence long" in note for note in notes] == [
        c == 3 for c in range(len(TRUTH))
    ]


def test_order_of_the_cameras_does_not_matter(tmp_path: Path, long: Path) -> None:
    turned = Rig((GIVEN[0], *reversed(GIVEN.cameras[1:])))
    truth = Rig((TRUTH[0], *reversed(TRUTH.cameras[1:])))
    reused = run(tmp_path / "turned", turned, truth=truth, rig_from=long)
    assert errors(reused, truth).mean() < 1.2 * errors(long).mean()


def test_other_cameras_are_refused(tmp_path: Path, long: Path) -> None:
    named = Rig((*GIVEN.cameras[:-1], replace(GIVEN[5], name="k9")))
    with pytest.raises(UserError, match="'named' has rig_from 'long', but 'long' has no camera k9"):
        run(tmp_path / "named", named, rig_from=long)
    poses = GIVEN.master_from_colour.copy()
    poses[2, :3, 3] += 0.2
    with pytest.raises(UserError, match=r"'apart' .* place camera k3 346 mm and 0.0 degrees apart"):
        run(tmp_path / "apart", GIVEN.moved(poses), rig_from=long)
    other = tmp_path / "other.h5"
    other.write_bytes(long.read_bytes())
    with h5py.File(other, "r+") as file:
        file.attrs["master"] = "k2"
    with pytest.raises(UserError, match="the master camera of 'long' is 'k2', that of 'm' is 'k1'"):
        run(tmp_path / "m", rig_from=other)
