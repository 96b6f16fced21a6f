"""COCO results: every form of a segmentation, and every way an entry can be wrong."""

from __future__ import annotations

import json
import os
import re

import numpy as np
import pytest

from intercap_core.formats.detections.class_names import COCO_NAMES, COCO_NAMES_FROM_0
from intercap_core.formats.detections.coco import (
    ImageKey,
    UnreadableDetections,
    parse_candidates,
    read_json,
)
from intercap_core.geometry.camera import masks

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


def read(tmp_path, content, **options):
    path = tmp_path / "k1.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    names, score = options.pop("names", COCO_NAMES), options.pop("min_score", 0.05)
    return parse_candidates(read_json(path), (WIDTH, HEIGHT), names, min_score=score, **options)


def instances(found, number):
    return [instance for key, instance in found.results if key.number == number]


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
        {"size": SIZE, "counts": str(RLE)},
        {"size": SIZE, "counts": counts},
        [[10, 4, 22, 4, 22, 9, 10, 9]],
        [[10, 4, 16, 4, 16, 9, 10, 9], [16, 4, 22, 4, 22, 9, 16, 9]],
        [10, 4, 22, 4, 22, 9, 10, 9],
        {"x": [10, 22, 22, 10], "y": [4, 4, 9, 9]},
    ]
    content = [ENTRY | {"segmentation": form} for form in forms]
    found = instances(read(tmp_path, content), 7)
    assert [i.label for i in found] == ["person"] * len(forms)
    for instance in found:
        np.testing.assert_array_equal(masks.decode(instance.rle, HEIGHT, WIDTH), MASK)


def test_outlines_of_real_shapes_are_filled():
    angle = np.linspace(0, 2 * np.pi, 5000, endpoint=False)
    outline = np.column_stack([500 + 400 * np.cos(angle), 300 + 250 * np.sin(angle)])
    filled = masks.decode(masks.from_polygons([outline.ravel().tolist()], 600, 1000), 600, 1000)
    assert abs(filled.sum() - np.pi * 400 * 250) < 2000


