"""Keypoints from files, and from a model for the images without a file."""

from __future__ import annotations

import hashlib
import json
import logging
import subprocess
import sys

import cv2
import numpy as np
import pytest

from tests.helpers.plain_capture import detect, plain_entry, write_rig

pytest.importorskip("onnxruntime")
tiny_pose = pytest.importorskip("tests.helpers.tiny_pose", exc_type=ImportError)

from intercap_core import artefacts  # noqa: E402
from intercap_core.body.keypoints import KEYPOINT_NAMES  # noqa: E402
from intercap_core.entries import SequenceEntry  # noqa: E402
from intercap_core.errors import UserError  # noqa: E402
from intercap_core.geometry.camera import masks  # noqa: E402
from intercap_core.schemas import DETECTIONS  # noqa: E402

SIZE, COUNT = (640, 360), 3
SEEN = [KEYPOINT_NAMES.index(name) for name in tiny_pose.NAMES]


def places(number: int, camera: int) -> np.ndarray:
    return tiny_pose.person((200.0 + 60 * number, 40 + 20 * camera), 250)


@pytest.fixture
def capture(tmp_path) -> SequenceEntry:
    """Two cameras that see somebody walk; the second's last image shows nobody."""
    for c, folder in enumerate(write_rig(tmp_path, SIZE, 500).values()):
        for number in range(COUNT):
            nobody = c == 1 and number == COUNT - 1
            image = tiny_pose.picture(SIZE, [] if nobody else [places(number, c)])
            options = [cv2.IMWRITE_JPEG_QUALITY, 95]
            cv2.imwrite(str(folder / f"shot_{number + 1:04d}.jpg"), image, options)
    return plain_entry(tmp_path)


def whole_body(x: float) -> list[float]:
    return [v for i in range(133) for v in (x + i, 50.0, 0.5)]


def test_files_count_and_the_model_fills_the_rest(capture, tmp_path, caplog):
    keypoints, candidates = tmp_path / "keypoints", tmp_path / "candidates"
    for folder in (keypoints / "left", candidates):
        folder.mkdir(parents=True)
    (keypoints / "left" / "shot_0001.json").write_text(json.dumps([{"keypoints": whole_body(7)}]))
    mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    low, high = np.rint([places(1, 0).min(0) - 8, places(1, 0).max(0) + 8]).astype(int)
    mask[low[1] : high[1], low[0] : high[0]] = 1
    rle = {"size": mask.shape, "counts": masks.encode(mask).decode()}
    person = {"image_id": 1, "category_name": "person", "score": 0.8, "segmentation": rle}
    (candidates / "left.json").write_text(json.dumps([person]))
    row = capture.model_copy(update={"keypoints": keypoints, "candidates": candidates})
    path = tiny_pose.simcc(tmp_path / "pose.onnx")
    with caplog.at_level(logging.INFO, "intercap_core"):
        read = detect(row, keypoint_model=path, keypoint_full_confidence=2.0)
    assert read.keypoints_found.all() and "found people in 5 of 5 images" in caplog.text
    np.testing.assert_allclose(read.people(0, 0)[:, 0], [[7, 50, 0.25]])
    for t, c in ((1, 0), (2, 0), (0, 1), (1, 1)):
        (found,) = read.people(t, c)
        apart = np.linalg.norm(found[SEEN, :2] - places(t, c), axis=1)
        assert apart.max() < 1.6 and (found[SEEN, 2] > 0.25).all() and found[:, 2].max() <= 1
    assert len(read.people(2, 1)) == 0
    with artefacts.read(tmp_path / "detections.h5", DETECTIONS) as artefact:
        name, digest = artefact.attributes["keypoint_model"].split()
    assert name == "pose.onnx" and digest == hashlib.sha256(path.read_bytes()).hexdigest()
    detect(row, "again.h5", keypoint_model=path, keypoint_full_confidence=2.0)
    first, second = (tmp_path / name for name in ("detections.h5", "again.h5"))
    assert first.read_bytes() == second.read_bytes()


def test_a_model_of_another_kind_stops_the_stage(capture, tmp_path):
    from tests.helpers import tiny_onnx

    path = tiny_onnx.thresholder(tmp_path / "other.onnx")
    with pytest.raises(UserError, match=r"other.onnx: its outputs .* are not those of a pose"):
        detect(capture, keypoint_model=path)
    assert not (tmp_path / "detections.h5").exists()


def test_without_a_model_nothing_is_loaded():
    package = "intercap_core.formats.detections"
    words = (
        "import sys, intercap_core.stages.detections; names = {'onnxruntime', "
        f"'{package}.onnx_pose', '{package}.onnx_model'}}; sys.exit(bool(names & {{*sys.modules}}))"
    )
    assert subprocess.run([sys.executable, "-c", words]).returncode == 0
