"""COCO results: every form of a segmentation, and every way an entry can be wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest

from intercap_core.detection import masks
from intercap_core.detection.coco import COCO_NAMES, read_candidates
from intercap_core.errors import UserError

HEIGHT, WIDTH = 20, 30
MASK = np.zeros((HEIGHT, WIDTH), bool)
MASK[4:9, 10:22] = True
RLE = masks.encode(MASK)
SIZE = [HEIGHT, WIDTH]
ENTRY = {
    "image_id": 7,
    "category_id": 1,
    "score": 0.9,
    "bbox": [10, 4, 12, 5],
    "segmentation": {"size": SIZE, "counts": RLE.decode()},
}


def read(tmp_path, content):
    path = tmp_path / "k1.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_candidates(path, width=WIDTH, height=HEIGHT, min_score=0.05)


def test_published_class_numbers():
    assert len(COCO_NAMES) == 80
    assert COCO_NAMES[1] == "person" and COCO_NAMES[33] == "suitcase" and COCO_NAMES[62] == "chair"
    assert COCO_NAMES[43] == "tennis racket" and COCO_NAMES[44] == "bottle"
    assert COCO_NAMES[47] == "cup" and COCO_NAMES[90] == "toothbrush"


def test_every_form_of_segmentation(tmp_path):
    counts = [10 * HEIGHT + 4, *([5, 15] * 12)[:-1]]
    counts.append(HEIGHT * WIDTH - sum(counts))
    forms = [
        {"size": SIZE, "counts": RLE.decode()},
        {"size": SIZE, "counts": counts},
        [[10, 4, 22, 4, 22, 9, 10, 9]],
    ]
    content = [ENTRY | {"segmentation": form} for form in forms]
    found = read(tmp_path, content).instances[7]
    assert [i.label for i in found] == ["person"] * 3
    for instance in found:
        np.testing.assert_array_equal(masks.decode(instance.rle, HEIGHT, WIDTH), MASK)


def test_labels_scores_boxes_and_order(tmp_path):
    entries = [
        ENTRY | {"score": 0.01},
        ENTRY | {"category_name": "stool"},
        {k: v for k, v in ENTRY.items() if k != "bbox"} | {"category_id": 500, "image_id": 2},
    ]
    result = read(tmp_path, entries)
    assert [i.label for i in result.instances[7]] == ["stool"]
    assert result.instances[2][0].label == "category 500"
    assert result.instances[2][0].box == (10, 4, 12, 5)
    assert result.images is None
    whole = {
        "images": [{"id": 7}, {"id": 8}],
        "categories": [{"id": 1, "name": "skateboard"}],
        "annotations": [ENTRY],
    }
    result = read(tmp_path, whole)
    assert result.images == {7, 8} and result.instances[7][0].label == "skateboard"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"image_id": "a"}, "image_id"),
        ({"image_id": True}, "image_id"),
        ({"segmentation": None}, "no segmentation"),
        ({"segmentation": {"counts": "x"}}, "size is None"),
        ({"segmentation": {"size": [30, 20], "counts": RLE.decode()}}, "expected .20, 30."),
        ({"segmentation": {"size": SIZE, "counts": RLE.decode()[:-2]}}, "image 7.*runs hold"),
        ({"segmentation": {"size": SIZE, "counts": "\u00e9\u00e9"}}, "alphabet"),
        ({"segmentation": {"size": SIZE, "counts": [1, 2]}}, "runs hold 3"),
        ({"segmentation": {"size": SIZE, "counts": None}}, "no segmentation"),
        ({"segmentation": [[1, 2, 3]]}, "corners"),
        ({"segmentation": [[1, 2, 1e9, 4, 5, 6]]}, "coordinate 1e.09"),
        ({"segmentation": [[1, 2, float("nan"), 4, 5, 6]]}, "corners"),
        ({"score": "high"}, "score"),
        ({"score": None}, "score"),
        ({"bbox": [1, 2]}, "bbox"),
        ({"bbox": [1, 2, 3, float("nan")]}, "bbox"),
        ({"category_id": None}, "category_id"),
        ({"image_id": float("inf")}, "image_id.*inf"),
        ({"image_id": -1}, "image_id.*-1"),
        ({"image_id": 10**400}, "image_id.*401 characters"),
        ({"score": 10**400}, "score is 1000"),
        ({"score": float("inf")}, "score is inf"),
        ({"bbox": [1, 2, 3, 10**400]}, "bbox"),
        ({"segmentation": {"size": SIZE, "counts": [10**400]}}, "whole numbers"),
        ({"segmentation": {"size": SIZE, "counts": "\ud800"}}, "alphabet"),
        ({"segmentation": [[10**400] * 6]}, "entry 1"),
        ({"category_name": "\ud800"}, "not valid text"),
    ],
)
def test_wrong_entries_are_named(tmp_path, change, words):
    with pytest.raises(UserError, match=words) as caught:
        read(tmp_path, [ENTRY, ENTRY | change])
    assert "k1.json, entry 1" in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "3",
        "{}",
        '{"annotations": [], "categories": 3}',
        '["x"]',
        '{"annotations": [], "images": [{"id": Infinity}]}',
        '{"annotations": [], "categories": [{"id": Infinity, "name": "a"}]}',
        '{"annotations": [], "categories": [{"id": 1, "name": "\\ud800"}]}',
        "[" * 100000,
    ],
)
def test_wrong_files_are_named(tmp_path, content):
    with pytest.raises(UserError, match=r"k1\.json"):
        read(tmp_path, content)
