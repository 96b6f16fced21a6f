"""Keypoints and candidates of public bug reports, and further cases of each kind."""

from __future__ import annotations

import json
import re
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.errors import UserError
from intercap_core.formats.detections import candidate_files, keypoint_files
from intercap_core.formats.detections.image_numbers import CameraImages
from intercap_core.formats.detections.keypoints import (
    compare_bones,
    layouts,
    read_people,
    to_shared,
)
from intercap_core.formats.detections.mask_files import MaskFile, read_masks
from intercap_core.formats.recordings.image_files import DamagedImage
from tests.cases import SEQUENCE, check, open_case

SIZE = (320, 240)
# A standing person, by name: x, y.
STANDING = {
    "nose": (160, 40), "neck": (160, 60), "mid_hip": (160, 120), "head": (160, 25),
    "upper_neck": (160, 52), "spine": (160, 90), "thorax": (160, 62),
} | {
    f"{side}_{name}": (160 + sign * x, y)
    for side, sign in (("left", 1), ("right", -1))
    for name, x, y in (
        ("eye", 4, 35), ("ear", 8, 37), ("shoulder", 20, 62), ("elbow", 27, 90), ("wrist", 30, 115),
        ("hip", 10, 121), ("knee", 12, 165), ("ankle", 13, 205), ("heel", 12, 212),
        ("big_toe", 18, 214), ("small_toe", 21, 213), ("palm", 31, 122), ("fingers", 32, 130),
        ("thumb", 29, 124), ("foot", 18, 214),
    )
}  # fmt: skip


def camera(count: int, stems: tuple[str, ...] = (), first: int | None = None) -> CameraImages:
    number = np.arange(count)
    times = number * 33_333
    return CameraImages("k1", SIZE, number, times, frozenset(range(count)), stems, first)


def person_of(layout: str) -> list[float]:
    return [v for name in layouts()[layout].points for v in (*STANDING[name], 0.9)]


def write_people(folder: Path, names: list[str], person: list[float]) -> None:
    (folder / "k1").mkdir(parents=True)
    for n, name in enumerate(names):
        moved = [v + n / 10 if i % 3 == 0 else v for i, v in enumerate(person)]
        content = {"people": [{"pose_keypoints_2d": moved}]}
        (folder / "k1" / name).write_text(json.dumps(content))


def read(folder: Path, images: CameraImages, **options) -> keypoint_files.PeopleByImage:
    return keypoint_files.read_camera(folder, images, full_confidence=1.0, **options)


def test_the_25_points_of_body_25b_are_recognised(tmp_path):
    project = open_case("b06", tmp_path)
    row = project.sequences[SEQUENCE]
    found = check(project)
    assert "keypoints: 25 points are body_25b, not body_25, by their bones" in found.summary
    people = read(row.keypoints, camera(6)).by_image[0]
    written = json.loads((row.keypoints / "k1" / "00000_keypoints.json").read_text())
    raw = np.reshape(written["people"][0]["pose_keypoints_2d"], (25, 3))
    for place, name in ((5, "left_shoulder"), (11, "left_hip"), (22, "right_big_toe")):
        np.testing.assert_allclose(people[0, KEYPOINT_INDEX[name]], raw[place], atol=1e-4)
    assert people[0, KEYPOINT_INDEX["neck"], 2] == 0


def test_the_halpe_points_of_pose2sim_are_read(tmp_path):
    project = open_case("b07", tmp_path)
    row = project.sequences[SEQUENCE]
    assert "keypoints: layout halpe26" in check(project).summary
    images = CameraImages("cam01", SIZE, np.arange(20), np.arange(20), frozenset(range(20)))
    found = read(row.keypoints, images)
    written = json.loads((row.keypoints / "cam01" / "cam01_000007.json").read_text())
    raw = np.reshape(written["people"][0]["pose_keypoints_2d"], (26, 3))
    for place, name in ((5, "left_shoulder"), (18, "neck"), (25, "right_heel")):
        np.testing.assert_allclose(
            found.by_image[7][0, KEYPOINT_INDEX[name]], raw[place], atol=1e-4
        )


