"""Exports read back by the libraries of their formats."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import pickletools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest
import trimesh
from pycocotools.coco import COCO
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.body.loading import OPEN_BODY
from intercap_core.config import ExportSettings
from intercap_core.entries import Symmetry
from intercap_core.formats.recordings.synchronise import images_of_moments
from intercap_core.geometry.camera.masks import decode
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.inputs.arrays import read_pickle
from intercap_core.output.export import bop, coco
from intercap_core.output.export.about import ExportBody
from intercap_core.output.export.motion import read_motion, z_up_frame
from intercap_core.output.export.registry import formats
from intercap_core.output.export.silhouettes import Scenes
from intercap_core.schemas import METRICS
from intercap_core.stage_list import STAGES
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted

OFFSET = np.array([0, fitted.BODY_OFFSET_M, 0])
OBJECT_OFFSET = np.array([0, fitted.OBJECT_OFFSET_M / 2, 0])


README = Path(__file__).resolve().parents[3] / "README.md"


def test_settings_help_and_readme_list_all_formats() -> None:
    (tuple_, *_) = get_args(ExportSettings.model_fields["formats"].annotation)
    assert set(get_args(tuple_)) == set(formats())
    table = README.read_text(encoding="utf-8").split("\n## Formats\n")[1].split("\n## ")[0]
    for name in formats():
        assert f"`{name}`" in table and name in STAGES["export"].purpose, name


def test_moving_a_motion_forth_and_back(capture: fitted.Capture) -> None:
    motion = read_motion(capture.paths["joint"], 15.0, fitted.BODY_MODELS, "neutral")
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    pose[:3, 3] = [1, -2, 3]
    back = motion.moved(pose, "other").moved(np.linalg.inv(pose), "master")
    before, after = (
        Rotation.from_rotvec(m.parameters.global_orient.numpy()).as_matrix() for m in (motion, back)
    )
    assert after == pytest.approx(before, abs=1e-9)
    transl = motion.parameters.transl.numpy()
    assert back.parameters.transl.numpy() == pytest.approx(transl, abs=1e-9)
    assert back.translation == pytest.approx(motion.translation, abs=1e-9)


def test_intercap_result_is_a_plain_pickle_for_every_numpy(
    capture: fitted.Capture, everything: Path
) -> None:
    path = everything / "intercap" / "res.pkl"
    result = read_pickle(path)
    total = len(capture.vertices)
    assert result["body_pose"].shape == (1, 63 * total)
    assert result["left_hand_pose"].shape == (total, 12)
    assert result["betas"].shape == result["expression"].shape == (total, 10)
    assert isinstance(result["ob_pose"], list) and result["ob_trans"][0].shape == (3,)
    # the hands are at their mean, which 12 components hold exactly
    assert result["right_hand_pose"] == pytest.approx(0, abs=1e-5)
    rotation = Rotation.from_rotvec(result["ob_pose"][1]).as_matrix()
    assert rotation == pytest.approx(capture.rotation[1], abs=1e-6)
    assert result["ob_trans"][1] == pytest.approx(capture.translation[1] + OBJECT_OFFSET, abs=1e-6)
    names = [arg for op, arg, _ in pickletools.genops(path.read_bytes()) if op.name == "GLOBAL"]
    assert names and all("numpy._core" not in name for name in names)
    assert not any(b"numpy._core" in line for line in path.read_bytes().split(b"\n"))
    assert pickle.load(io.BytesIO(path.read_bytes())).keys() == result.keys()


def test_bop_poses_are_those_of_each_image_when_it_was_exposed(
    capture: fitted.Capture, tmp_path: Path
) -> None:
    """The second camera is a set late from set 2 on, and exposes 8 ms after the sets' times."""
    total, late = len(capture.vertices), np.array([0.0, 0.008, 0.0])
    times = np.arange(total) / fitted.FPS
    motion = read_motion(capture.paths["joint"], fitted.FPS, fitted.BODY_MODELS, "neutral")
    way = np.outer(times, [1.5, 0.0, 0.0])
    motion = replace(motion, translation=capture.translation[0] + way)
    slip = np.zeros((total, 3), np.int32)
    slip[2:, 1] = 1
    image_of = images_of_moments(slip, np.ones((total, 3), bool))
    scenes = Scenes(motion, capture.rig, capture.mesh, image_of, times, late, np.zeros((0, 0, 3)))
    bop.write(tmp_path, exported.content(scenes, capture.object_, masks=False))
    path = tmp_path / "test" / "000001"
    assert sorted(file.name for file in path.iterdir()) == [
        f"scene_{kind}.json" for kind in ("about", "camera", "gt")
    ]
    entries = json.loads((path / "scene_gt.json").read_text())
    assert sorted(entries) == sorted(json.loads((path / "scene_camera.json").read_text()))
    assert list(entries) == ["0", "1", "3"], "the image of set 2 repeats what that of set 1 is"
    pose = capture.rig[1].colour_from_master
    for image, moment in (("1", 1), ("3", 2)):
        there = capture.translation[0] + [1.5 * (times[moment] + 0.008), 0, 0]
        expected = 1e3 * (pose[:3, :3] @ there + pose[:3, 3])
        assert entries[image][0]["cam_t_m2c"] == pytest.approx(expected, abs=0.05)


