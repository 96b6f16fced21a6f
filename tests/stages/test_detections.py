"""Stage ``detections``: files reach the sets of their images; faulty ones are noted."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from intercap_core.config import DetectionsSettings
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.geometry.camera import masks
from intercap_core.geometry.camera.rig import Rig
from intercap_core.stages import detections
from tests.helpers.synthetic_capture import ring, write_frames

RIG = Rig(tuple(replace(camera, colour=camera.colour.scaled(0.5)) for camera in ring(2)[0]))
WIDTH, HEIGHT, SETS = RIG[0].colour.width, RIG[0].colour.height, 4


def square(x: int, scale: int = 1) -> np.ndarray:
    mask = np.zeros((HEIGHT // scale, WIDTH // scale), np.uint8)
    mask[100 // scale : 200 // scale, x // scale : (x + 80) // scale] = 1
    return mask


def result(image, x: int = 300, label: str = "cup", **changes) -> dict:
    mask = changes.pop("mask", square(x))
    size = [int(n) for n in mask.shape]
    segmentation = {"size": size, "counts": masks.encode(mask).decode()}
    entry = {"image_id": image, "category_name": label, "score": 0.5}
    return entry | {"segmentation": segmentation} | changes


GOOD = [result(image) for image in range(SETS)]


@pytest.fixture
def candidates(tmp_path) -> Path:
    write_frames(tmp_path / "frames.h5", RIG, num_sets=SETS, colours=[[b"unread"] * SETS] * 2)
    folder = tmp_path / "candidates"
    folder.mkdir()
    (folder / "k2.json").write_text(json.dumps(GOOD))
    return folder


def run(root: Path, output: str = "detections.h5", **settings) -> Detections:
    """Run the stage on the recording in ``root``, with the folders of detections in it."""
    folders = {name: root / name for name in ("keypoints", "candidates") if (root / name).exists()}
    detections.run(
        frames=root / "frames.h5",
        output=root / output,
        sequence=SequenceEntry(
            sequence="test", subject="s", object="o", recordings=root,
            calibration=root / "rig.json", **folders,
        ),
        settings=DetectionsSettings(**settings),
    )  # fmt: skip
    return Detections.load(root / output)


def people_file(path: Path, x: list[float]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    people = [{"pose_keypoints_2d": [v, 5.0, 0.9] * 25} for v in x]
    path.write_text(json.dumps({"people": people}))


def test_files_reach_the_sets_that_hold_their_image(tmp_path):
    index = np.array([[0, 0], [1, 2], [2, -1], [3, 3]])
    dropped = np.array([False, False, False, True])
    write_frames(
        tmp_path / "frames.h5", RIG, num_sets=4, colour_index=index, dropped=dropped,
        colours=[[b"unread"] * 4] * 2,
    )  # fmt: skip
    keypoints, candidates = tmp_path / "keypoints", tmp_path / "candidates"
    people_file(keypoints / "k1" / "000000000000_keypoints.json", [10])
    people_file(keypoints / "k1" / "000000000001_keypoints.json", [11, 12])
    (keypoints / "k1" / "000000000002_keypoints.json").write_text('{"peop')
    people_file(keypoints / "k1" / "000000000003_keypoints.json", [99])
    candidates.mkdir()
    (candidates / "k2.json").write_text(json.dumps([result(2, 300, "person"), result(2, 500)]))
    read = run(tmp_path)
    assert read.camera_names == ("k1", "k2") and read.num_sets == 4
    np.testing.assert_array_equal(read.keypoints_found[:, 0], [True, True, False, False])
    assert not read.keypoints_found[:, 1].any()
    np.testing.assert_array_equal(read.candidates_found[:, 1], [True, True, False, False])
    np.testing.assert_array_equal(read.people(1, 0)[:, 3, 0], [11, 12])
    assert len(read.people(2, 0)) == len(read.people(3, 0)) == 0
    found = read.candidates(1, 1)
    assert [c.label for c in found] == ["person", "cup"] and [c.index for c in found] == [0, 1]
    assert [c.runs.box[0] for c in found] == [300, 500]
    np.testing.assert_array_equal(found[1].mask(), square(500) > 0)
    assert read.candidates(0, 1) == [] and read.candidates(0, 0) == []
    assert "000000000002_keypoints.json" in read.notes[0]
    assert "no candidates candidates/k1.json" in read.notes[0]
    assert "keypoints/k2" in read.notes[1]
    run(tmp_path, "again.h5")
    first, second = (tmp_path / name for name in ("detections.h5", "again.h5"))
    assert first.read_bytes() == second.read_bytes()


def test_no_detections_at_all_is_an_error(tmp_path):
    write_frames(tmp_path / "frames.h5", RIG, num_sets=2)
    for folder in ("", "keypoints", "candidates"):
        (tmp_path / folder).mkdir(exist_ok=True)
        with pytest.raises(UserError, match="sequence test: no detections"):
            run(tmp_path)
    assert not (tmp_path / "detections.h5").exists()


# --- faulty files of candidates ------------------------------------------------------------------


def broken_rle(entry: dict) -> dict:
    counts = entry["segmentation"]["counts"]
    return entry | {"segmentation": {"size": [HEIGHT, WIDTH], "counts": counts[:-1] + "zz"}}


NONE, ALL = [0, 0, 0, 0], [1, 1, 1, 1]


@pytest.mark.parametrize(
    ("content", "words", "found", "count"),
    [
        ('[{"image_id": 0, "seg', "k1.json is not valid JSON", NONE, NONE),
        ({"results": []}, "holds an object with results, expected a list", NONE, NONE),
        ([GOOD[0], broken_rle(GOOD[1]), *GOOD[2:]], "1 of 4 results in candidates/k1.json left "
         "out: entry 1 (image 1): its RLE", [1, 0, 1, 1], [1, 0, 1, 1]),
        ([*GOOD, broken_rle(GOOD[1])], "1 of 5 results", [1, 0, 1, 1], ALL),
        ([broken_rle(entry) for entry in GOOD], "4 of 4 results", NONE, NONE),
        ([result(i, mask=square(300, 2)) for i in range(SETS)], "4 masks in candidates/k1.json "
         "scaled to the image's size", ALL, ALL),
        ([*GOOD, result(7204)], "1 results in candidates/k1.json are of images that the recording "
         "does not have (first: 7204; it has images 0 to 3)", ALL, ALL),
        ([result(image + 1) for image in range(SETS)], "are numbered from 1", ALL, ALL),
        ([], "", ALL, NONE),
    ],
)  # fmt: skip
def test_a_faulty_file_costs_only_its_own_entries(candidates, content, words, found, count):
    text = content if isinstance(content, str) else json.dumps(content)
    (candidates / "k1.json").write_text(text)
    read = run(candidates.parent)
    if words.startswith("1 of 5"):
        found = ALL  # another result of the same image is known
    assert words in read.notes[0] and bool(words) == bool(read.notes[0])
    assert read.candidates_found[:, 0].astype(int).tolist() == found
    assert [len(read.candidates(t, 0)) for t in range(SETS)] == count
    for t in range(SETS):
        for candidate in read.candidates(t, 0):
            np.testing.assert_array_equal(candidate.mask(), square(300) > 0)
    assert read.notes[1] == "" and read.candidates_found[:, 1].all()


def test_reasons_are_listed_if_no_candidate_is_left(candidates):
    for name in ("k1", "k2"):
        (candidates / f"{name}.json").write_text("{")
    with pytest.raises(UserError, match=r"k2: candidates/k2\.json is not valid JSON"):
        run(candidates.parent)


@pytest.mark.parametrize(
    ("setting", "number", "label"), [("coco", 47, "cup"), ("coco80", 41, "cup"), ("file", 5, "mug")]
)
def test_numbers_of_classes(candidates, setting, number, label):
    unnamed = [{k: v for k, v in entry.items() if k != "category_name"} for entry in GOOD]
    entries = [entry | {"category_id": number} for entry in unnamed]
    (candidates / "k1.json").write_text(json.dumps(entries))
    names = candidates.parent / "names.json"
    names.write_text('{"categories": [{"id": 5, "name": "mug"}]}')
    read = run(candidates.parent, category_names=names if setting == "file" else setting)
    assert read.candidates(0, 0)[0].label == label


def test_ids_are_resolved_by_the_list_of_images(candidates):
    images = [{"id": 50 + n, "file_name": f"k1/frame_{n:05d}.jpg"} for n in range(3)]
    annotations = [result(50 + n, x=300 + 10 * n) for n in range(2)]
    content = {"images": images, "annotations": annotations}
    (candidates / "k1.json").write_text(json.dumps(content))
    read = run(candidates.parent)
    assert read.candidates_found[:, 0].tolist() == [True, True, True, False]
    assert [c.runs.box[0] for t in range(SETS) for c in read.candidates(t, 0)] == [300, 310]


def test_unrelated_numbers_in_names_are_ignored(candidates):
    images = [{"id": n, "file_name": f"img_{n + 160530:06d}.jpg"} for n in range(SETS)]
    content = {"images": images, "annotations": GOOD}
    (candidates / "k1.json").write_text(json.dumps(content))
    read = run(candidates.parent)
    assert read.notes[0] == "" and all(len(read.candidates(t, 0)) == 1 for t in range(SETS))


@pytest.mark.parametrize("name", ["coco_instances_results.json", "predictions.json"])
def test_default_file_names_of_detectors(candidates, name):
    (candidates / "k1").mkdir()
    (candidates / "k1" / name).write_text(json.dumps(GOOD))
    assert run(candidates.parent).candidates_found[:, 0].all()


def test_one_file_per_image(candidates):
    folder = candidates / "k1"
    folder.mkdir()
    sam = {k: v for k, v in GOOD[0].items() if k == "segmentation"} | {"predicted_iou": 0.75}
    (folder / "image_0000.json").write_text(json.dumps([sam, sam]))
    (folder / "image_0001.json").write_text(json.dumps({"annotations": GOOD[:1]}))
    (folder / "image_0002.json").write_text("[")
    (folder / "image_0009.json").write_text("[]")
    (folder / "notes.json").write_text("[]")
    read = run(candidates.parent)
    assert read.candidates_found[:, 0].tolist() == [True, True, False, False]
    assert [(c.label, c.score) for c in read.candidates(0, 0)] == [("", 0.75)] * 2
    assert [c.label for c in read.candidates(1, 0)] == ["cup"]
    note = read.notes[0]
    assert "k1/image_0002.json is not valid JSON" in note
    assert "no file of candidates for 1 images" in note
    assert "2 files of candidates belong to no image (first: image_0009.json)" in note


def test_masks_as_images(candidates):
    folder = candidates / "k1"
    (folder / "image_0003").mkdir(parents=True)
    cv2.imwrite(str(folder / "image_0000__sports ball.png"), 255 * square(300))
    cv2.imwrite(str(folder / "image_0000__cup__2.png"), square(500))
    cv2.imwrite(str(folder / "image_0001.png"), square(300) + 2 * square(500))
    cv2.imwrite(str(folder / "image_0002__cup.png"), 255 * square(300, 2))
    cv2.imwrite(str(folder / "image_0003" / "0_cup.png"), 255 * square(300))
    cv2.imwrite(str(folder / "image_0003" / "1.png"), 255 * square(500))
    read = run(candidates.parent)
    assert read.candidates_found[:, 0].all() and read.notes[0] == ""
    labels = [[c.label for c in read.candidates(t, 0)] for t in range(SETS)]
    assert labels == [["cup", "sports ball"], ["", ""], ["cup"], ["cup", ""]]
    places = [[c.runs.box[0] for c in read.candidates(t, 0)] for t in range(SETS)]
    assert places == [[500, 300], [300, 500], [300], [300, 500]]


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((64, 64), np.uint8), "has 64x64 pixels, the image 960x540"),
        (np.arange(HEIGHT * WIDTH, dtype=np.uint16).reshape(HEIGHT, WIDTH), "different values"),
        (None, "is no image"),
    ],
)
def test_invalid_mask_images_are_noted(candidates, image, words):
    folder = candidates / "k1"
    folder.mkdir()
    if image is None:
        (folder / "0001__cup.png").write_bytes(b"none")
    else:
        cv2.imwrite(str(folder / "0001__cup.png"), image)
    cv2.imwrite(str(folder / "0002__cup.png"), 255 * square(300))
    cv2.imwrite(str(folder / "9000__cup.png"), 255 * square(300))
    read = run(candidates.parent)
    assert "masks not readable: k1/0001__cup.png " in read.notes[0]
    assert words in read.notes[0] and "belong to no image (first: 9000)" in read.notes[0]
    assert read.candidates_found[:, 0].tolist() == [False, False, True, False]