def test_masks_of_shares_of_the_image_are_scaled(tmp_path):
    project = open_case("b14", tmp_path)
    row = project.sequences[SEQUENCE]
    assert "(candidates): corners are shares of the image's size" in check(project).summary
    found = candidate_files.read_camera(
        row.candidates, camera(4), layout="plain", min_score=0.0, names={}
    )
    suitcase = found.by_image[0][0]
    assert suitcase.label == "suitcase"
    np.testing.assert_allclose(suitcase.box, (148, 167, 23, 55), atol=1)
    assert any("shares of the image's size" in note for note in found.notes)


def test_keypoint_files_numbered_from_1_beside_a_video(tmp_path):
    project = open_case("b15", tmp_path)
    row = project.sequences[SEQUENCE]
    assert "files numbered from 1" in check(project).summary
    found = read(row.keypoints, camera(20))
    for n in (0, 19):
        path = row.keypoints / "k1" / f"{n + 1:06d}_keypoints.json"
        x = json.loads(path.read_text())["people"][0]["pose_keypoints_2d"][0]
        assert found.by_image[n][0, 0, 0] == pytest.approx(x, abs=1e-4)
    assert "keypoint files are numbered from 1" in found.notes


@pytest.mark.parametrize(
    ("layout", "expected"),
    [
        ("body_25", "layout body_25"),
        ("body_25b", "25 points are body_25b, not body_25, by their bones"),
        ("kinect_v2", "25 points are kinect_v2, not body_25, by their bones"),
        ("coco", "layout coco"),
        ("h36m", "17 points are h36m, not coco, by their bones"),
        ("openpose_17", "17 points are openpose_17, not coco, by their bones"),
        ("coco_feet", "layout coco_feet"),
        ("halpe26", "layout halpe26"),
    ],
)
def test_layouts_are_recognised_by_their_bones(tmp_path, layout, expected):
    write_people(tmp_path, ["0.json", "1.json"], person_of(layout))
    found = read(tmp_path, camera(2))
    assert expected in found.recognised
    knee = found.by_image[0][0, KEYPOINT_INDEX["left_knee"], :2]
    np.testing.assert_allclose(knee, STANDING["left_knee"])
    stated = read(tmp_path, camera(2), layout=layout)
    np.testing.assert_array_equal(stated.by_image[1], found.by_image[1])


def test_doubt_about_the_layout_is_noted_once(tmp_path):
    moved = np.roll(np.reshape(person_of("halpe26"), (26, 3)), 5, axis=0)  # bones of 1.08
    write_people(tmp_path, [f"{n}.json" for n in range(5)], moved.ravel().tolist())
    notes = [note for note in read(tmp_path, camera(5)).notes if "taken for halpe26" in note]
    assert len(notes) == 1


