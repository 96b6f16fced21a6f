"""OpenPose files: order of the 135 points, and every way a file can be wrong."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.formats.detections.coco import UnreadableDetections
from intercap_core.formats.detections.keypoints.openpose import READER

COUNTS = {"pose_keypoints_2d": 25, "hand_left_keypoints_2d": 21, "hand_right_keypoints_2d": 21,
          "face_keypoints_2d": 70}  # fmt: skip


def person(base: float = 0.0) -> dict[str, list[float]]:
    """Every point's x tells which list and place it came from."""
    lists = {}
    for number, (name, count) in enumerate(COUNTS.items(), start=1):
        lists[name] = [
            v for i in range(count) for v in (base + 1000.0 * number + i, 2.0 * i + 1, 0.5)
        ]
    return lists


def read_people(content) -> np.ndarray:
    assert READER.recognises(content)
    people = [points for _, points in READER.read(content, True).results]
    return np.array(people).reshape(-1, 135, 3)


def test_lists_land_in_the_shared_order():
    people = read_people({"people": [person(), person(20000)]})
    assert people.shape == (2, 135, 3)
    x = people[0, :, 0]
    at = KEYPOINT_NAMES.index
    assert x[at("nose")] == 1000 and x[at("right_heel")] == 1024
    assert x[at("left_hand_wrist")] == 2000 and x[at("right_pinky_tip")] == 3020
    assert x[at("face_17")] == 4017 and x[at("face_67")] == 4067
    assert x[at("face_0")] == 4000 and x[at("face_16")] == 4016
    np.testing.assert_array_equal(people[1, :, 0], x + 20000)


def test_nobody_and_parts_that_were_not_looked_for():
    assert read_people({"people": []}).shape == (0, 135, 3)
    only_body = person() | {"hand_left_keypoints_2d": [], "face_keypoints_2d": []}
    del only_body["hand_right_keypoints_2d"]
    people = read_people({"people": [only_body]})
    assert (people[0, :25, 2] > 0).all() and (people[0, 25:] == 0).all()


def test_behaves_lists_are_one_person():
    names = ("body_joints", "left_hand_joints", "right_hand_joints", "face_joints")
    content = dict(zip(names, person().values(), strict=True))
    np.testing.assert_array_equal(read_people(content), read_people({"people": [person()]}))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"people": {}}, "no list 'people'"),
        ({"people": [[1, 2]]}, r"people\[0\]"),
        (
            {"people": [person() | {"pose_keypoints_2d": [0.0] * 54}]},
            r"54 numbers in people\[0\].* 75",
        ),
        ({"people": [person() | {"pose_keypoints_2d": ["x"] * 75}]}, "not a number"),
        ({"people": [person() | {"pose_keypoints_2d": [{}] * 75}]}, "not a number"),
        ({"people": [person() | {"pose_keypoints_2d": [[1.0, 2.0]] * 75}]}, "one flat list"),
        ({"people": [person() | {"face_keypoints_2d": "no"}]}, "expected 210"),
    ],
)
def test_other_layouts_are_named(content, words):
    with pytest.raises(UnreadableDetections, match=words):
        read_people(content)
