"""BEHAVE's results as a joint artefact: another body model, an object about its centre."""

from __future__ import annotations

import logging
import pickle
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import pytest
import torch
import trimesh

from intercap_core import artefacts
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.parameters import POSE_BLOCKS, BodyParameters
from intercap_core.errors import UserError
from intercap_core.formats.released import Recording, Results
from intercap_core.geometry.rigid.mesh import read_mesh
from intercap_core.joint.released.artefact import read_results
from intercap_core.pipeline.outcome import line
from intercap_core.schemas import JOINT
from intercap_core.stages import joint
from tests.helpers import fitted_capture as fitted
from tests.helpers.behave_results import centred, write_30_fps, write_object, write_person
from tests.helpers.bodies import open_body
from tests.joint.released.other_person import other_person, smplh_pose

NAME = "Date03_Sub01_suitcase_lift"
TOTAL = 3
CLOCK_S = 7.0  # of the recordings when they begin: folders are named by it


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> fitted.Capture:
    return fitted.make_capture(
        tmp_path_factory.mktemp("ours"), name=NAME, object_name="suitcase", total=TOTAL
    )


def _folder_of(release: Path, t: int) -> Path:
    return release / f"t{t / fitted.FPS:08.3f}"


def _poses(capture: fitted.Capture) -> tuple[np.ndarray, np.ndarray]:
    """The capture's own poses (T, 165) and translations (T, 3), with bent elbows and knees."""
    with artefacts.read(capture.paths["joint"], JOINT) as fit:
        pose = np.concatenate([fit[name] for name, _ in POSE_BLOCKS], axis=1).astype(float)
        transl = fit["transl"].astype(float)
    pose = pose.reshape(TOTAL, 55, 3)
    pose[:, 18, 1] -= 0.9  # left elbow
    pose[:, 4, 0] += np.linspace(0.2, 0.6, TOTAL)  # left knee
    return pose.reshape(TOTAL, 165), transl


@pytest.fixture(scope="module")
def person(capture) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (T, 6890, 3) and faces of somebody whose mesh and shape are not the open body's."""
    return other_person(*_poses(capture))


@pytest.fixture(scope="module")
def written(capture, person, tmp_path_factory) -> Path:
    release = tmp_path_factory.mktemp("BEHAVE") / "sequences" / NAME
    theirs = smplh_pose(_poses(capture)[0], off_deg=4)
    for t in range(TOTAL):
        frame = _folder_of(release, t)
        write_person(frame, person[0][t], person[1], theirs[t])
        write_object(
            frame, "suitcase", capture.object_.mesh, capture.rotation[t], capture.translation[t]
        )
    return release


@pytest.fixture
def release(written, tmp_path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(written, tmp_path / "BEHAVE" / "sequences" / NAME))


def _read(
    capture: fitted.Capture, folder: Path, *, start: float = 0.0, **changes: object
) -> Results:
    """Read the results with other fields of the recording, or other times from ``start`` on."""
    times = start + np.arange(TOTAL) / fitted.FPS
    recording = Recording(NAME, times, capture.object_, OPEN_BODY, 10)
    return read_results(folder, replace(recording, **changes))


@pytest.fixture(scope="module")
def imported(capture, written, tmp_path_factory) -> Path:
    """The joint artefact made from BEHAVE's results."""
    return _import(capture, written, tmp_path_factory.mktemp("theirs"))


def _import(capture: fitted.Capture, results: Path, folder: Path) -> Path:
    stages = ("frames", "scene", "detections", "person", "object_track", "body_fit")
    joint.run(
        paths=capture.inputs(*stages),
        output=folder / "joint.h5",
        results=results,
        models=capture.models,
        fit_settings=fitted.FIT_SETTINGS,
    )
    return folder / "joint.h5"


def _skin(path: Path) -> np.ndarray:
    """The artefact's bodies (T, V, 3)."""
    with artefacts.read(path, JOINT) as theirs:
        named = {
            name: torch.as_tensor(theirs[name])
            for name in (*(name for name, _ in POSE_BLOCKS), "transl", "expression")
        }
        params = BodyParameters(betas=torch.as_tensor(theirs["betas"])[None], **named)
    with torch.no_grad():
        return open_body().forward(params).vertices.numpy().astype(float)


