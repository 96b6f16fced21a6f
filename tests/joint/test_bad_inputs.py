"""What the joint stage does with input that is wrong: it goes on, says so, and flags the frames.

A person who holds a ball, seen by three cameras; the body is fitted by its own stage.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from intercap_core import artefacts
from intercap_core.body.model import BodyModel
from intercap_core.config import BodyModels, JointSettings, ObjectTrackSettings
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.geometry.rigid.contact_vertices import contact_list
from intercap_core.schemas import CONTACT_REGIONS, JOINT, OBJECT_TRACK
from intercap_core.sequence_inputs import FitSettings, SequenceModels, SequencePaths
from intercap_core.stages import joint
from tests.helpers.lemo_release import write_release
from tests.stages.test_body_fit import SETTINGS, SUBJECT, Capture

FRAMES = 6
RADIUS = 0.11
CAMERAS = 3
Joint = dict[str, np.ndarray]


@dataclass
class Held:
    """A capture of some frames with a ball in the left hand, its artefacts by stage."""

    paths: dict[str, Path]
    entry: ObjectEntry
    vertices: np.ndarray  # (T, V, 3), true
    joints: np.ndarray  # (T, 55, 3), true

    def copy(self, folder: Path) -> Held:
        """The same in another folder, to be spoiled."""
        paths = {stage: folder / path.name for stage, path in self.paths.items()}
        for stage, path in self.paths.items():
            shutil.copy(path, paths[stage])
        mesh = folder / "ball.ply"
        shutil.copy(self.entry.mesh, mesh)
        entry = self.entry.model_copy(update={"mesh": mesh})
        return Held(paths, entry, self.vertices, self.joints)

    def put(self, stage: str, **values: np.ndarray) -> None:
        """Write other ``values`` into a stage's artefact."""
        with h5py.File(self.paths[stage], "r+") as file:
            for name, value in values.items():
                file[name][...] = value

    def put_floor(self, rise: float) -> None:
        """A floor ``rise`` metres above the true soles."""
        up = self.up
        height = (self.vertices @ up).min() + rise
        self.put("scene", ground_point=height * up, ground_normal=up)
        with h5py.File(self.paths["scene"], "r+") as file:
            file.attrs["ground_found"] = True

    @property
    def up(self) -> np.ndarray:
        """The room's up (3,), from head and feet of the first frame."""
        body = self.vertices[0].astype(float)
        along = body[np.argmin(body[:, 1])] - body[np.argmax(body[:, 1])]
        axis = np.linalg.svd(body - body.mean(0), full_matrices=False)[2][0]
        return axis * np.sign(axis @ along)

    def run(self, **settings: object) -> Joint:
        """The joint stage's artefact, with other ``settings`` where they are given."""
        output = self.paths["scene"].parent / "joint.h5"
        joint.run(
            paths=SequencePaths(**self.paths),
            models=SequenceModels(self.entry, SUBJECT, BodyModels()),
            fit_settings=FitSettings(
                JointSettings.model_validate(
                    {"look_again": False, "refine_cameras": False, **settings}
                ),
                SETTINGS,
                ObjectTrackSettings(),
            ),
            output=output,
        )
        with artefacts.read(output, JOINT) as found:
            read = {key: found[key] for key in found.keys("")}
            return read | {"flag_reason": np.array(found.text("flag_reason"))}


def hold(model: BodyModel, folder: Path, frames: int) -> Held:
    """Write all that the joint stage reads."""
    capture = Capture(model, folder, frames, cameras=CAMERAS)
    fit = folder / "body_fit.h5"
    capture.fit(fit)
    mesh = folder / "ball.ply"
    trimesh.creation.icosphere(subdivisions=3, radius=RADIUS).export(mesh)
    palm = capture.vertices[:, model.regions["left_hand"]].astype(float)
    middle = capture.vertices.mean(1)
    outward = palm.mean(1) - middle
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    tip = (palm * outward[:, None]).sum(2).argmax(1)
    there = palm[np.arange(frames), tip] + outward * RADIUS
    track = folder / "object_track.h5"
    write_track(track, there)
    inputs = capture.inputs
    paths = {"frames": inputs.frames, "scene": inputs.scene, "person": inputs.person,
             "object_track": track, "body_fit": fit}  # fmt: skip
    entry = ObjectEntry(name="ball", mesh=mesh)
    return Held(paths, entry, capture.vertices, capture.joints)


