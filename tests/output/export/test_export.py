"""Exports read back by the libraries of their formats."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import pickletools
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pygltflib
import pytest
import trimesh
from pycocotools.coco import COCO
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.body.loading import OPEN_BODY
from intercap_core.entries import Symmetry
from intercap_core.formats.recordings.synchronise import images_of_moments
from intercap_core.geometry.camera.masks import decode
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.inputs.arrays import read_pickle
from intercap_core.output.export import bop, coco
from intercap_core.output.export.about import ExportBody
from intercap_core.output.export.motion import read_motion
from intercap_core.output.export.silhouettes import Scenes
from intercap_core.schemas import METRICS
from intercap_core.stages import export
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted

OFFSET = np.array([0, fitted.BODY_OFFSET_M, 0])
OBJECT_OFFSET = np.array([0, fitted.OBJECT_OFFSET_M / 2, 0])


@pytest.fixture(scope="module")
def folder(capture: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported.run(capture, tmp_path_factory.mktemp("export") / "out")


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
    capture: fitted.Capture, folder: Path
) -> None:
    path = folder / "intercap" / "res.pkl"
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
    total, late = 5, np.array([0.0, 0.008, 0.0])
    times = np.arange(total) / fitted.FPS
    motion = read_motion(capture.paths["joint"], fitted.FPS, fitted.BODY_MODELS, "neutral")
    way = np.outer(times, [1.5, 0.0, 0.0])
    motion = replace(motion, translation=capture.translation[0] + way)
    slip = np.zeros((total, 3), np.int32)
    slip[2:, 1] = 1
    image_of = images_of_moments(slip, np.ones((total, 3), bool))
    scenes = Scenes(motion, capture.rig, capture.mesh, image_of, times, late, np.zeros((0, 0, 3)))
    bop.write(tmp_path / "bop", scenes, 9, exported.plain_about(motion), masks=False)
    path = tmp_path / "bop" / "scenes" / "000001"
    entries = json.loads((path / "scene_gt.json").read_text())
    assert sorted(entries) == sorted(json.loads((path / "scene_camera.json").read_text()))
    assert list(entries) == ["0", "1", "3", "4"], "the image of set 2 repeats what that of set 1 is"
    pose = capture.rig[1].colour_from_master
    for image, moment in (("1", 1), ("3", 2), ("4", 3)):
        there = capture.translation[0] + [1.5 * (times[moment] + 0.008), 0, 0]
        expected = 1e3 * (pose[:3, :3] @ there + pose[:3, 3])
        assert entries[image][0]["cam_t_m2c"] == pytest.approx(expected, abs=0.05)


def test_no_file_claims_smplx_for_another_mesh(capture: fitted.Capture, folder: Path) -> None:
    digest = hashlib.sha256(OPEN_BODY.read_bytes()).hexdigest()[:16]
    bodies = [
        json.loads((folder / "export.json").read_text())["body"],
        read_pickle(folder / "intercap" / "res.pkl")["about"]["body"],
        json.loads((folder / "bop" / "about.json").read_text())["body"],
        json.loads((folder / "coco" / "annotations.json").read_text())["info"]["body"],
        pygltflib.GLTF2().load(str(folder / "glb" / "cap.glb")).asset.extras["body"],
    ]
    for path in (folder / "amass" / "body.npz", folder / "intercap" / "res.npz"):
        with np.load(path) as arrays:
            bodies.append({key: arrays[key].item() for key in bodies[0]})
    for body in bodies:
        assert body["surface_model_type"] == "intercap-open-body"
        assert (body["body_file_digest"], body["gender"]) == (digest, "neutral")
        assert body["num_vertices"] == capture.model.num_vertices
    assert (folder / "body" / "open_body.npz").read_bytes() == OPEN_BODY.read_bytes()
    assert "it is not SMPL-X" in (folder / "README.txt").read_text()
    licensed = ExportBody(Path("SMPLX_MALE.npz"), "male", 10475, 10, 10)
    assert licensed.surface_model == "smplx" and not licensed.is_open


def test_bop_masks_are_what_the_body_leaves(capture: fitted.Capture, folder: Path) -> None:
    hidden = 0
    for number, camera in enumerate(capture.rig):
        scene = folder / "bop" / "scenes" / f"{number:06d}"
        info = json.loads((scene / "scene_gt_info.json").read_text())
        assert info.keys() == json.loads((scene / "scene_gt.json").read_text()).keys()
        for image, (entry,) in info.items():
            whole, seen = (
                cv2.imread(str(scene / name / f"{int(image):06d}_000000.png"), -1) > 0
                for name in ("mask", "mask_visib")
            )
            assert whole.shape == (camera.colour.height, camera.colour.width)
            assert not (seen & ~whole).any()
            counts = (entry["px_count_all"], entry["px_count_visib"])
            assert counts == (whole.sum(), seen.sum())
            if whole.any():
                assert entry["visib_fract"] == pytest.approx(seen.sum() / whole.sum())
                x, y, width, height = entry["bbox_obj"]
                assert cv2.boundingRect(whole.astype(np.uint8)) == (x, y, width, height)
            hidden += int((whole & ~seen).sum())
    assert hidden > 0  # the hand covers some of the cup
    targets = json.loads((folder / "bop" / "test_targets_bop19.json").read_text())
    assert targets and set(targets[0]) == {"scene_id", "im_id", "obj_id", "inst_count"}
    lens = json.loads((folder / "bop" / "camera.json").read_text())
    assert lens["fx"] == capture.rig[0].colour.fx


def test_coco_is_read_by_its_own_library(capture: fitted.Capture, folder: Path) -> None:
    read = COCO(str(folder / "coco" / "annotations.json"))
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


def test_images_are_exported_on_request(
    capture: fitted.Capture, folder: Path, tmp_path: Path
) -> None:
    assert not list(folder.rglob("*.jpg"))
    out = exported.run(capture, tmp_path / "out", formats=("bop", "coco"), images=True, masks=False)
    read = COCO(str(out / "coco" / "annotations.json"))
    for image in read.loadImgs(read.getImgIds()):
        picture = cv2.imread(str(out / "coco" / image["file_name"]))
        assert picture.shape[:2] == (image["height"], image["width"])
    assert len(list((out / "bop").rglob("rgb/*.jpg"))) == 3 * len(capture.vertices)
    assert not list(out.rglob("mask/*")) and not list(out.rglob("scene_gt_info.json"))


def test_the_bop_model_has_size_and_symmetries(capture: fitted.Capture, folder: Path) -> None:
    info = json.loads((folder / "bop" / "models" / "models_info.json").read_text())["9"]
    model = trimesh.load(folder / "bop" / "models" / "obj_000009.ply", process=False)
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


def test_manifest_is_complete_and_names_every_frame(folder: Path) -> None:
    manifest = json.loads((folder / "export.json").read_text())
    files = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert set(manifest["files"]) == files - {"export.json"}
    for name, expected in manifest["files"].items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == expected
    assert all("metres" in text for text in manifest["frame"].values())
    text = (folder / "README.txt").read_text()
    for word in ("master colour camera", "z-up", "millimetres", "x = R v + t", "pelvis"):
        assert word in text


def test_stated_errors_go_with_the_files(capture: fitted.Capture, folder: Path) -> None:
    with artefacts.read(capture.paths["metrics"], METRICS) as measured:
        body = 1e3 * measured["verdict/error"][0]
        factor = measured["verdict/error_factor"][0]
    stated = json.loads((folder / "export.json").read_text())["stated_error_mm"]
    assert stated["body"] == {"mean": round(body, 2), "factor": factor}
    text = (folder / "README.txt").read_text()
    assert f"mean body {body:.1f} mm ({body / factor:.1f} to {body * factor:.1f})" in text


@pytest.mark.parametrize(
    ("hint", "words"),
    [
        ("cameras", "mean of the cameras' own up"),
        ("stated", "as stated with the calibration"),
        ("gravity", "by the gravity sensors"),
        (None, "does not name"),  # scenes of earlier versions
    ],
)
def test_without_a_floor_exports_name_the_source_of_up(
    capture: fitted.Capture, tmp_path: Path, hint: str | None, words: str
) -> None:
    scene = shutil.copy(capture.paths["scene"], tmp_path / "scene.h5")
    with h5py.File(scene, "r+") as file:
        file.attrs["ground_found"] = False
        if hint:
            file.attrs["up_source"] = hint
    out = exported.run(replace(capture, paths=capture.paths | {"scene": scene}), tmp_path / "out")
    manifest = json.loads((out / export.MARKER).read_text())["frame"]
    for bodies in (manifest["amass"], manifest["glb"], (out / "README.txt").read_text()):
        assert words in bodies and "no floor is known" in bodies and "gravity-aligned" not in bodies


def test_same_input_same_bytes(capture: fitted.Capture, folder: Path, tmp_path: Path) -> None:
    out = exported.run(capture, tmp_path / "again")
    names = sorted(p.relative_to(out) for p in out.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    for name in names:
        assert (out / name).read_bytes() == (folder / name).read_bytes(), name