def test_bones_of_many_people_are_compared_in_little_memory():
    person = to_shared(np.reshape(person_of("body_25"), (25, 3)), layouts()["body_25"].points)
    tracemalloc.start()
    share = compare_bones(np.broadcast_to(person, (20_000, *person.shape)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert share == compare_bones(person[None]) and peak < 100e6


def test_points_in_an_unknown_order_are_refused_unless_a_layout_is_stated(tmp_path):
    order = np.random.default_rng(1).permutation(26)
    shuffled = np.reshape(person_of("halpe26"), (26, 3))[order].ravel().tolist()
    write_people(tmp_path, ["0.json"], shuffled)
    with pytest.raises(UserError, match="26 keypoints of camera k1 fit none of the layouts"):
        read(tmp_path, camera(1))
    assert read(tmp_path, camera(1), layout="halpe26").by_image[0].shape == (1, 135, 3)


@pytest.mark.parametrize(
    ("name_of", "remark"),
    [
        (lambda n: f"frame_{n:04d}_k1.json", None),
        (lambda n: f"k1_{n:06d}_v2_keypoints.json", None),
        (lambda n: f"{n + 1:06d}.json", "numbered from 1"),
        (lambda n: f"cam1_{n + 1:04d}_2d.json", "numbered from 1"),
        (lambda n: f"{n + 500}.json", "numbered from 500"),
        (lambda n: f"{round(n * 33.333):06d}.json", "named by time"),
        (lambda n: f"{1616161616000 + round(n * 33.333)}.json", "named by time"),
        (lambda n: f"{12 + n / 30:.4f}.json", "named by time"),
        (lambda n: f"{2 * n:04d}.json", "named by time"),
        (lambda n: f"{n:04d}_{1616161616000 + 33 * n}.json", None),
    ],
)
def test_the_number_of_an_image_is_found_in_its_name(tmp_path, name_of, remark):
    names = [name_of(n) for n in range(12)]
    write_people(tmp_path, names, person_of("body_25"))
    found = read(tmp_path, camera(12))
    noses = [found.by_image[n][0, 0, 0] for n in range(12)]
    np.testing.assert_allclose(noses, 160 + np.arange(12) / 10)
    assert found.notes == ([f"keypoint files are {remark}"] if remark else [])


def test_numbers_that_may_count_from_1_are_noted_and_can_be_stated(tmp_path):
    write_people(tmp_path, [f"{n + 1:04d}.json" for n in range(9)], person_of("body_25"))
    found = read(tmp_path, camera(10))
    assert any("begin at 1: set detections.keypoint_first_number" in note for note in found.notes)
    assert 0 not in found.by_image
    stated = read(tmp_path, camera(10, first=1))
    assert stated.by_image[0][0, 0, 0] == 160 and 9 not in stated.by_image


def test_ids_of_a_data_set_that_count_from_1(tmp_path):
    entries = [
        {"image_id": n + 1, "keypoints": np.add(person_of("coco"), n).tolist()} for n in range(5)
    ]
    (tmp_path / "k1.json").write_text(json.dumps(entries))
    found = read(tmp_path, camera(5))
    assert [found.by_image[n][0, 0, 0] for n in range(5)] == [160, 161, 162, 163, 164]
    assert any("numbered from 1" in note for note in found.notes)


NAMED = tuple(f"{n:05d}" for n in range(12))
GAPPED = (*NAMED[:5], *NAMED[6:])


@pytest.mark.parametrize(
    ("stems", "names", "places", "remark"),
    [
        (NAMED, [f"{n + 1:05d}" for n in range(12)], range(12), "from 1, the images from 0"),
        (NAMED, [f"{n + 40:05d}" for n in range(12)], range(12), "numbered from 40"),
        (NAMED[1:], [f"{n:05d}" for n in range(11)], range(11), "from 0, the images from 1"),
        (NAMED, [f"{n:05d}" for n in range(1, 13) if n != 7], [*range(1, 7), *range(8, 12)],
         "begin at 1: set detections.keypoint_first_number"),
        (NAMED[1:], ["00001", "00004", "00011", "00020"], [0, 3, 10], ""),
        (GAPPED, [f"{n}.k1" for n in range(12)], [*range(5), *range(5, 11)], "as in the names"),
        (GAPPED, [f"{n}.k1" for n in range(9)], range(9), "read as positions from 0, but may be"),
        (GAPPED, [f"{n}.k1" for n in range(11)], range(11), ""),
        ((), [f"{n + 100}" for n in range(12) if n != 7], [], "begin at 100: set detections."),
        ((), [f"{n}" for n in range(2, 13, 2)], range(2, 12, 2), "begin at 2: set detections."),
    ],
)  # fmt: skip
def test_names_beside_those_of_the_images(stems, names, places, remark):
    images = camera(len(stems) or 12, stems)
    found, stated = images.recognise_names(names)
    matched = [found[name] for name in names if found.get(name) in images.recorded]
    assert matched == list(places) and remark in stated and bool(remark) == bool(stated)
    ids = {int(name.partition(".")[0]): found.get(name) for name in names}
    if not set(names) & set(stems):
        _, by_id, _ = images.match_keys((), ids)
        assert [by_id[n] for n in ids if by_id.get(n) in images.recorded] == list(places)


def test_numbers_beyond_the_last_image_do_not_move_those_that_begin_later(tmp_path):
    entries = [{"image_id": n, "keypoints": person_of("coco")} for n in range(2, 7)]
    (tmp_path / "k1.json").write_text(json.dumps(entries))
    found = read(tmp_path, camera(6))
    assert [n for n, people in found.by_image.items() if len(people)] == [2, 3, 4, 5]
    assert any("begin at 2: set detections.keypoint_first_number" in n for n in found.notes)
    assert any("1 results in" in note and "(first: 6; it has" in note for note in found.notes)


def test_keypoints_are_scaled_from_the_stated_size_or_from_shares(tmp_path):
    point = np.reshape(person_of("coco"), (17, 3))
    forms = {
        "half": (point * (0.5, 0.5, 1), {"width": 160, "height": 120}),
        "shares": (point / (*SIZE, 1), {}),
        "other": (point, {"width": 240, "height": 320}),
    }
    for name, (points, size) in forms.items():
        content = {
            "images": [{"id": 0} | size],
            "annotations": [{"image_id": 0, "keypoints": points.ravel().tolist()}],
        }
        (tmp_path / name).mkdir()
        (tmp_path / name / "k1.json").write_text(json.dumps(content))
    half, shares = (read(tmp_path / name, camera(1)) for name in ("half", "shares"))
    np.testing.assert_allclose(half.by_image[0][0, 0, :2], STANDING["nose"], atol=0.6)
    np.testing.assert_allclose(shares.by_image[0][0, 0, :2], STANDING["nose"], atol=1e-3)
    assert "scaled from 160x120 pixels" in half.recognised
    with pytest.raises(UserError, match="240x320"):
        read(tmp_path / "other", camera(1))


@pytest.mark.parametrize(("factor", "noted"), [(1, False), (0.5, True), (0.25, True)])
def test_keypoints_of_smaller_images_are_noted(tmp_path, factor, noted):
    """Of https://github.com/aimagelab/dress-code/issues/4."""
    person = np.reshape(person_of("coco"), (17, 3)) * (factor, factor, 1)
    write_people(tmp_path, ["0.json", "1.json"], person.ravel().tolist())
    notes = read(tmp_path, camera(2)).notes
    assert ["images of half the size" in note for note in notes] == [True] * noted


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"images": [{"id": 0, "width": 1, "height": 1}]}, "1x1 pixels"),
        ({"images": [{"id": 0, "width": 240, "height": 320}]}, "240x320 pixels"),
        ({"segmentation": []}, "its mask is empty"),
        ({"segmentation": [[500, 300, 510, 300, 510, 310]]}, "its mask is empty"),
        ({"segmentation": {"size": [240, 320], "counts": [240 * 320]}}, "its mask is empty"),
    ],
)
def test_candidates_that_cannot_be_used_are_left_out(tmp_path, change, words):
    entry = {"image_id": 0, "category_id": 1, "segmentation": [[10, 10, 60, 10, 60, 60]]}
    entry |= {k: v for k, v in change.items() if k == "segmentation"}
    content = {"images": change.get("images", [{"id": 0}]), "annotations": [entry]}
    (tmp_path / "k1.json").write_text(json.dumps(content))
    found = candidate_files.read_camera(tmp_path, camera(1), layout="plain", min_score=0, names={})
    assert not found.by_image.get(0) and words in found.notes[0]