def test_labels_scores_boxes_and_order(tmp_path):
    entries = [
        ENTRY | {"score": 0.01},
        ENTRY | {"category_name": "stool"},
        {k: v for k, v in ENTRY.items() if k != "bbox"} | {"category_id": 500, "image_id": 2},
    ]
    result = read(tmp_path, entries)
    assert [i.label for i in instances(result, 7)] == ["stool"]
    (unknown,) = instances(result, 2)
    assert unknown.label == "category 500" and unknown.box == (10, 4, 12, 5)
    assert result.images is None
    whole = {
        "images": [{"id": 7}, {"id": 8}],
        "categories": [{"id": 1, "name": "skateboard"}],
        "annotations": [ENTRY],
    }
    result = read(tmp_path, whole)
    assert result.images == [ImageKey(7, None), ImageKey(8, None)]
    assert instances(result, 7)[0].label == "skateboard"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"image_id": 1.5}, "image_id"),
        ({"segmentation": None}, "no segmentation"),
        ({"segmentation": {"counts": "x"}}, "size is None"),
        (
            {"segmentation": {"size": [30, 20], "counts": RLE.decode()}},
            "20x30 pixels, the image 30x20",
        ),
        ({"segmentation": {"size": [2**40, 2**40], "counts": "0"}}, "expected .20, 30."),
        ({"segmentation": {"x": [1], "y": []}}, "no segmentation"),
        ({"segmentation": [["a"] * 6]}, "polygon"),
        ({"category_name": "c" * 500}, "500 characters"),
        ({"segmentation": {"size": SIZE, "counts": RLE.decode()[:-2]}}, "image 7.*runs hold"),
        ({"segmentation": {"size": SIZE, "counts": [1, 2]}}, "runs hold 3"),
        ({"segmentation": {"size": SIZE, "counts": None}}, "no segmentation"),
        ({"segmentation": [[1, 2, 1e9, 4, 5, 6]]}, "coordinate 1e.09"),
        ({"segmentation": [[1, 2, float("nan"), 4, 5, 6]]}, "corners"),
        ({"score": "high"}, "score"),
        ({"bbox": [1, 2]}, "bbox"),
        ({"bbox": [1, 2, 3, float("nan")]}, "bbox"),
        ({"category_id": None}, "category_id"),
        ({"image_id": -1}, "image_id.*-1"),
        ({"image_id": 10**400}, "image_id.*found inf"),
        ({"score": float("inf")}, "score is inf"),
        ({"segmentation": {"size": SIZE, "counts": [10**400]}}, "whole numbers"),
        ({"segmentation": {"size": SIZE, "counts": "\ud800"}}, "alphabet"),
        ({"segmentation": [[10**400] * 6]}, "entry 1"),
        ({"category_name": "\ud800"}, "not valid text"),
        ({"bbox": [1e300, 4, 12, 5]}, "pixels of the image of 30x20"),
        ({"bbox": [10, 4, -40, 5]}, "pixels of the image"),
        ({"score": 99}, "score is 99, expected a number from 0 to 1"),
        ({"segmentation": [[99999, 99999, -99999, 5, 7, -99999] * 2000]}, "polygons are more than"),
    ],
)
def test_wrong_entries_are_left_out_with_a_reason(tmp_path, change, words):
    result = read(tmp_path, [ENTRY, ENTRY | change, ENTRY])
    assert len(instances(result, 7)) == 2 and result.entries == 3
    (fault,) = result.faults
    assert re.search(words, fault) and fault.startswith("entry 1")


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{}",
        '{"annotations": [], "categories": 3}',
        '{"annotations": [], "images": [{"id": Infinity}]}',
        '{"annotations": [], "categories": [{"id": Infinity, "name": "a"}]}',
        '{"annotations": [], "categories": [{"id": 1, "name": "\\ud800"}]}',
        '"text"',
        '{"annotations": [], "images": 3}',
        '{"annotations": [], "categories": [{"id": 1, "name": "a"}, {"id": 1, "name": "b"}]}',
    ],
)
def test_wrong_files_are_refused(tmp_path, content):
    with pytest.raises(UnreadableDetections):
        read(tmp_path, content)


def test_huge_files_are_not_read(tmp_path):
    path = tmp_path / "k1.json"
    path.touch()
    os.truncate(path, 1 << 40)
    with pytest.raises(UnreadableDetections, match="one file an image"):
        read_json(path)


def test_entries_that_are_no_objects_are_left_out(tmp_path):
    result = read(tmp_path, ["x", 3, ENTRY])
    assert len(result.results) == 1 and len(result.faults) == 2


