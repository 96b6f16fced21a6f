"""People in COCO's manner: which point is which, in every form that the lists are written in."""

from __future__ import annotations

import re
from functools import partial

import numpy as np
import pytest

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.formats.detections.coco import ImageKey, UnreadableDetections
from intercap_core.formats.detections.keypoints import (
    KeypointLayout,
    find_layout,
    layouts,
    read_people,
    to_shared,
)
from intercap_core.formats.detections.keypoints.coco import WHOLE_BODY

AT = KEYPOINT_NAMES.index
# Numbers of COCO-WholeBody's points as its paper's figure and mmpose's data set file count them.
PUBLISHED = {
    0: "nose", 1: "left_eye", 4: "right_ear", 5: "left_shoulder", 10: "right_wrist",
    11: "left_hip", 16: "right_ankle", 17: "left_big_toe", 18: "left_small_toe", 19: "left_heel",
    20: "right_big_toe", 22: "right_heel", 23: "face_0", 31: "face_8", 40: "face_17",
    53: "face_30", 90: "face_67", 91: "left_hand_wrist", 92: "left_thumb1", 95: "left_thumb_tip",
    96: "left_index1", 103: "left_middle_tip", 111: "left_pinky_tip", 112: "right_hand_wrist",
    117: "right_index1", 129: "right_pinky1", 132: "right_pinky_tip",
}  # fmt: skip
CUTS = {"keypoints": (0, 17), "foot_kpts": (17, 23), "face_kpts": (23, 91),
        "lefthand_kpts": (91, 112), "righthand_kpts": (112, 133)}  # fmt: skip


def points(count: int = 133) -> np.ndarray:
    """(K, 3): x is the number of the point."""
    number = np.arange(count)
    return np.column_stack([number + 100.0, 2.0 * number + 7, 0.5 + number / 1000])


def flat(values: np.ndarray) -> list[float]:
    return values.ravel().tolist()


WHOLE = {"image_id": 3, "category_id": 1, "keypoints": flat(points()), "score": 0.9}
IN_PARTS = {"image_id": 3, "score": 0.9} | {
    key: flat(points()[first:last]) for key, (first, last) in CUTS.items()
}
MMPOSE = {
    "keypoints": points()[:, :2].tolist(),
    "keypoint_scores": points()[:, 2].tolist(),
    "bbox": [[10.0, 10.0, 50.0, 90.0]],
    "bbox_score": 0.8,
}


people_of = partial(read_people, one_image=False)


def only(content, **options) -> np.ndarray:
    found = people_of(content, **options)
    assert not found.faults
    ((_, person),) = found.results
    return person


def test_every_layout_names_known_points_once():
    for layout in layouts().values():
        assert len(layout.points) == len(set(layout.points))
        unused = {"head", "middle_of_shoulders", "upper_neck", "spine", "thorax"}
        unused |= {
            f"{side}_{end}"
            for side in ("left", "right")
            for end in ("palm", "foot", "fingers", "thumb")
        }
        assert set(layout.points) - set(KEYPOINT_NAMES) <= unused
    counts = sorted({len(layout.points) for layout in layouts().values()})
    assert counts == [17, 23, 25, 26, 133, 134, 136]
    assert set(KEYPOINT_NAMES) - set(WHOLE_BODY) == {"neck", "mid_hip"}


def test_whole_body_points_go_by_their_published_numbers():
    person = only([WHOLE])
    for number, name in PUBLISHED.items():
        np.testing.assert_allclose(person[AT(name)], points()[number], err_msg=name)
    assert (person[[AT("neck"), AT("mid_hip")]] == 0).all()
    assert (person[:, 2] > 0).sum() == 133


@pytest.mark.parametrize(
    "content",
    [
        [IN_PARTS],
        [WHOLE | {"keypoints": points().tolist()}],
        [WHOLE | {"keypoints": flat(points()[:, :2]), "keypoint_scores": flat(points()[:, 2])}],
        {"images": [{"id": 3}], "annotations": [WHOLE]},
        [MMPOSE | {"image_id": 3}],
        [MMPOSE | {"image_id": 3, "keypoints": [MMPOSE["keypoints"]]}],
        [{"frame_id": 3, "instances": [MMPOSE]}, {"frame_id": 0, "instances": []}],
        {"meta_info": {}, "instance_info": [{"frame_id": 4, "instances": [MMPOSE]}]},
    ],
    ids=["parts", "rows", "scores apart", "data set", "mmpose", "an axis", "frames", "demo"],
)
def test_every_form_is_the_same_person(content):
    found = people_of(content)
    ((key, person),) = found.results
    assert key == ImageKey(3, None) and not found.faults
    np.testing.assert_allclose(person, only([WHOLE]))


def test_files_of_one_image_need_not_name_it():
    np.testing.assert_allclose(only([MMPOSE], one_image=True), only([WHOLE]))
    demo = {"meta_info": {}, "instance_info": [MMPOSE]}
    np.testing.assert_allclose(only(demo, one_image=True), only([WHOLE]))
    assert people_of([], one_image=True).results == []


def test_frames_without_people_are_listed():
    video = [{"frame_id": n, "instances": [MMPOSE] * (n == 1)} for n in range(3)]
    found = people_of(video)
    assert found.images == [ImageKey(n, None) for n in range(3)]
    assert [key.number for key, _ in found.results] == [1]