def test_instances_of_palettes_colours_and_alpha(tmp_path):
    numbers = np.zeros((240, 320), np.uint8)
    numbers[20:60, 30:90], numbers[100:150, 200:260] = 1, 2
    palette = Image.fromarray(numbers, "P")
    palette.putpalette([0, 0, 0, 128, 0, 0, 0, 128, 0] + [0] * 759)  # VOC's first colours
    palette.save(tmp_path / "palette.png")
    colours = np.zeros((240, 320, 3), np.uint8)
    colours[numbers == 1], colours[numbers == 2] = (255, 0, 0), (0, 255, 0)
    cv2.imwrite(str(tmp_path / "colours.png"), colours)
    cut = np.dstack([np.full((240, 320, 3), 90, np.uint8), np.where(numbers == 1, 255, 0)])
    cv2.imwrite(str(tmp_path / "cut.png"), cut.astype(np.uint8))
    smooth = cv2.GaussianBlur(colours * np.uint8(numbers == 1)[..., None], (5, 5), 0)
    cv2.imwrite(str(tmp_path / "smooth.png"), smooth)
    half = np.zeros((240, 320, 3), np.uint8)
    half[numbers == 1] = (0, 0, 128)
    cv2.imwrite(str(tmp_path / "half.png"), cv2.GaussianBlur(half, (5, 5), 0))
    half[numbers == 1], half[numbers == 2] = (0, 0, 64), (0, 0, 128)  # classes of VOC
    cv2.imwrite(str(tmp_path / "dark.png"), half)
    void = numbers.copy()
    void[:4, :4] = 255
    cv2.imwrite(str(tmp_path / "void.png"), void)
    almost_white = cv2.GaussianBlur(np.where(numbers == 1, np.uint8(250), np.uint8(0)), (5, 5), 0)
    cv2.imwrite(str(tmp_path / "almost_white.png"), almost_white)
    first, second = (30, 20, 60, 40), (200, 100, 60, 50)
    for name, boxes in (("palette", {first, second}), ("colours", {first, second}),
                        ("cut", {first}), ("smooth", {first}), ("half", {first}),
                        ("dark", {first, second}), ("void", {first, second}),
                        ("almost_white", {first})):  # fmt: skip
        found = read_masks(MaskFile(tmp_path / f"{name}.png", "", numbered=True), SIZE)
        assert [instance.box for instance in found] == sorted(boxes), name