def test_masks_of_a_reduced_copy_are_scaled(tmp_path):
    small = MASK[::2, ::2]
    rle = {"size": [HEIGHT // 2, WIDTH // 2], "counts": masks.encode(small).decode()}
    result = read(tmp_path, [ENTRY | {"segmentation": rle, "bbox": [5, 2, 6, 3]}])
    (found,) = instances(result, 7)
    mask = masks.decode(found.rle, HEIGHT, WIDTH)
    assert (mask & MASK).sum() / (mask | MASK).sum() > 0.8 and result.scaled == 1
    assert found.box[2] >= 11  # in pixels of the image
    polygon = {
        "images": [{"id": 7, "width": WIDTH // 2, "height": HEIGHT // 2}],
        "annotations": [ENTRY | {"segmentation": [[5, 2, 11, 2, 11, 4.5, 5, 4.5]]}],
    }
    result = read(tmp_path, polygon)
    np.testing.assert_array_equal(masks.decode(instances(result, 7)[0].rle, HEIGHT, WIDTH), MASK)


def test_the_size_that_a_file_states_for_an_image_is_not_that_of_an_rle(tmp_path):
    content = {"images": [{"id": 7, "width": 50, "height": 50}], "annotations": [ENTRY]}
    result = read(tmp_path, content)
    assert not result.faults
    np.testing.assert_array_equal(masks.decode(instances(result, 7)[0].rle, HEIGHT, WIDTH), MASK)


def test_small_polygons_in_the_corner_are_pixels_unless_all_polygons_are_shares(tmp_path):
    corner, smooth, whole = [0, 0, 1, 0, 1, 1, 0, 1], [0.5, 0, 1.5, 0, 1.5, 2], [1, 1, 9, 1, 9, 9]
    share = [0.5, 0.5, 1, 0.5, 1, 1, 0.5, 1]
    for polygons, shares in (
        ([corner], 0),
        ([smooth, whole], 0),
        ([corner, share], 2),
        ([share, [float("nan")] * 6], 1),
    ):
        result = read(tmp_path, [ENTRY | {"segmentation": [polygon]} for polygon in polygons])
        assert result.shares == shares, polygons


CORNERS = [10, 4, 22, 9]
RLE_TEXT = {"size": SIZE, "counts": RLE.decode()}


@pytest.mark.parametrize(
    ("content", "key", "label", "score", "options"),
    [
        # detectron2, COCOEvaluator: coco_instances_results.json
        (
            [{"image_id": 3, "category_id": 47, "bbox": [10.0, 4.0, 12.0, 5.0], "score": 0.98,
              "segmentation": RLE_TEXT}],
            ImageKey(3, None), "cup", 0.98, {},
        ),
        # detectron2 without a data set's numbering
        (
            [{"image_id": 3, "category_id": 41, "bbox": [10.0, 4.0, 12.0, 5.0], "score": 0.98,
              "segmentation": RLE_TEXT}],
            ImageKey(3, None), "cup", 0.98, {"names": COCO_NAMES_FROM_0},
        ),
        # ultralytics, val with save_json: predictions.json
        (
            [{"image_id": "shot_0012", "file_name": "shot_0012.jpg", "category_id": 47,
              "bbox": [10.0, 4.0, 12.0, 5.0], "score": 0.98, "segmentation": RLE_TEXT}],
            ImageKey(None, "shot_0012"), "cup", 0.98, {},
        ),
        # ultralytics, Results.to_json of one image
        (
            [{"name": "cup", "class": 41, "confidence": 0.98,
              "box": {"x1": 10.0, "y1": 4.0, "x2": 22.0, "y2": 9.0},
              "segments": {"x": [10.0, 22.0, 22.0, 10.0], "y": [4.0, 4.0, 9.0, 9.0]}}],
            ImageKey(None, None), "cup", 0.98, {"one_image": True},
        ),
        # Segment Anything, automatic masks of one image
        (
            [{"segmentation": RLE_TEXT, "area": 60, "bbox": [10, 4, 12, 5], "predicted_iou": 0.98,
              "point_coords": [[12.0, 6.0]], "stability_score": 0.9, "crop_box": [0, 0, 30, 20]}],
            ImageKey(None, None), "", 0.98, {"one_image": True},
        ),
        # Grounded SAM 2, one image
        (
            {"image_path": "a/shot_0012.jpg", "box_format": "xyxy", "img_width": WIDTH,
             "img_height": HEIGHT,
             "annotations": [{"class_name": "cup", "bbox": CORNERS, "segmentation": RLE_TEXT,
                              "score": [0.98]}]},
            ImageKey(None, None), "cup", 0.98, {"one_image": True},
        ),
    ],
)  # fmt: skip
def test_formats_of_detectors(tmp_path, content, key, label, score, options):
    result = read(tmp_path, content, **options)
    ((found, instance),) = result.results
    assert not result.faults and found == key
    assert (instance.label, instance.score) == (label, score)
    assert instance.box == (10, 4, 12, 5)
    np.testing.assert_array_equal(masks.decode(instance.rle, HEIGHT, WIDTH), MASK)
