"""The joint stage with bad inputs: it completes, logs the problem and flags the frames."""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from intercap_core import artefacts
from intercap_core.annotation import ContactInterval
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.lemo import MotionEncoder
from intercap_core.config import BodyFitSettings, JointSettings, ObjectTrackSettings
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.flags import PARTS
from intercap_core.geometry.rigid.contact_vertices import contact_list
from intercap_core.schemas import CONTACT_REGIONS, JOINT
from intercap_core.sequence_inputs import FitSettings
from intercap_core.stages import joint
from tests.helpers import fitted_capture as fitted
from tests.helpers.lemo_release import random_encoder

FRAMES = 6
RADIUS = 0.11
STAGES = ("frames", "detections", "scene", "person", "object_track", "body_fit")
Joint = dict[str, np.ndarray]


class HeldBall(fitted.Capture):
    """A capture that a test may change, with a ball at the right hand."""

    @classmethod
    def copied(cls, capture: fitted.Capture, folder: Path) -> HeldBall:
        """A copy of the inputs in ``folder``; the object is seen in all frames."""
        paths = {stage: folder / f"{stage}.h5" for stage in STAGES}
        for stage, path in paths.items():
            shutil.copy(capture.paths[stage], path)
        entry = ObjectEntry(name="ball", mesh=folder / "ball.ply")
        shutil.copy(capture.object_.mesh, entry.mesh)
        copied = cls(**{**vars(capture), "paths": paths, "object_": entry})
        copied.put("object_track", lost=False)
        copied.put("person", missing=False)
        return copied

    def put(self, stage: str, /, **values: object) -> None:
        """Overwrite datasets and attributes of a stage's artefact."""
        with h5py.File(self.paths[stage], "r+") as file:
            for name, value in values.items():
                if name in file:
                    file[name][...] = value
                else:
                    file.attrs[name] = value

    def put_floor(self, rise: float) -> None:
        """Put the floor ``rise`` metres above the true soles; y points down."""
        self.put("scene", ground_point=[0, self.vertices[..., 1].max() - rise, 2.4])

    def run(self, contact: list[ContactInterval] | None = None, **settings: object) -> Joint:
        """Arrays of the joint stage's artefact."""
        output = self.paths["scene"].parent / "joint.h5"
        fixed = {"look_again": False, "refine_cameras": False}
        joint.run(
            paths=self.inputs(*STAGES),
            models=self.models,
            fit_settings=FitSettings(
                JointSettings.model_validate(fixed | settings),
                BodyFitSettings(points_per_frame=800),
                ObjectTrackSettings(),
            ),
            output=output,
            contact=contact,
        )
        with artefacts.read(output, JOINT) as artefact:
            arrays = {key: artefact[key] for key in artefact.keys("")}
            return arrays | {"flag_reason": np.array(artefact.text("flag_reason"))}


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    """Captures by their number of frames, each made once."""
    return partial(fitted.shared_capture, tmp_path_factory)


@pytest.fixture
def ball(captures, tmp_path) -> HeldBall:
    return HeldBall.copied(captures(FRAMES), tmp_path)


@pytest.fixture(scope="module")
def sound(captures, tmp_path_factory) -> Joint:
    """Result of undamaged inputs."""
    return HeldBall.copied(captures(FRAMES), tmp_path_factory.mktemp("sound")).run()


def lose_half(ball: HeldBall) -> None:
    """Lose the object from the middle on; the track keeps its last pose."""
    half = AFTER[0]
    with h5py.File(ball.paths["object_track"], "r+") as file:
        file["lost"][half:] = True
        file["translation"][half:] = file["translation"][half - 1]
        for name in ("covariance", "depth_residual", "silhouette_residual", "overlap"):
            file[name][half:] = np.nan
        file["candidate"][half:] = -1
        file["views"][half:] = 0
        file["probability"][half:] = 0


