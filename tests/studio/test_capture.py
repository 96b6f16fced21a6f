"""A tiny capture: deterministic, readable by other programs, consistent with its truth."""

from __future__ import annotations

import json
from pathlib import Path

import av
import cv2
import h5py
import numpy as np
import pytest
import yaml
from pycocotools import mask as coco

from intercap_core import artefacts
from intercap_core.annotation import Annotation
from intercap_core.body.keypoints import BODY
from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.errors import UserError
from intercap_core.evaluation.motion import support
from intercap_core.evaluation.truth import Truth
from intercap_core.formats.calibration.extrinsics import read_extrinsics
from intercap_core.formats.calibration.k4a import parse_camera
from intercap_core.formats.recordings.k4a import KinectFile
from intercap_core.geometry.camera.clouds import master_points
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.schemas import HAND_HELD_TRUTH, TRUTH
from intercap_core.studio.capture import MARK, make_capture
from intercap_core.studio.subjects import Subject
from tests.helpers.fitted_capture import object_entry

FRAMES, CAMERAS = 3, 2
CAPTURE = StudioCapture(
    interaction="stool_sit", subject="s02", seed=77, frames=FRAMES, annotate=True, shoes="heavy"
)
SETTINGS = StudioSettings(captures={}, cameras=CAMERAS, colour_mode="720P")


def make(folder: Path) -> Path:
    stool = object_entry("stool")
    make_capture(CAPTURE, SETTINGS, sequence="tiny", objects=stool, output=folder)
    return folder


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("studio") / "tiny")


def claimed_camera(capture: Path, name: str) -> Camera:
    with KinectFile(capture / f"{name}.mkv") as recording:
        info = recording.info
    poses = read_extrinsics(capture / "calibration.json").master_from_colour
    return parse_camera(
        info.calibration, colour_mode=info.colour_mode, depth_mode=info.depth_mode, name=name,
        source=name, master_from_colour=poses[name],
    )  # fmt: skip


