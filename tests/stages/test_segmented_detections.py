"""Candidates from a segmentation model for the images without a file."""

from __future__ import annotations

import hashlib
import json
import logging

import cv2
import numpy as np
import pytest

from tests.helpers.plain_capture import detect, plain_entry, write_rig

pytest.importorskip("onnxruntime")
tiny_onnx = pytest.importorskip("tests.helpers.tiny_onnx", exc_type=ImportError)

from intercap_core import artefacts  # noqa: E402
from intercap_core.entries import SequenceEntry  # noqa: E402
from intercap_core.geometry.camera import masks  # noqa: E402
from intercap_core.schemas import DETECTIONS  # noqa: E402

WIDTH, HEIGHT, COUNT = 160, 96, 5
NAMES = {"names": "{0: 'suitcase', 1: 'cup'}"}


def thing(number: int) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.circle(mask, (30 + 20 * number, 45), 16, 1, -1)
    return mask > 0


@pytest.fixture
def capture(tmp_path) -> SequenceEntry:
    """Two cameras that see a red disc move; the model's candidates are those of 'left'."""
    for c, folder in enumerate(write_rig(tmp_path, (WIDTH, HEIGHT), 150).values()):
        for number in range(COUNT):
            image = np.full((HEIGHT, WIDTH, 3), 110 + 5 * c, np.uint8)
            image[thing(number)] = (20, 20, 230)
            cv2.imwrite(str(folder / f"shot_{number + 1:04d}.jpg"), image)
    candidates = tmp_path / "candidates"
    candidates.mkdir()
    mask = masks.encode(thing(0)).decode()
    entry = {"image_id": 0, "category_name": "from a file", "score": 0.5,
             "segmentation": {"size": [HEIGHT, WIDTH], "counts": mask}}  # fmt: skip
    (candidates / "right.json").write_text(json.dumps([entry]))
    return plain_entry(tmp_path, candidates=candidates)


def test_images_without_candidates_are_segmented(capture, tmp_path, caplog):
    path = tiny_onnx.yolo(tmp_path / "model.onnx", (160, 160), NAMES)
    with caplog.at_level(logging.INFO, "intercap_core"):
        read = detect(capture, "detections.h5", segmentation_model=path)
    assert read.candidates_found.all() and read.notes == ("no candidates candidates/left.json", "")
    for t in range(COUNT):
        (left,) = read.candidates(t, 0)
        assert left.label == "suitcase" and left.score == pytest.approx(0.9)
        both = left.mask() & thing(t)
        assert both.sum() / (left.mask() | thing(t)).sum() > 0.85
    assert [c.label for c in read.candidates(0, 1)] == ["from a file"]
    assert read.candidates(1, 1) == [], "the file says that there is nothing"
    assert f"segmented {COUNT} of {COUNT} images" in caplog.text
    with artefacts.read(tmp_path / "detections.h5", DETECTIONS) as artefact:
        name, digest = artefact.attributes["segmentation_model"].split()
    assert name == "model.onnx" and digest == hashlib.sha256(path.read_bytes()).hexdigest()
    moved = tmp_path / "elsewhere" / "model.onnx"
    moved.parent.mkdir()
    path.rename(moved)
    detect(capture, "again.h5", segmentation_model=moved)
    first, second = (tmp_path / name for name in ("detections.h5", "again.h5"))
    assert first.read_bytes() == second.read_bytes()
