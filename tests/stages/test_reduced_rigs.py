"""Stages on rigs of 1 to 16 cameras, with, with little and without depth."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.body.model import BodyModel
from intercap_core.config import (
    BodyFitSettings,
    BodyModels,
    ExportSettings,
    JointSettings,
    MetricsSettings,
    ObjectTrackSettings,
    PageSettings,
    PersonSettings,
)
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.schemas import JOINT, METRICS, OBJECT_TRACK, PERSON
from intercap_core.sequence_inputs import FitSettings, SequenceModels, SequencePaths
from intercap_core.stage_list import STAGES
from intercap_core.stages import (
    export,
    joint,
    metrics,
    object_track,
    page,
    person,
    summary,
)
from tests.geometry.rigid.conftest import catalogue
from tests.helpers import fitted_capture as fitted
from tests.helpers.body_capture import Inputs, ring, write_capture
from tests.helpers.object_capture import ObjectCapture
from tests.helpers.reduced_capture import Reduction
from tests.helpers.site import merge, row
from tests.helpers.synthetic_people import write_detections
from tests.stages.test_body_fit import SUBJECT, fit, motion

FAST = BodyFitSettings(points_per_frame=600, hands=False, face=False)
SETS = 2
FULL = pytest.mark.full


# --- the person and the body -------------------------------------------------------------------


def detected(paths: dict[str, Path], rig: Rig, path: Path) -> Path:
    """Detections that hold exactly the keypoints and masks of a person artefact."""
    with artefacts.read(paths["person"], PERSON) as known:
        keypoints = known["keypoints"]
        masks = artefacts.unpack_ragged(known["mask_offsets"], known["mask_rle"])
    images = list(np.ndindex(keypoints.shape[:2]))
    people = [[[points] for points in views] for views in keypoints]
    candidates = {at: [("person", mask)] for at, mask in zip(images, masks, strict=True)}
    return write_detections(path, rig, people, candidates)


class People:
    """A person who turns in a ring of cameras; ``joints`` (T, 55, 3) are true."""

    def __init__(self, model: BodyModel, folder: Path, cameras: int, sets: int = SETS) -> None:
        rig = ring(cameras)
        output = model.forward(model.parameters(motion(model, sets)))
        self.joints = output.joints.numpy()
        made = write_capture(
            folder, rig, output.vertices.double().numpy(), model.faces.numpy(),
            model.keypoints(output).double().numpy(), pixel_noise=0.5, depth_noise_mm=2.0,
        )  # fmt: skip
        self.paths = {"frames": made.frames, "scene": made.scene, "person": made.person}
        self.paths["detections"] = detected(self.paths, rig, folder / "detections.h5")
        del self.paths["person"]

    def placed(self, reduction: Reduction, folder: Path) -> dict[str, Path]:
        """The reduced artefacts and the person stage's."""
        paths = reduction.apply(self.paths, folder)
        person.run(**paths, output=folder / "person.h5", settings=PersonSettings())
        return paths | {"person": folder / "person.h5"}

    def fitted_mm(self, paths: dict[str, Path], folder: Path) -> tuple[np.ndarray, np.ndarray]:
        """Mean error of 22 joints (T,) of the body's fit, mm, and which frames failed."""
        inputs = Inputs(paths["frames"], paths["scene"], paths["person"])
        found = fit(inputs, folder / "body_fit.h5", settings=FAST)
        error = np.linalg.norm(found["joints"] - self.joints[: len(found["joints"])], axis=2)
        return 1000 * error[:, :22].mean(1), found["failed"]


@pytest.fixture(scope="module")
def people(model: BodyModel, tmp_path_factory: pytest.TempPathFactory) -> People:
    return People(model, tmp_path_factory.mktemp("people"), 6)


@pytest.mark.parametrize(
    ("reduction", "limit_mm"),
    [
        pytest.param(Reduction(depth=["k2", "k5"]), 15, id="some depth", marks=FULL),
        pytest.param(Reduction(depth=[]), 20, id="no depth"),
        pytest.param(Reduction(cameras=["k1", "k3"]), 25, id="two", marks=FULL),
        pytest.param(Reduction(cameras=["k1"]), 60, id="one"),
        pytest.param(
            Reduction(cameras=["k1", "k4", "k5"], images_until={"k1": 1}),
            25,
            id="one stops",
            marks=FULL,
        ),
        pytest.param(Reduction(keypoints=["k1", "k3"]), 25, id="keypoints in two", marks=FULL),
    ],
)
def test_body_on_reduced_rigs(people, tmp_path, reduction, limit_mm):
    paths = people.placed(reduction, tmp_path)
    with artefacts.read(paths["person"], PERSON) as found:
        assert not found["missing"].any()
    error, failed = people.fitted_mm(paths, tmp_path)
    assert not failed.any() and error.max() < limit_mm