def write_track(path: Path, translation: np.ndarray) -> None:
    """An object's track (T, 3) that is 4 mm and 0.004 rad sure of itself."""
    frames = len(translation)
    full = {
        "rotation": np.repeat(np.eye(3)[None], frames, 0),
        "translation": translation,
        "covariance": np.repeat(np.eye(6)[None] * 0.004**2, frames, 0),
        "views": np.full(frames, CAMERAS),
        "probability": np.ones(frames),
    }
    sizes = {"T": frames, "C": CAMERAS}
    with artefacts.write(
        path, OBJECT_TRACK, sequence="test", object="ball", seed_frame=0, seed_source="search",
        doubts="",
    ) as writer:  # fmt: skip
        writer.put("camera_names", [f"k{c + 1}" for c in range(CAMERAS)])
        for key, declared in OBJECT_TRACK.fields.items():
            if key != "camera_names":
                shape = [sizes.get(d) or int(d) for d in declared.dims]
                writer.put(key, full.get(key, np.zeros(shape, declared.dtype)))


@pytest.fixture(scope="module")
def held(model: BodyModel, tmp_path_factory: pytest.TempPathFactory) -> Held:
    return hold(model, tmp_path_factory.mktemp("held"), FRAMES)


@pytest.fixture(scope="module")
def sound(held: Held, tmp_path_factory: pytest.TempPathFactory) -> Joint:
    """What the stage finds with nothing wrong."""
    here = held.copy(tmp_path_factory.mktemp("sound"))
    here.put_floor(0.0)
    return here.run()


@dataclass(frozen=True)
class Case:
    """``spoil`` the input; the log must name ``said``, ``flagged`` frames have ``reason``, and the
    body's joints stay within ``body_mm`` in the mean, and the object within ``object_mm`` in each
    frame that is not ``lost``, of what the sound input gives."""

    spoil: Callable[[Held], None]
    reason: str = ""
    flagged: tuple[int, ...] = ()
    said: str = ""
    body_mm: float = 2.0
    object_mm: float = 2.0
    lost: tuple[int, ...] = ()


def lose_half(held: Held) -> None:
    """The object is nowhere from the middle on; the track keeps its last pose."""
    half = AFTER[0]
    with h5py.File(held.paths["object_track"], "r+") as file:
        file["lost"][half:] = True
        file["covariance"][half:] = np.nan
        file["translation"][half:] = file["translation"][half - 1]
        for name in ("depth_residual", "silhouette_residual", "overlap"):
            file[name][half:] = np.nan
        file["candidate"][half:] = -1
        file["views"][half:] = 0
        file["probability"][half:] = 0