def test_fitted_surface_lies_on_the_released_one(imported, person):
    vertices, _ = person
    ours = _skin(imported)
    with artefacts.read(imported, JOINT) as theirs:
        stated = theirs["surface_distance"]
        assert not theirs["flagged"].any()
        assert theirs["betas"].shape == (10,)
        made_by = theirs.attributes["made_by"]
    assert made_by.startswith(f"another program: BEHAVE, {NAME}; body fitted to its meshes")
    assert made_by in line("joint", imported) and "mm from them" in made_by
    for t in range(TOTAL):
        squared, *_ = igl.point_mesh_squared_distance(
            vertices[t], ours[t], open_body().faces.numpy()
        )
        away = np.sqrt(squared)
        assert away.mean() < 0.002 and np.percentile(away, 95) < 0.006
        # the stated distance is over both directions
        assert stated[t, 0] == pytest.approx(away.mean(), rel=0.35)
    assert stated[:, 1].max() < 0.006


def test_joints_agree_with_the_other_skeleton(capture, imported):
    """The fit has neither slid along limbs nor confused fingers."""
    from intercap_core.studio.subjects import Subject

    true = Subject.load("s02").skin(*_poses(capture)).joints
    with artefacts.read(imported, JOINT) as theirs:
        away = np.linalg.norm(theirs["joints"] - true, axis=2)
    assert np.delete(away, [22, 23, 24], axis=1).max() < 0.015 and away[:, 25:].mean() < 0.006


def test_object_lies_on_its_released_mesh(capture, imported, written):
    vertices = np.asarray(read_mesh(Path(capture.object_.mesh)).vertices)
    assert np.linalg.norm(vertices.mean(axis=0)) > 0.01
    with artefacts.read(imported, JOINT) as theirs:
        for t in range(TOTAL):
            placed = vertices @ theirs["rotation"][t].T + theirs["translation"][t]
            there = trimesh.load(
                _folder_of(written, t) / "suitcase" / "fit01" / "suitcase_fit.ply", process=False
            )
            assert placed == pytest.approx(np.asarray(there.vertices), abs=2e-6)


def test_frames_without_results_are_filled_and_flagged(capture, release, tmp_path, caplog):
    shutil.rmtree(_folder_of(release, 0))
    (_folder_of(release, 1) / "person" / "fit02" / "person_fit.ply").unlink()
    with caplog.at_level(logging.INFO):
        made = _import(capture, release, tmp_path)
    assert "fitted to 1 meshes" in caplog.text
    with artefacts.read(made, JOINT) as theirs:
        assert theirs["flagged"].tolist() == [[True] * 4, [True] * 4, [False] * 4]
        assert theirs.text("flag_reason") == [
            f"body, hands, object, contact: no {what} in the imported files"
            for what in ("result", "person_fit.ply")
        ] + [""]
        assert np.array_equal(theirs["joints"][0], theirs["joints"][2])
        assert np.isnan(theirs["surface_distance"][:2]).all()
        assert np.isfinite(theirs["surface_distance"][2]).all()


def test_body_far_from_its_mesh_is_flagged(capture, release, person):
    """In one frame the legs of the mesh are pressed flat."""
    vertices = person[0][1].copy()
    hips = np.median(vertices[:, 1])  # y is down
    vertices[:, 1] = np.minimum(vertices[:, 1], hips)
    pose = smplh_pose(_poses(capture)[0], off_deg=4)[1]
    write_person(_folder_of(release, 1), vertices, person[1], pose)
    results = _read(capture, release)
    text = "body, hands, contact: the body is far from the mesh that it was fitted to"
    assert results.flags.reasons == ["", text, ""]
    assert results.known.all()


def _only_first_person(release: Path) -> None:
    """Keep the person of the first frame only: the fit of the others does not matter."""
    for t in range(1, TOTAL):
        shutil.rmtree(_folder_of(release, t) / "person")