def test_points_of_one_view_are_lifted_by_its_depth(people, tmp_path):
    with artefacts.read(
        people.placed(Reduction(cameras=["k1"]), tmp_path)["person"], PERSON
    ) as found:
        joints, views = found["joints"], found["joint_views"]
        assert set(np.unique(views)) == {0, 1} and (views[:, :25].mean(1) > 0.6).all()
        assert np.isnan(found["joint_error"]).all()
        np.testing.assert_array_equal(found["inlier"].sum(1), views)
    neck = np.linalg.norm(joints[:, 1] - people.joints[:, 12], axis=1)
    assert neck.max() < 0.08


def test_one_camera_without_depth_is_rejected(people, tmp_path):
    with pytest.raises(UserError, match=r"camera k1 alone sees anybody, without depth.*second"):
        people.placed(Reduction(cameras=["k1"], depth=[]), tmp_path)
    with pytest.raises(UserError, match="no image has keypoints of anybody"):
        people.placed(Reduction(keypoints=[]), tmp_path)


@FULL
def test_sixteen_cameras_place_the_person(model, tmp_path):
    many = People(model, tmp_path / "many", 16, sets=2)
    with artefacts.read(many.placed(Reduction(), tmp_path / "all")["person"], PERSON) as found:
        assert found["joint_views"][:, :25].min() >= 12
        neck = np.linalg.norm(found["joints"][:, 1] - many.joints[:, 12], axis=1)
        assert neck.max() < 0.01


# --- the object --------------------------------------------------------------------------------


def gliding(name: str, frames: int = 2, cameras: int = 6) -> ObjectCapture:
    entry = catalogue()[name]
    mesh = ObjectMesh.load(entry).simplified(600)
    return ObjectCapture.make(mesh, frames, cameras=cameras, label=entry.labels[0])


class Gliding(NamedTuple):
    """One object's capture and its artefacts."""

    made: ObjectCapture
    paths: dict[str, Path]

    @classmethod
    def make(cls, name: str, folder: Path) -> Gliding:
        made = gliding(name)
        return cls(made, made.write(folder))


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Gliding]:
    return {
        name: Gliding.make(name, tmp_path_factory.mktemp(name)) for name in ("suitcase", "football")
    }


def tracked(paths: dict[str, Path], output: Path, name: str = "suitcase") -> Path:
    object_track.run(
        **paths, output=output, object_=catalogue()[name], settings=ObjectTrackSettings()
    )
    return output


@pytest.mark.parametrize(
    ("name", "reduction", "limit_mm"),
    [
        pytest.param("suitcase", Reduction(depth=["k2", "k5"]), 6, id="some depth", marks=FULL),
        pytest.param("suitcase", Reduction(depth=[]), 10, id="no depth", marks=FULL),
        pytest.param("suitcase", Reduction(cameras=["k1"]), 15, id="one"),
        pytest.param(
            "football", Reduction(cameras=["k1", "k2"], depth=[]), 15, id="two without depth"
        ),
        pytest.param(
            "football", Reduction(images_until={"k1": 1, "k3": 1}), 6, id="two stop", marks=FULL
        ),
        pytest.param("football", Reduction(candidates=["k1", "k3"]), 6, id="few candidates"),
    ],
)
def test_object_on_reduced_rigs(objects, tmp_path, name, reduction, limit_mm):
    capture = objects[name].made
    paths = reduction.apply(objects[name].paths, tmp_path)
    with artefacts.read(tracked(paths, tmp_path / "object_track.h5", name), OBJECT_TRACK) as track:
        assert track.attributes["seed_source"] == "search" and not track["lost"].any()
        away = np.linalg.norm(track["translation"] - capture.poses[:, :3, 3], axis=1)
        assert 1000 * away.max() < limit_mm
        angle = capture.mesh.symmetry.rotation_error_deg(
            track["rotation"], capture.poses[:, :3, :3]
        )
        assert np.max(angle) < 10