def test_no_file_claims_smplx_for_another_mesh(capture: fitted.Capture, everything: Path) -> None:
    digest = hashlib.sha256(OPEN_BODY.read_bytes()).hexdigest()[:16]
    stated = exported.stated(everything)
    del stated["amass/object"]
    bodies = [about.get("body", about) for about in stated.values()]
    bodies.append(json.loads((everything / "export.json").read_text())["body"])
    for body in bodies:
        assert body["surface_model_type"] == "intercap-open-body"
        assert (body["body_file_digest"], body["gender"]) == (digest, "neutral")
        assert body["num_vertices"] == capture.model.num_vertices
    licensed = ExportBody(Path("SMPLX_MALE.npz"), "male", 10475, 10, 10)
    assert licensed.surface_model == "smplx" and not licensed.is_open


def test_coco_is_read_by_its_own_library(capture: fitted.Capture, everything: Path) -> None:
    read = COCO(str(everything / "coco" / "annotations.json"))
    assert len(read.getImgIds()) == 3 * len(capture.vertices)
    assert [c["name"] for c in read.loadCats(read.getCatIds())] == ["person", "cup"]
    for image in read.loadImgs(read.getImgIds()):
        camera = capture.rig[capture.rig.names.index(image["camera"])]
        annotations = read.loadAnns(read.getAnnIds(imgIds=image["id"], catIds=[coco.PERSON]))
        assert len(annotations) == 1
        mask = read.annToMask(annotations[0]) > 0
        assert mask.sum() == annotations[0]["area"]
        counts = annotations[0]["segmentation"]["counts"].encode()
        assert (decode(counts, image["height"], image["width"]) == mask).all()
        points = np.reshape(annotations[0]["keypoints"], (17, 3))
        assert annotations[0]["num_keypoints"] == (points[:, 2] > 0).sum()
        pose = camera.colour_from_master
        body = capture.vertices[image["frame"]] + OFFSET
        pixels = camera.colour.project(body @ pose[:3, :3].T + pose[:3, 3])
        low, high = pixels.min(0) - 3, pixels.max(0) + 3
        kept = points[points[:, 2] > 0, :2]
        assert (kept >= low).all() and (kept <= high).all()
    shoulders = [coco.KEYPOINTS.index(f"{side}_shoulder") for side in ("left", "right")]
    first = read.loadAnns(read.getAnnIds(catIds=[coco.PERSON]))[0]
    points = np.reshape(first["keypoints"], (17, 3))
    joints = capture.model.forward(capture.model.zeros(1)).joints  # order of sides is the model's
    assert joints.shape[1] == 55 and (points[shoulders, 2] > 0).any()


