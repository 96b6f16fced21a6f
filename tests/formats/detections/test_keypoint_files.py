"""Files of keypoints: which image they mean, and what is survived or refused."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.errors import UserError
from intercap_core.formats.detections.image_numbers import CameraImages
from intercap_core.formats.detections.keypoint_files import preview_keypoints, read_camera
from intercap_core.formats.detections.keypoints.coco import WHOLE_BODY
from intercap_core.formats.detections.people_of_camera import KeypointCleaner

SIZE = (1920, 1080)
COUNT = 4
AT = KEYPOINT_NAMES.index


def images(stems: tuple[str, ...] = ()) -> CameraImages:
    number = np.arange(COUNT)
    return CameraImages("k1", SIZE, number, number, frozenset(range(COUNT)), stems)


def whole(x: float = 100.0, **more) -> dict:
    values = np.column_stack([x + np.arange(133), 6.0 * np.arange(133) + 5, np.full(133, 0.7)])
    return {"keypoints": values.ravel().tolist(), "score": 0.9} | more


def openpose(*x: float) -> dict:
    return {"people": [{"pose_keypoints_2d": [v for i in range(25) for v in (x_ + i, 900, 0.7)]}
                       for x_ in x]}  # fmt: skip


def read(folder: Path, camera: CameraImages | None = None, full: float = 1.0):
    return read_camera(folder, camera or images(), full_confidence=full)


def write(path: Path, content) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def noses(found) -> dict[int, list[float]]:
    return {n: people[:, 0, 0].tolist() for n, people in sorted(found.by_image.items())}


@pytest.mark.parametrize("name", ["k1.json", "results_k1.json", "k1/alphapose-results.json"])
def test_one_file_a_camera(tmp_path, name):
    write(tmp_path / name, [whole(100, image_id=0), whole(300, image_id=2), whole(5, image_id=2)])
    found = read(tmp_path)
    assert noses(found) == {0: [100], 1: [], 2: [300, 5], 3: []} and found.notes == []


def test_one_file_an_image(tmp_path):
    for n, content in enumerate(([whole(100)], [], {"instance_info": [whole(300), whole(5)]})):
        write(tmp_path / "k1" / f"{'results_' * (n == 2)}{n:04d}.json", content)
    found = read(tmp_path)
    assert noses(found) == {0: [100], 1: [], 2: [300, 5]}
    assert found.notes == ["no keypoint file for 1 images"]


def test_files_named_after_the_images_follow_them(tmp_path):
    stems = tuple(f"shot_{n}" for n in range(1, COUNT + 1))
    for n in range(1, COUNT + 2):
        write(tmp_path / "k1" / f"results_shot_{n}.json", [whole(n)])
    found = read(tmp_path, images(stems))
    assert noses(found) == {n: [n + 1.0] for n in range(COUNT)}
    assert found.notes == ["1 keypoint files belong to no image (first: shot_5)"]
    named = [whole(n, image_id=f"shot_{n}.jpg") for n in (2, 4, 9)]
    with pytest.raises(
        UserError, match=r"k1.json: .* and so do the 5 files in .*results_shot_1.json"
    ):
        read(write(tmp_path / "k1.json", named).parent)
    found = read(write(tmp_path / "other" / "k1.json", named).parent, images(stems))
    assert noses(found) == {0: [], 1: [2], 2: [], 3: [4]}
    assert "1 results in" in found.notes[0] and "shot_9.jpg" in found.notes[0]


def test_openpose_files_may_hold_other_layouts(tmp_path):
    write(tmp_path / "k1" / "0_keypoints.json", openpose(10, 20))
    write(tmp_path / "k1" / "1_keypoints.json", [whole(30)])
    write(tmp_path / "k1" / "2_keypoints.json", {"people": []})
    assert noses(read(tmp_path)) == {0: [10, 20], 1: [30], 2: []}


def test_a_camera_without_files_is_noted(tmp_path):
    found = read(tmp_path)
    assert found.by_image == {} and f"{tmp_path.name}/k1.json" in found.notes[0]
    (tmp_path / "k1").mkdir()
    assert read(tmp_path).notes == [f"no keypoint file for {COUNT} images"]


def test_cut_files_and_other_layouts_are_left_out(tmp_path):
    write(tmp_path / "k1" / "0_keypoints.json", openpose(10))
    write(tmp_path / "k1" / "1_keypoints.json", '{"people": [')
    write(tmp_path / "k1" / "2_keypoints.json", {"people": [{"pose_keypoints_2d": [1.0] * 54}]})
    write(tmp_path / "k1" / "3_keypoints.json", {"bodies": []})
    found = read(tmp_path)
    assert noses(found) == {0: [10]}
    broken, layouts = found.notes
    assert "k1/1_keypoints.json" in broken
    assert layouts.startswith("2 people or files of keypoints left out")
    assert "2_keypoints.json has 54 numbers in people[0].pose_keypoints_2d, expected 75" in layouts
    assert "expected OpenPose's 'people'" in layouts
    assert str(tmp_path) not in " ".join(found.notes), "artefacts know no absolute paths"


def test_a_cut_file_leaves_the_camera_without_keypoints(tmp_path):
    write(tmp_path / "k1.json", "[{")
    found = read(tmp_path)
    assert found.by_image == {} and "k1.json is not valid JSON" in found.notes[0]


def test_people_of_another_length_are_left_out_of_a_file(tmp_path):
    faulty = {"image_id": 1, "keypoints": [1.0] * 150}
    write(tmp_path / "k1.json", [whole(100, image_id=0), faulty])
    found = read(tmp_path)
    assert noses(found) == {0: [100], 2: [], 3: []}, "nobody is not known of image 1"
    assert "entry 1 (image 1): has 50 keypoints" in found.notes[0]


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("k1.json", [{"image_id": 0, "keypoints": [1.0] * 150}], "has 50 keypoints"),
        ("k1.json", {"bodies": []}, "expected a list of people"),
        ("k1.json", openpose(3), "expected a list of people"),
        ("k1/0_keypoints.json", {"people": [{"pose_keypoints_2d": [1.0] * 54}]}, "54 numbers"),
        ("k1/0.json", [{"keypoints": [1.0] * 150}], "has 50 keypoints"),
    ],
)
def test_keypoints_without_a_usable_person_are_refused(tmp_path, name, content, words):
    write(tmp_path / name, content)
    with pytest.raises(
        UserError, match=r"none of camera k1's keypoints can be used: \S*.json.*" + words
    ):
        read(tmp_path)


def test_two_files_of_one_image_are_refused(tmp_path):
    for name in ("1_keypoints.json", "a_01_keypoints.json"):
        write(tmp_path / "k1" / name, openpose(3))
    with pytest.raises(UserError, match=r"two keypoint files, 1_keypoints\.json and a_01_"):
        read(tmp_path)


def test_openpose_files_are_matched_by_number(tmp_path):
    write(tmp_path / "k1" / "k1_000000000002_keypoints.json", openpose(10))
    write(tmp_path / "k1" / "00003_keypoints.json", openpose(20))
    write(tmp_path / "k1" / "._00001_keypoints.json", "no JSON")
    write(tmp_path / "k1" / "notes.txt", "")
    assert noses(read(tmp_path)) == {2: [10], 3: [20]}


def changed(**points) -> np.ndarray:
    person = np.zeros((1, 135, 3))
    person[0] = np.column_stack([100.0 + np.arange(135), np.full(135, 50.0), np.full(135, 0.5)])
    for name, values in points.items():
        person[0, AT(name)] = values
    return person


@pytest.mark.parametrize(
    "values",
    [
        (np.nan, 5, 0.9), (5, np.inf, 0.9), (5, 5, np.nan), (5, 5, 0), (5, 5, -0.2), (0, 0, 0.9),
        (-0.6, 5, 0.9), (1919.6, 5, 0.9), (5, 1079.6, 0.9), (1e30, 5, 0.9),
    ],
)  # fmt: skip
def test_impossible_points_are_not_seen(values):
    (person,) = KeypointCleaner(SIZE).clean(changed(nose=values))
    assert (person[0] == 0).all() and (person[1:, 2] == 0.5).all() and person.dtype == np.float32


def test_points_beyond_the_edge_are_removed_and_counted():
    kept = changed(nose=(-0.5, 1079.4, 0.9), neck=(1919.4, 0, 0.9), mid_hip=(2000, 5, 0.9))
    values = KeypointCleaner(SIZE)
    (person,) = values.clean(kept)
    assert person[AT("nose"), 2] > 0 and person[AT("neck"), 2] > 0 and person[8, 2] == 0
    (note,) = values.notes()
    assert note.startswith("1 of 135 keypoints lie outside the image of 1920x1080")
    assert "another size" not in note
    values = KeypointCleaner((160, 90))
    values.clean(changed() * (2, 1, 1))
    assert "are they of images of another size" in values.notes()[0]


def test_confidence_is_cut_and_scaled():
    person = changed(nose=(1000, 5, 1.3), neck=(5, 5, 4.0))
    values = KeypointCleaner(SIZE)
    (cut,) = values.clean(person)
    assert cut[[0, 1], 2].tolist() == [1, 1] and cut[2, 2] == 0.5
    assert "2 of 135 confidences are beyond 1" in values.notes()[0]
    assert "keypoint_full_confidence" in values.notes()[0]
    values = KeypointCleaner(SIZE, full_confidence=4.0)
    (scaled,) = values.clean(person)
    np.testing.assert_allclose(scaled[[0, 1, 2], 2], [0.325, 1, 0.125])
    assert values.notes() == []


@pytest.mark.parametrize("value", [0.0, None])
def test_the_preview_notes_people_without_points(tmp_path, value):
    empty = whole(image_id=0) | {"keypoints": [value] * 399}
    look = partial(preview_keypoints, tmp_path, images(), full_confidence=1.0)
    write(tmp_path / "k1.json", [empty, empty])
    (note,) = look().notes
    assert "k1.json: none of its first 2 people has a point" in note
    write(tmp_path / "k1.json", [empty, whole(image_id=1)])
    assert look().notes == []
    write(tmp_path / "k1.json", [])
    assert look().notes == []


def test_people_of_zeros_or_of_shares_are_nobody():
    values = KeypointCleaner(SIZE)
    assert len(values.clean(np.zeros((2, 135, 3)))) == 0 and values.notes() == []
    shares = changed() * (1 / 250, 1 / 250, 1)
    assert len(values.clean(np.concatenate([shares, changed()]))) == 1
    assert "coordinates must be pixels" in values.notes()[0]
    assert KeypointCleaner(SIZE).clean(np.zeros((0, 135, 3))).shape == (0, 135, 3)


def test_changed_points_are_noted_with_the_camera(tmp_path):
    entry = whole(100, image_id=0)
    entry["keypoints"][0], entry["keypoints"][5] = 5000.0, 7.0
    write(tmp_path / "k1.json", [entry])
    outside, beyond = read(tmp_path).notes
    assert outside.startswith("1 of 133") and beyond.startswith("1 of 133")
    assert noses(read(tmp_path)) == {0: [0], 1: [], 2: [], 3: []}
    assert len(WHOLE_BODY) == 133