def test_an_object_that_cannot_be_located_is_lost(objects, tmp_path):
    for name, reduction in (
        ("alone", Reduction(cameras=["k1"], depth=[])),
        ("none", Reduction(candidates=[])),
    ):
        paths = reduction.apply(objects["suitcase"].paths, tmp_path / name)
        path = tracked(paths, tmp_path / name / "object_track.h5")
        with artefacts.read(path, OBJECT_TRACK) as track:
            assert track["lost"].all() and np.isnan(track["translation"]).all()
            why = str(track.attributes["doubts"])
            assert "found in no frame" in why and "with depth or in two views" in why


def test_object_in_sixteen_views(tmp_path):
    many = gliding("football", frames=1, cameras=16)
    paths = many.write(tmp_path)
    track = tracked(paths, tmp_path / "object_track.h5", "football")
    with artefacts.read(track, OBJECT_TRACK) as found:
        assert found["views"][0] >= 10
        assert np.linalg.norm(found["translation"][0] - many.poses[0, :3, 3]) < 0.004


# --- from the joint fit to the report ----------------------------------------------------------


@pytest.mark.parametrize(
    "reduction",
    [
        pytest.param(Reduction(depth=[]), id="no depth", marks=FULL),
        pytest.param(Reduction(cameras=["k1"]), id="one camera", marks=FULL),
        pytest.param(Reduction(depth=["k1"], images_until={"k1": 1}), id="depth for one set"),
    ],
)
def test_later_stages_work_with_any_amount_of_depth(tmp_path, reduction):
    capture = fitted.make_capture(tmp_path / "whole", total=SETS)
    paths = reduction.apply(capture.paths, tmp_path / "reduced")
    measured = tmp_path / "metrics.h5"
    metrics.run(
        paths=SequencePaths(**{stage: paths[stage] for stage in STAGES["metrics"].reads}),
        models=capture.models,
        fit_settings=fitted.FIT_SETTINGS,
        output=measured,
        settings=MetricsSettings(),
        truth=capture.paths["truth"],
    )
    with artefacts.read(measured, METRICS) as found:
        seen = np.isfinite(found["body_visible_to_cloud"])
        depth = 0 if reduction.depth == [] else 1 if reduction.images_until else SETS
        assert seen.sum() == depth
        assert (found["truth/joint/body_pve"] < 0.02).all()
    inputs = SequencePaths(metrics=measured, **{s: paths[s] for s in STAGES["metrics"].reads})
    export.run(
        paths=inputs, models=capture.models, output=tmp_path / "export",
        settings=ExportSettings(formats=("bop", "coco")),  # those with images
    )  # fmt: skip
    summary.run(paths=inputs, sequence=row("cap"), output=tmp_path / "summary.h5")
    page.run(
        paths=inputs, models=capture.models, sequence=row("cap"), contact=None, truth=None,
        settings=PageSettings(frames=1, cameras=1), output=tmp_path / "page",
    )  # fmt: skip
    first = merge({"cap": tmp_path / "summary.h5"}, {"cap": capture}, tmp_path)
    assert "NaN" not in (tmp_path / "summary.json").read_text()
    for written in (first, tmp_path / "page" / "index.html"):
        assert ">nan<" not in written.read_text().lower()


def test_the_joint_fit_needs_no_depth(people, objects, tmp_path):
    no_depth = Reduction(sets=2, depth=[])
    paths = people.placed(no_depth, tmp_path)
    people.fitted_mm(paths, tmp_path)
    ball = no_depth.apply(objects["football"].paths, tmp_path / "object")
    track = tracked(ball, tmp_path / "track.h5", "football")
    joint.run(
        paths=SequencePaths(
            frames=paths["frames"], scene=paths["scene"], detections=paths["detections"],
            person=paths["person"], object_track=track, body_fit=tmp_path / "body_fit.h5",
        ),
        models=SequenceModels(catalogue()["football"], SUBJECT, BodyModels()),
        fit_settings=FitSettings(JointSettings(), FAST, ObjectTrackSettings()),
        output=tmp_path / "joint.h5",
    )  # fmt: skip
    with artefacts.read(tmp_path / "joint.h5", JOINT) as found:
        assert np.isnan(found["cloud_residual"]).all()
        error = np.linalg.norm(found["joints"] - people.joints[:2], axis=2)[:, :22].mean(1)
    assert error.max() < 0.025