def test_the_bop_model_has_size_and_symmetries(capture: fitted.Capture, everything: Path) -> None:
    info = json.loads((everything / "bop" / "models" / "models_info.json").read_text())["9"]
    model = trimesh.load(everything / "bop" / "models" / "obj_000009.ply", process=False)
    assert model.vertices == pytest.approx(1e3 * capture.mesh.vertices, abs=1e-3)
    assert info["diameter"] == pytest.approx(1e3 * capture.mesh.diameter)
    assert info["size_z"] == pytest.approx(1e3 * np.ptp(capture.mesh.vertices[:, 2]))
    half = [-1, 0, 0, 0.01, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    group = SymmetryGroup.from_settings(Symmetry(discrete=(tuple(map(float, half)),)))
    info = bop.model_info(replace(capture.mesh, symmetry=group))
    assert info["symmetries_discrete"][0][3] == pytest.approx(10.0)
    ball = bop.model_info(
        replace(capture.mesh, symmetry=SymmetryGroup.from_settings(Symmetry(sphere=True)))
    )
    assert len(ball["symmetries_continuous"]) == 2
    assert bop.object_id(Path("09_cup.ply")) == 9 and bop.object_id(Path("cup.obj")) == 1


def test_manifest_is_complete(everything: Path) -> None:
    manifest = json.loads((everything / "export.json").read_text())
    files = {p.relative_to(everything).as_posix() for p in everything.rglob("*") if p.is_file()}
    assert set(manifest["files"]) == files - {"export.json"}
    for name, expected in manifest["files"].items():
        assert hashlib.sha256((everything / name).read_bytes()).hexdigest() == expected


def test_stated_errors_go_with_the_files(capture: fitted.Capture, everything: Path) -> None:
    with artefacts.read(capture.paths["metrics"], METRICS) as measured:
        body = 1e3 * measured["verdict/error"][0]
        factor = measured["verdict/error_factor"][0]
    stated = json.loads((everything / "export.json").read_text())["stated_error_mm"]
    assert stated["body"] == {"mean": round(body, 2), "factor": factor}
    text = (everything / "README.txt").read_text()
    assert f"mean body {body:.1f} mm ({body / factor:.1f} to {body * factor:.1f})" in text


@pytest.mark.parametrize(
    ("attributes", "words"),
    [
        ({"up_source": "cameras"}, "z-up: up from cameras taken to be level; "),
        ({"up_source": "stated"}, "z-up: up from the calibration; "),
        (
            {"up_source": "cameras, feet, balance", "up_deviation_deg": 2.14},
            "z-up: up from cameras taken to be level, the standing person's feet and the standing "
            "person's balance, +-2.1 degrees; ",
        ),
        ({"up_source": "gravity, cameras"}, "z-up: gravity-aligned by gravity sensors and cameras"),
        ({}, "does not name"),  # scenes of earlier versions
    ],
)
def test_without_a_floor_the_frame_names_the_source_of_up(
    attributes: dict[str, str], words: str
) -> None:
    scene: Any = SimpleNamespace(attributes={"ground_found": False} | attributes)
    name = z_up_frame(scene)
    assert words in name and "no floor is known" in name
    assert ("gravity-aligned" in name) == ("gravity" in attributes.get("up_source", ""))


def test_same_input_same_bytes(capture: fitted.Capture, everything: Path, tmp_path: Path) -> None:
    formats = json.loads((everything / "export.json").read_text())["formats"]
    out = exported.run(capture, tmp_path / "again", formats=formats)
    names = sorted(p.relative_to(out) for p in out.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(everything) for p in everything.rglob("*") if p.is_file())
    for name in names:
        assert (out / name).read_bytes() == (everything / name).read_bytes(), name