def test_inverted_masks_are_refused(tmp_path):
    mask = np.full((240, 320), 255, np.uint8)
    mask[20:60, 30:90] = 0
    cv2.imwrite(str(tmp_path / "a.png"), mask)
    with pytest.raises(DamagedImage, match="inverted"):
        read_masks(MaskFile(tmp_path / "a.png", "", numbered=True), SIZE)


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ([0.5] * 4, "all masks .*upper left quarter of the image of 320x240"),
        ([2.0] * 4, "4 of 4 masks .*reach beyond .* of images of another size"),
        ([1, 1, 1, 1 / 320], "entry 3 .*: its corners are shares of the image's size"),
    ],
)
def test_candidates_of_another_size_are_noted(tmp_path, factors, words):
    corners = np.array([100.0, 50, 160, 50, 160, 150, 100, 150])
    entries = [
        {"image_id": n, "category_id": 1, "segmentation": [(factor * corners).tolist()]}
        for n, factor in enumerate(factors)
    ]
    (tmp_path / "k1.json").write_text(json.dumps(entries))
    found = candidate_files.read_camera(tmp_path, camera(4), layout="plain", min_score=0, names={})
    preview = candidate_files.preview_candidates(tmp_path, camera(4), names={})
    for notes in (found.notes, preview.notes):
        assert re.search(words, " ".join(notes))
    assert len(found.by_image.get(3, [])) == (factors[3] > 0.1)


def test_candidates_in_two_places_are_refused(tmp_path):
    (tmp_path / "k1").mkdir()
    for name in ("k1.json", "k1/0.json"):
        (tmp_path / name).write_text("[]")
    with pytest.raises(UserError, match=r"k1.json: .* and so do the 1 files in .*0.json"):
        candidate_files.read_camera(tmp_path, camera(1), layout="plain", min_score=0, names={})
    preview = candidate_files.preview_candidates(tmp_path, camera(1), names={})
    assert "0.json" in preview.faults[0]


def test_files_that_nothing_reads_are_named_by_check(tmp_path):
    project = open_case("b24", tmp_path)
    folder = project.path.parent
    (folder / "keypoints" / "k2").rename(folder / "keypoints" / "K2")
    paths = [folder / "keypoints" / "k3" / f"{n:05d}_keypoints.json" for n in range(20)]
    for path in paths:
        path.rename(path.with_suffix(".JSON"))
    (folder / "candidates" / "k1").mkdir()
    (folder / "candidates" / "k1" / "00000.npz").touch()
    found = check(project)
    for words in (
        "keypoints: K2/00000_keypoints.json and 19 more of K2/*.json are not used",
        "keypoints: k3/00000_keypoints.JSON and 19 more of k3/*.JSON are not used",
        "candidates: k1/00000.npz is not used",
    ):
        assert any(words in note for note in found.notes)
    assert any("keypoints of camera k1 only, and no depth" in fault for fault in found.faults)


def test_cameras_of_different_layouts_are_noted(tmp_path):
    project = open_case("b24", tmp_path)
    for path in (project.path.parent / "keypoints" / "k2").iterdir():
        content = {"people": [{"pose_keypoints_2d": person_of("body_25b")}]}
        path.write_text(json.dumps(content))
    assert any("different layouts" in note for note in check(project).notes)


def test_openpose_people_may_state_their_layout():
    content = {"people": [{"pose_keypoints_2d": person_of("h36m"), "keypoint_layout": "h36m"}]}
    found = read_people(content, one_image=True)
    np.testing.assert_allclose(
        found.results[0][1][KEYPOINT_INDEX["mid_hip"], :2], STANDING["mid_hip"]
    )
    assert not found.assumed