def images(path: Path) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Colour (H, W, 3) and depth (h, w) of a recording, read by PyAV alone."""
    colour, depth = [], []
    with av.open(str(path)) as container:
        streams = [s for s in container.streams if s.type == "video"]
        for packet in container.demux(streams):
            content = bytes(packet)
            if content[:2] == b"\xff\xd8":
                colour.append(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR))
            elif content:
                depth.append(np.frombuffer(content, ">u2").reshape(576, 640).astype(np.uint16))
    return colour, depth


def test_same_arguments_same_bytes(capture: Path, tmp_path: Path) -> None:
    """Also in a folder that lost its manifest: a workflow deletes what a job declares."""
    left = tmp_path / "again"
    left.mkdir()
    (left / MARK).touch()
    (left / "k9.mkv").write_bytes(b"half a recording")
    again = make(left)
    first, second = ((p / "capture.json").read_bytes() for p in (capture, again))
    assert first == second
    listed = json.loads(first)["files"]
    found = {p.relative_to(capture).as_posix() for p in capture.rglob("*") if p.is_file()}
    assert set(listed) == found - {"capture.json", MARK}


def test_recordings_open_elsewhere(capture: Path) -> None:
    for name in ("k1", "k2"):
        assert len(list((capture / "keypoints" / name).iterdir())) == FRAMES
        colour, depth = images(capture / f"{name}.mkv")
        assert len(colour) == len(depth) == FRAMES
        assert colour[0].shape == (720, 1280, 3)
        assert 20 < colour[0].mean() < 200
        assert 0.2 < (depth[0] > 0).mean() < 0.98


def test_depth_lies_on_the_true_surfaces(capture: Path) -> None:
    """Points of the depth camera, placed by the true rig, against the true object and floor."""
    with artefacts.read(capture / "truth.h5", TRUTH) as truth:
        poses = truth["master_from_colour"]
        rotation, translation = truth["rotation"][1], truth["translation"][1]
        vertices, faces = truth["object_vertices"], truth["object_faces"]
        normal = truth["ground_normal"]
        ground_offset = truth.attributes["ground_offset"]
    surface = DistanceField(vertices, faces)
    for index, name in enumerate(("k1", "k2")):
        camera = claimed_camera(capture, name).moved(poses[index])
        depth = images(capture / f"{name}.mkv")[1][1]
        points = master_points(depth, camera).points
        floor = np.abs(points @ normal + ground_offset)
        assert np.median(floor[floor < 0.05]) < 0.012
        local = (points - translation) @ rotation
        near = np.abs(surface.distance(local))
        assert (near < 0.03).sum() > 300
        assert np.median(near[near < 0.03]) < 0.012


def test_keypoints_err_by_a_few_pixels(capture: Path) -> None:
    with artefacts.read(capture / "truth.h5", TRUTH) as truth:
        joints, poses = truth["joints"], truth["master_from_colour"]
    # OpenPose's shoulders, elbows, wrists, hips, knees, ankles among the 55 joints
    rows = {2: 17, 3: 19, 4: 21, 5: 16, 6: 18, 7: 20, 8: 0, 10: 5, 11: 8, 13: 4, 14: 7}
    errors = []
    for index, name in enumerate(("k1", "k2")):
        camera = claimed_camera(capture, name).moved(poses[index])
        for t in range(FRAMES):
            path = capture / "keypoints" / name / f"{t:012d}_keypoints.json"
            for person in json.loads(path.read_text())["people"][:1]:
                body = np.array(person["pose_keypoints_2d"]).reshape(25, 3)
                assert len(person["face_keypoints_2d"]) == 210
                assert len(person["hand_left_keypoints_2d"]) == 63
                pose = camera.colour_from_master
                at = joints[t][list(rows.values())] @ pose[:3, :3].T + pose[:3, 3]
                off = camera.colour.project(at) - body[list(rows), :2]
                errors.append(np.linalg.norm(off, axis=1))
    assert errors
    assert 1.0 < np.median(np.concatenate(errors)) < 12.0
    assert BODY.stop == 25


def test_candidates_decode_and_cover_the_object(capture: Path) -> None:
    with artefacts.read(capture / "truth.h5", TRUTH) as truth:
        translation, poses = truth["translation"], truth["master_from_colour"]
    hits = 0
    for index, name in enumerate(("k1", "k2")):
        camera = claimed_camera(capture, name).moved(poses[index])
        results = json.loads((capture / "candidates" / f"{name}.json").read_text())
        assert {r["image_id"] for r in results} <= set(range(FRAMES))
        for result in results:
            rle = result["segmentation"]
            assert rle["size"] == [720, 1280]
            mask = coco.decode({"size": rle["size"], "counts": rle["counts"].encode()})
            assert mask.sum() > 0
            x, y, width, height = result["bbox"]
            rows, columns = np.nonzero(mask)
            assert (columns.min(), rows.min()) == (x, y)
            assert 0 < result["score"] <= 1
            if result["category"] in ("chair", "bench", "dining table", "toilet"):
                at = translation[result["image_id"]] @ camera.colour_from_master[:3, :3].T
                u, v = camera.colour.project(at + camera.colour_from_master[:3, 3])
                hits += bool(x <= u <= x + width and y <= v <= y + height)
    assert hits >= 3


def test_truth_stays_in_its_own_file(capture: Path) -> None:
    """No file but the truth holds a true camera pose, true lens or true object pose."""
    with h5py.File(capture / "truth.h5") as truth:
        numbers = np.concatenate([
            truth["master_from_colour"][1:, :3].ravel(), truth["translation"][0],
            truth["joints"][0, 20],
        ])  # fmt: skip
    written = [f"{abs(v):.6f}" for v in numbers if 0.01 < abs(v) < 0.99]
    for path in capture.rglob("*.json"):
        text = path.read_text()
        assert not [v for v in written if v in text], path
    claimed = read_extrinsics(capture / "calibration.json").master_from_colour["k2"]
    with h5py.File(capture / "truth.h5") as truth:
        true = truth["master_from_colour"][1]
    moved = np.linalg.norm(claimed[:3, 3] - true[:3, 3])
    turned = np.degrees(np.arccos((np.trace(claimed[:3, :3].T @ true[:3, :3]) - 1) / 2))
    assert moved == pytest.approx(0.010, rel=0.01)
    assert turned == pytest.approx(0.5, rel=0.01)


def test_annotation_errs_within_its_bounds(capture: Path) -> None:
    content = yaml.safe_load((capture / "annotation.yaml").read_text())
    annotation = Annotation.model_validate(content)
    assert annotation.check_frames(FRAMES) is None
    assert annotation.object_pose is not None and annotation.floor is not None
    with artefacts.read(capture / "truth.h5", TRUTH) as truth:
        true = truth["translation"][annotation.object_pose.frame]
        distance = np.array(annotation.floor) @ truth["ground_normal"]
        offset = truth.attributes["ground_offset"]
    error = np.linalg.norm(np.array(annotation.object_pose.translation) - true)
    assert 0 < error <= 0.0101
    assert np.abs(distance + offset).max() <= 0.0101


def test_foreign_folders_are_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(UserError, match="was not made by the studio"):
        make(tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_feet_in_heavy_shoes_count_as_supported(capture: Path) -> None:
    count = len(Subject.load("s02").fitted_face)
    truth = Truth.load(capture / "truth.h5", np.arange(FRAMES) / 15, 15, count)
    assert truth.vertices is not None
    height = truth.floor.height(truth.vertices)
    assert abs(height.min()) < 0.001
    standing = truth.vertices[:, height.max(0) < 0.01]
    still = np.repeat(standing[:1], 2, 0)
    assert support(still, truth.floor, 15).all()


def test_a_hand_held_camera_sees_the_object_from_its_true_poses(tmp_path: Path) -> None:
    walk = StudioCapture(
        interaction="bottle_scan", subject="s03", seed=9222, frames=3, camera="hand_held"
    )
    settings = SETTINGS.model_copy(update={"cameras": 1})
    folder = tmp_path / "walk"
    make_capture(walk, settings, sequence="walk", objects=object_entry("bottle"), output=folder)
    with artefacts.read(folder / "truth.h5", HAND_HELD_TRUTH) as truth:
        poses = truth["object_from_colour"]
        surface = DistanceField(truth["object_vertices"], truth["object_faces"])
    _, depths = images(folder / "k1.mkv")
    assert not (folder / "keypoints").exists() and len(depths) == len(poses) == 3
    camera = claimed_camera(folder, "k1")
    for depth, pose in zip(depths, poses, strict=True):
        points = master_points(depth, camera.moved(pose)).points
        distance = surface.distance(points[np.abs(points).max(1) < 0.3].astype(float))
        on_bottle = distance[distance < 0.03]
        assert len(on_bottle) > 1000 and np.median(on_bottle) < 0.008
    travelled = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert (travelled > 0.5).all()  # once around in three images