def leave_out_faces(held: Held) -> None:
    """A tenth of the faces, all in one place."""
    mesh = trimesh.load(held.entry.mesh, process=False)
    centres = mesh.triangles_center
    near = cKDTree(centres).query([0, 0, RADIUS], len(centres) // 10)[1]
    kept = np.setdiff1d(np.arange(len(centres)), near)
    trimesh.Trimesh(mesh.vertices, mesh.faces[kept], process=False).export(held.entry.mesh)


def no_floor(held: Held) -> None:
    with h5py.File(held.paths["scene"], "r+") as file:
        file.attrs["ground_found"] = False


EVERY = tuple(range(FRAMES))
AFTER = EVERY[FRAMES // 2 :]
CASES = {
    "no floor": Case(no_floor),
    "floor 30 cm too high": Case(
        lambda held: held.put_floor(0.3), "above the feet, not used", EVERY, "ground"
    ),
    "floor 30 cm too low": Case(
        lambda held: held.put_floor(-0.3), "below feet and object, not used", EVERY, "ground"
    ),
    "object lost for half the sequence": Case(
        lose_half, "object lost", AFTER, object_mm=4.0, lost=AFTER
    ),
    "a tenth of the faces missing": Case(leave_out_faces, said="not watertight"),
}


@pytest.mark.parametrize("name", CASES)
def test_survived_named_flagged(
    name: str,
    held: Held,
    sound: Joint,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    case, here = CASES[name], held.copy(tmp_path)
    here.put_floor(0.0)
    case.spoil(here)
    with caplog.at_level(logging.WARNING):
        found = here.run()
    flagged = np.flatnonzero([case.reason in reason and bool(reason) for reason in
                              found["flag_reason"]])  # fmt: skip
    assert tuple(flagged) == case.flagged, found["flag_reason"]
    np.testing.assert_array_equal(found["flagged"], found["flag_reason"] != "")
    assert case.said in caplog.text
    assert bool(case.said) == any(r.levelno >= logging.WARNING for r in caplog.records)
    for key in ("joints", "rotation", "translation", "contact_probability"):
        assert np.isfinite(found[key]).all(), key
    moved = np.linalg.norm(found["joints"] - sound["joints"], axis=2)
    assert 1e3 * moved.mean() < case.body_mm
    kept = np.setdiff1d(EVERY, case.lost)
    shift = np.linalg.norm(found["translation"] - sound["translation"], axis=1)[kept]
    assert 1e3 * shift.max() < case.object_mm


def test_sound_input_is_not_flagged(sound: Joint) -> None:
    """And what the hand touches is what is found to touch."""
    assert not sound["flagged"].any()
    likeliest = sound["contact_probability"].argmax(1)
    np.testing.assert_array_equal(likeliest, CONTACT_REGIONS.index("left_hand"))


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_very_short_recordings(model: BodyModel, tmp_path: Path, frames: int) -> None:
    """Accelerations need three frames and speeds two; the rest holds with one."""
    here = hold(model, tmp_path, frames)
    here.put_floor(0.0)
    found = here.run()
    assert not found["flagged"].any() and len(found["joints"]) == frames
    assert np.linalg.norm(found["joints"] - here.joints, axis=2).mean() < 0.010
    assert found["energy_after"].sum() <= found["energy_before"].sum()


@pytest.mark.parametrize("frames", [1, 2])
def test_a_last_frame_without_a_fit_is_bridged(
    model: BodyModel, tmp_path: Path, frames: int
) -> None:
    here = hold(model, tmp_path, frames)
    failed = np.arange(frames) == frames - 1
    here.put("body_fit", failed=failed, bridged=failed)
    found = here.run()
    assert np.isfinite(found["joints"]).all()
    assert found["flagged"].tolist() == failed.tolist()


def test_a_hand_that_nothing_determines_is_told_and_not_flagged(
    model: BodyModel, tmp_path: Path
) -> None:
    held = hold(model, tmp_path, 3)
    with h5py.File(held.paths["body_fit"], "r+") as file:
        parts = file["part_names"].asstr()[()].tolist()
        file["undetermined"][:] = False
        file["undetermined"][1, parts.index("right_hand")] = True
        file["undetermined"][1, parts.index("left_arm")] = True
        file["bridged"][2] = True
    found = held.run()
    assert found["hand_undetermined"].tolist() == [[False, False], [False, True], [True, True]]
    assert not found["flagged"][1]


def test_contact_to_annotated_vertices_that_the_object_has_not(held: Held, tmp_path: Path) -> None:
    here = held.copy(tmp_path)
    assert here.entry.contact_vertices is None
    with pytest.raises(UserError, match=r"has no contact_vertices.*set joint.contact_to to any"):
        here.run(contact_to="annotated")
    assert not (tmp_path / "joint.h5").exists()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"fps": 15.0}, ["has 15 frames a second", "motion at 30"]),
        ({"ground_found": False}, ["has no ground", "what is up"]),
        ({}, ["Enc_last_model.pkl does not exist"]),
    ],
)
def test_recordings_and_folders_that_a_learned_motion_is_not_for(
    model: BodyModel, tmp_path: Path, changes: dict[str, object], expected: list[str]
) -> None:
    here = hold(model, tmp_path, 10)
    here.put_floor(0.0)
    with h5py.File(here.paths["scene"], "r+") as file:
        file.attrs.update({"fps": 30.0} | changes)
    with pytest.raises(UserError) as caught:
        here.run(lemo=tmp_path / "LEMO")
    for words in [*expected, "joint.lemo"]:
        assert words in str(caught.value)


def test_a_recording_that_is_too_short_for_a_learned_motion(
    model: BodyModel, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=r"has 3 frames.*needs 10 or more.*joint.lemo"):
        hold(model, tmp_path, 3).run(lemo=tmp_path)


def test_a_learned_motion_is_part_of_the_fit(model: BodyModel, tmp_path: Path) -> None:
    """And random weights do not tear the body from what is seen."""
    here = hold(model, tmp_path, 10)
    here.put_floor(0.0)
    with h5py.File(here.paths["scene"], "r+") as file:
        file.attrs["fps"] = 30.0
    found = here.run(lemo=write_release(tmp_path / "LEMO").lemo)
    at = found["energy_names"].astype(str).tolist().index("body_motion")
    assert 0 < found["energy_after"][at] < found["energy_before"][at]
    assert np.linalg.norm(found["joints"] - here.joints, axis=2).mean() < 0.015


@pytest.mark.parametrize("subdivisions", [2, 4])
def test_an_object_meshed_anew_under_old_contact_vertices(
    held: Held, tmp_path: Path, subdivisions: int
) -> None:
    """Coarser or finer: the list's vertices are others, whether they still exist or not."""
    here = held.copy(tmp_path)
    contact = tmp_path / "ball.contact.json"
    vertices = np.asarray(trimesh.load(here.entry.mesh, process=False).vertices)
    contact.write_text(json.dumps(contact_list([3, 9], vertices)))
    trimesh.creation.icosphere(subdivisions, RADIUS).export(here.entry.mesh)
    here.entry = here.entry.model_copy(update={"contact_vertices": contact})
    with pytest.raises(UserError) as caught:
        here.run()
    count = {2: 162, 4: 2562}[subdivisions]
    for words in (contact, here.entry.mesh, 642, count, "choose the vertices again"):
        assert str(words) in str(caught.value)
    assert not (tmp_path / "joint.h5").exists()