def test_alphapose_names_its_images():
    halpe = {"image_id": "12.jpg", "keypoints": flat(points(136)), "score": 2.9}
    ((key, person),) = people_of([halpe]).results
    assert key == ImageKey(None, "12.jpg")
    published = {
        18: "neck", 19: "mid_hip", 20: "left_big_toe", 21: "right_big_toe", 25: "right_heel",
        26: "face_0", 94: "left_hand_wrist", 135: "right_pinky_tip",
    }  # fmt: skip
    for number, name in published.items():
        np.testing.assert_allclose(person[AT(name)], points(136)[number], err_msg=name)


def test_dwpose_order_gives_the_same_person():
    """As its tools make it of COCO-WholeBody's: the neck inserted, then sorted."""
    whole = points()
    sorted_ = np.insert(whole, 17, whole[[5, 6]].mean(0), axis=0)
    at = [1, 2, 3, 4, 6, 7, 8, 9, 10, 12, 13, 14, 15, 16, 17]
    sorted_[at] = sorted_[[17, 6, 8, 10, 7, 9, 12, 14, 16, 13, 15, 2, 1, 4, 3]]
    np.testing.assert_allclose(only([WHOLE | {"keypoints": flat(sorted_)}]), only([WHOLE]))


@pytest.mark.parametrize(
    "content",
    [
        [MMPOSE | {"image_id": 3, "keypoint_layout": "other"}],
        {"keypoint_layout": "other", "annotations": [MMPOSE | {"image_id": 3}]},
        {"meta_info": {"dataset_name": "other"},
         "instance_info": [{"frame_id": 4, "instances": [MMPOSE]}]},
    ],
    ids=["person", "file", "mmpose"],
)  # fmt: skip
def test_a_stated_layout_is_used_among_two_of_one_length(monkeypatch, content):
    other = KeypointLayout("other", WHOLE_BODY[::-1])
    monkeypatch.setitem(layouts(), "other", other)
    np.testing.assert_allclose(only(content), to_shared(points(), other.points))
    np.testing.assert_allclose(only([WHOLE]), to_shared(points(), WHOLE_BODY))


def test_a_layout_that_does_not_fit_is_refused(monkeypatch):
    for layout, count, words in (
        ("unknown", 133, "expected one of body_25, body_25b, coco, "),
        ("coco", 133, "expected the 17 of layout coco"),
        (["coco"], 17, "states keypoint_layout .'coco'., expected one of body_25"),
        (None, 50, "expected one of 17, 23, 25, 26, 133, 134, 136"),
    ):
        with pytest.raises(ValueError, match=words):
            find_layout(count, layout)
    for name in ("a", "b"):
        monkeypatch.setitem(layouts(), name, KeypointLayout(name, WHOLE_BODY[:50]))
    with pytest.raises(ValueError, match="as have layouts a, b; state 'keypoint_layout'"):
        find_layout(50)


def test_body_models_leave_hands_and_face_unseen():
    person = to_shared(points(17), find_layout(17).points)
    assert (person[:, 2] > 0).sum() == 17 and (person[25:] == 0).all()


def test_nan_and_none_stay_nan():
    values = flat(points())
    values[3], values[7] = float("nan"), None
    person = only([WHOLE | {"keypoints": values}])
    assert np.isnan(person[AT("left_eye"), 0]) and np.isnan(person[AT("right_eye"), 1])


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (7, "expected a person, found 7"),
        ({"image_id": 1, "pose": []}, "has no 'keypoints' but an object with image_id, pose"),
        ({"image_id": 1, "keypoints": flat(points(50))}, "50 keypoints, expected one of 17, 23"),
        ({"image_id": 1, "keypoints": flat(points())[:-1]}, r"has the shape \[398\]"),
        ({"image_id": 1, "keypoints": points()[:, :2].tolist()}, "x, y and 'keypoint_scores'"),
        ({"image_id": 1, "keypoints": "none"}, "keypoints is 'none', expected lists of numbers"),
        ({"image_id": 1, "keypoints": [[1, 2, 3], [4]]}, "expected lists of numbers"),
        ({"image_id": 1, "keypoints": [10**400] * 399}, "expected lists of numbers"),
        (IN_PARTS | {"face_kpts": flat(points(51))}, "face_kpts has 51 points, expected 68"),
        (WHOLE | {"face_kpts": flat(points(68))}, "keypoints has 133 points, expected 17"),
        (MMPOSE | {"image_id": 1, "keypoint_scores": [0.5] * 17}, r"\[133, 2\] .* \[17\]"),
        ({"keypoints": flat(points())}, "image_id must be the whole number"),
    ],
)
def test_unusable_people_are_reported_and_left_out(entry, words):
    found = people_of([entry, WHOLE])
    assert len(found.results) == 1 and found.entries == 2 and len(found.faulty) == 1
    (fault,) = found.faults
    assert fault.startswith("entry 0") and re.search(words, fault), fault


@pytest.mark.parametrize(
    "content",
    [None, 3, "x", {}, {"bodies": []}, {"annotations": {}}, {"images": 3, "annotations": []},
     [{"frame_id": "a", "instances": []}], [{"frame_id": 0, "instances": 3}]],
)  # fmt: skip
def test_files_of_another_layout_are_refused(content):
    with pytest.raises(UnreadableDetections):
        people_of(content)