def test_object_poses_of_frames_precede_those_at_30_fps(capture, release):
    mesh = read_mesh(Path(capture.object_.mesh))
    centre = np.asarray(mesh.vertices).mean(axis=0)
    aside = np.array([0.1, 0, 0])
    moved = [
        centred(r, x + aside, centre)
        for r, x in zip(capture.rotation, capture.translation, strict=True)
    ]
    times = [_folder_of(release, t).name[1:] for t in range(TOTAL)]
    pose = smplh_pose(_poses(capture)[0], off_deg=4)
    angles, trans = (np.array(values) for values in zip(*moved, strict=True))
    write_30_fps(release, times, pose, angles, trans)
    _only_first_person(release)
    assert _read(capture, release).translation == pytest.approx(capture.translation, abs=1e-6)
    for frame in release.glob("t*"):
        shutil.rmtree(frame / "suitcase")
    (_folder_of(release, 0) / "person" / "fit02" / "person_fit.pkl").unlink()
    results = _read(capture, release)
    assert results.known.tolist() == [True, False, False]
    assert results.translation == pytest.approx(capture.translation + aside, abs=1e-6)
    assert results.rotation == pytest.approx(capture.rotation, abs=1e-6)


def _only_parameters(capture: fitted.Capture, release: Path) -> None:
    times = [_folder_of(release, t).name[1:] for t in range(TOTAL)]
    shutil.rmtree(release)
    for t in range(TOTAL):
        _folder_of(release, t).mkdir(parents=True)
    zeros = np.zeros((TOTAL, 3))
    write_30_fps(release, times, np.zeros((TOTAL, 156)), zeros, zeros)


def _two_objects(capture: fitted.Capture, release: Path) -> None:
    frame = _folder_of(release, 1)
    shutil.copytree(frame / "suitcase", frame / "stool")
    (frame / "stool" / "fit01" / "suitcase_fit.pkl").rename(
        frame / "stool" / "fit01" / "stool_fit.pkl"
    )


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_only_parameters, "but smpl_fit_all.npz; parameters of SMPL-H mean another body"),
        (_two_objects, "poses of several objects, stool_fit.pkl and suitcase_fit.pkl"),
    ],
)
def test_damage_is_named(
    capture, release, damage: Callable[[fitted.Capture, Path], None], message: str
):
    damage(capture, release)
    with pytest.raises(UserError, match=message) as error:
        _read(capture, release)
    assert str(release) in str(error.value)


def test_other_times_and_folders_without_results_are_refused(capture, release, tmp_path):
    with pytest.raises(UserError, match=r"3 folders t<seconds>, none of .* lasts from 7\.000 to"):
        _read(capture, release, start=CLOCK_S)
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"holds none of res\.pkl.* t<seconds> and none of smpl"):
        _read(capture, tmp_path / "empty")
    with pytest.raises(UserError, match="cannot be read"):
        _read(capture, tmp_path / "none")


def test_closed_copy_of_the_template_is_accepted_not_a_moved_one(capture, release, tmp_path):
    template = trimesh.load(capture.object_.mesh, process=False)
    objects = release.parents[1] / "objects" / "suitcase"
    objects.mkdir(parents=True)
    shutil.copy(Path(capture.object_.mesh), objects / "suitcase_f1000.ply")
    # more vertices at one end: the same surface with another mean of the vertices
    high = np.flatnonzero(template.triangles_center[:, 1] > template.vertices[:, 1].mean())
    finer = template.subdivide(face_index=high)
    assert np.linalg.norm(finer.vertices.mean(0) - template.vertices.mean(0)) > 0.005
    finer.export(tmp_path / "closed.ply")
    closed = capture.object_.model_copy(update={"mesh": tmp_path / "closed.ply"})
    _only_first_person(release)
    results = _read(capture, release, object_=closed)
    assert results.translation == pytest.approx(capture.translation, abs=1e-6)
    template.apply_translation([0, 0.05, 0])
    template.export(tmp_path / "moved.ply")
    other = capture.object_.model_copy(update={"mesh": tmp_path / "moved.ply"})
    with pytest.raises(UserError, match=r"moved.ply: does not lie on .*suitcase_fit.ply.* mm from"):
        _read(capture, release, object_=other)


def test_person_alone_needs_no_object(capture, release):
    for t in range(1, TOTAL):
        shutil.rmtree(_folder_of(release, t))
    (release / "t0000.000" / "suitcase" / "fit01" / "suitcase_fit.pkl").write_bytes(
        pickle.dumps(None)
    )
    results = _read(capture, release, object_=None)
    assert results.known.tolist() == [True, False, False] and np.isnan(results.translation).all()