def leave_out_faces(ball: HeldBall) -> None:
    """Remove a tenth of the faces, all in one place."""
    mesh = trimesh.load(ball.object_.mesh, process=False)
    centres = mesh.triangles_center
    near = cKDTree(centres).query([0, 0, RADIUS], len(centres) // 10)[1]
    kept = np.setdiff1d(np.arange(len(centres)), near)
    trimesh.Trimesh(mesh.vertices, mesh.faces[kept], process=False).export(ball.object_.mesh)


EVERY = tuple(range(FRAMES))
AFTER = EVERY[FRAMES // 2 :]


@pytest.mark.parametrize(
    ("damage", "reason", "flagged", "message"),
    [
        (lambda ball: ball.put("scene", ground_found=False), "", (), ""),
        (lambda ball: ball.put_floor(0.3), "above the feet, not used", EVERY, "ground"),
        (lambda ball: ball.put_floor(-0.3), "below feet and object, not used", EVERY, "ground"),
        (lose_half, "object lost", AFTER, ""),
        (leave_out_faces, "", (), "not watertight"),
    ],
)
def test_damage_is_logged_and_flagged_and_fit_stays_near(
    damage, reason, flagged, message, ball, sound, caplog
):
    damage(ball)
    with caplog.at_level(logging.WARNING):
        result = ball.run()
    reasons = result["flag_reason"]
    assert tuple(t for t in EVERY if reasons[t] and reason in reasons[t]) == flagged, reasons
    np.testing.assert_array_equal(result["flagged"].any(axis=1), reasons != "")
    assert message in caplog.text
    assert bool(message) == any(r.levelno >= logging.WARNING for r in caplog.records)
    for key in ("joints", "rotation", "translation", "contact_probability"):
        assert np.isfinite(result[key]).all(), key
    moved = np.linalg.norm(result["joints"] - sound["joints"], axis=2)
    assert moved.mean() < 0.002
    shift = np.linalg.norm(result["translation"] - sound["translation"], axis=1)
    lost = AFTER if damage is lose_half else ()
    assert np.delete(shift, lost).max() < (0.004 if lost else 0.002)


def test_sound_input_is_not_flagged_and_hand_touches(sound):
    assert not sound["flagged"].any()
    likeliest = sound["contact_probability"].argmax(1)
    np.testing.assert_array_equal(likeliest, CONTACT_REGIONS.index("right_hand"))


def test_a_recording_of_one_frame(captures, tmp_path):
    """Accelerations need three frames and speeds two."""
    ball = HeldBall.copied(captures(1), tmp_path)
    result = ball.run()
    assert not result["flagged"].any() and len(result["joints"]) == 1
    assert np.linalg.norm(result["joints"] - ball.joints, axis=2).mean() < 0.005
    assert result["energy_after"].sum() <= result["energy_before"].sum()


@pytest.mark.parametrize("frames", [1, 2])
def test_last_frame_without_a_body_fit(captures, tmp_path, frames: int):
    ball = HeldBall.copied(captures(frames), tmp_path)
    failed = np.arange(frames) == frames - 1
    ball.put("scene", ground_found=False)
    ball.put("body_fit", failed=failed, bridged=failed)
    result = ball.run()
    assert np.isfinite(result["joints"]).all()
    assert result["flagged"].any(axis=1).tolist() == failed.tolist()


def test_undetermined_hand_flags_the_hands_alone(captures, tmp_path):
    ball = HeldBall.copied(captures(3), tmp_path)
    ball.put("scene", ground_found=False)
    with h5py.File(ball.paths["body_fit"], "r+") as file:
        file["joint_sigma"][:, JOINT_INDEX["right_index1"] :] = 0.1
        file["bridged"][2] = True
    result = ball.run()
    assert result["hand_undetermined"].tolist() == [[False, True], [False, True], [True, True]]
    flagged = [[PARTS[p] for p in np.flatnonzero(row)] for row in result["flagged"]]
    assert flagged == [["hands"], ["hands"], ["body", "hands", "contact"]]


def test_annotated_contact_needs_contact_vertices(ball, tmp_path):
    assert ball.object_.contact_vertices is None
    with pytest.raises(UserError, match=r"has no contact_vertices.*set joint.contact_to to any"):
        ball.run(contact_to="annotated")
    assert not (tmp_path / "joint.h5").exists()


@pytest.mark.parametrize(
    ("frames", "changes", "expected"),
    [
        (3, {}, ["has 3 frames", "needs 10 or more"]),
        (10, {"fps": 15.0}, ["has 15 frames a second", "motion at 30"]),
        (10, {"ground_found": False}, ["has no ground", "what is up"]),
        (10, {}, ["Enc_last_model.pkl"]),
    ],
)
def test_learned_motion_refuses_unsuitable_recordings(
    captures, tmp_path, frames: int, changes: dict[str, object], expected: list[str]
):
    ball = HeldBall.copied(captures(frames), tmp_path)
    ball.put("scene", **{"fps": 30.0} | changes)
    with pytest.raises(UserError) as caught:
        ball.run(lemo=tmp_path / "LEMO")
    for words in [*expected, "joint.lemo"]:
        assert words in str(caught.value)


def test_learned_motion_is_part_of_the_fit(captures, tmp_path, monkeypatch):
    """Random weights, of few channels, do not tear the body from the images."""
    monkeypatch.setattr(MotionEncoder, "load", lambda *files, **options: random_encoder())
    ball = HeldBall.copied(captures(10), tmp_path)
    ball.put("scene", fps=30.0)
    with h5py.File(ball.paths["body_fit"], "r+") as file:
        file["transl"][...] += np.random.default_rng(0).normal(0, 0.005, (10, 3))
    result = ball.run(lemo=tmp_path)
    at = result["energy_names"].astype(str).tolist().index("body_motion")
    assert 0 < result["energy_after"][at] < result["energy_before"][at]
    assert np.linalg.norm(result["joints"] - ball.joints, axis=2).mean() < 0.015


def test_contact_vertices_of_another_mesh_are_refused(ball, tmp_path):
    contact = tmp_path / "ball.contact.json"
    contact.write_text(json.dumps(contact_list([3, 9], ball.mesh.vertices)))
    trimesh.creation.icosphere(2, RADIUS).export(ball.object_.mesh)
    entry = ball.object_.model_copy(update={"contact_vertices": contact})
    with pytest.raises(UserError) as caught:
        replace(ball, object_=entry).run()
    for words in (contact, entry.mesh, len(ball.mesh.vertices), 162, "choose the vertices"):
        assert str(words) in str(caught.value)
    assert not (tmp_path / "joint.h5").exists()
