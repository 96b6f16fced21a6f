"""Detections in the folders of the releases BEHAVE and InterCap."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from intercap_core.config import DetectionsSettings, FramesSettings
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.geometry.camera.rig import Rig
from intercap_core.stages import detections
from intercap_core.stages import frames as frames_stage
from tests.helpers.release_folders import write_behave, write_intercap
from tests.helpers.synthetic_capture import COLOUR, ring

LENS = COLOUR.scaled(0.1)
TIMES = ("0003.000", "0004.000", "0006.000")


def rig_of(count: int) -> Rig:
    cameras = ring(count)[0]
    return Rig(tuple(replace(c, colour=LENS, depth=None, colour_from_depth=None) for c in cameras))


def no_depth(t: int, c: int) -> None:
    return None


def distinct_jpeg(t: int, c: int) -> bytes:
    image = np.full((LENS.height, LENS.width, 3), 40 * t + 5 * c, np.uint8)
    cv2.circle(image, (50 + 10 * t, 40 + 10 * c), 20, (255, 255, 255), -1)
    return cv2.imencode(".jpg", image)[1].tobytes()


def square(x: int, side: int, *, inside: int = 255, outside: int = 0) -> np.ndarray:
    mask = np.full((LENS.height, LENS.width), outside, np.uint8)
    mask[20 : 20 + side, x : x + side] = inside
    return mask


def run(sequence: SequenceEntry, folder: Path) -> Detections:
    frames, output = folder / "frames.h5", folder / "detections.h5"
    frames_stage.run(sequence=sequence, output=frames, settings=FramesSettings())
    detections.run(frames=frames, output=output, sequence=sequence, settings=DetectionsSettings())
    return Detections.load(output)


@pytest.fixture
def behave(tmp_path) -> SequenceEntry:
    recordings, calibration = write_behave(
        tmp_path, rig_of(2), times=TIMES, colour=distinct_jpeg, depth=no_depth
    )
    for t, text in enumerate(TIMES):
        folder = recordings / f"t{text}"
        for c in range(2):
            cv2.imwrite(str(folder / f"k{c}.person_mask.jpg"), square(10 + t, 30))
            cv2.imwrite(str(folder / f"k{c}.obj_rend_mask.png"), square(100 + t, 20 + c))
            joints = {
                "body_joints": [10.0 + t, 95.0, 0.5] * 25,
                "left_hand_joints": [1.0, 2.0, 0.25] * 21,
                "right_hand_joints": [3.0, 4.0, 0.25] * 21,
                "face_joints": [5.0, 6.0, 0.75] * 70,
            }
            (folder / f"k{c}.color.json").write_text(json.dumps(joints))
    return SequenceEntry(
        sequence="s", subject="a", object="chairwood", layout="behave", recordings=recordings,
        calibration=calibration,
    )  # fmt: skip


def test_behave_keypoints_and_masks_are_read(behave, tmp_path):
    read = run(behave, tmp_path)
    assert read.keypoints_found.all() and read.candidates_found.all()
    assert read.notes == ("", "")
    for t in range(3):
        for c in range(2):
            people = read.people(t, c)
            assert people.shape == (1, 135, 3)
            assert people[0, 3].tolist() == [10 + t, 95, 0.5]
            assert people[0, 30].tolist() == [1, 2, 0.25] and people[0, 60].tolist() == [3, 4, 0.25]
            assert people[0, 134].tolist() == [5, 6, 0.75]
            person, thing = read.candidates(t, c)
            assert (person.label, thing.label) == ("person", "chairwood")
            assert person.score == thing.score == 1
            expected = square(10 + t, 30) > 0
            assert (person.mask() != expected).sum() < 10  # a JPEG's rim
            assert np.array_equal(thing.mask(), square(100 + t, 20 + c) > 0)
            assert thing.runs.box == (100 + t, 20, 20 + c, 20 + c)


def nobody(folder: Path) -> None:
    lists = {"body_joints": [0.0] * 75, "face_joints": [0.0] * 210}
    (folder / "k0.color.json").write_text(json.dumps(lists))


def cut_keypoints(folder: Path) -> None:
    (folder / "k0.color.json").write_text('{"body_jo')


def no_files(folder: Path) -> None:
    for path in [*folder.glob("k0.*mask.*"), folder / "k0.color.json"]:
        path.unlink()


def object_hidden(folder: Path) -> None:
    cv2.imwrite(str(folder / "k0.obj_rend_mask.png"), square(0, 0))


def mask_of_another_size(folder: Path) -> None:
    cv2.imwrite(str(folder / "k0.obj_rend_mask.png"), np.zeros((50, 60), np.uint8))


def empty_mask_file(folder: Path) -> None:
    (folder / "k0.person_mask.jpg").write_bytes(b"")


@pytest.mark.parametrize(
    ("fault", "words", "people", "labels"),
    [
        (nobody, "", 0, ["person", "chairwood"]),
        (cut_keypoints, "not readable: t0004.000/k0.color.json", 0, ["person", "chairwood"]),
        (no_files, "no mask for 1 images", 0, []),
        (object_hidden, "", 1, ["person"]),
        (mask_of_another_size, "t0004.000/k0.obj_rend_mask.png has 60x50 pixels", 1, ["person"]),
        (empty_mask_file, "t0004.000/k0.person_mask.jpg is no image", 1, ["chairwood"]),
    ],
)
def test_faulty_behave_files_are_noted(behave, tmp_path, fault, words, people, labels):
    fault(behave.recordings / "t0004.000")
    read = run(behave, tmp_path)
    assert words in read.notes[0] and bool(words) == bool(read.notes[0])
    assert len(read.people(1, 0)) == people
    assert [candidate.label for candidate in read.candidates(1, 0)] == labels
    assert len(read.people(0, 0)) == 1 and len(read.candidates(2, 0)) == 2
    assert read.notes[1] == ""


def test_detections_of_the_row_have_priority(behave, tmp_path):
    candidates = tmp_path / "candidates"
    candidates.mkdir()
    for c in range(2):
        (candidates / f"k{c}.json").write_text("[]")
    read = run(behave.model_copy(update={"candidates": candidates}), tmp_path)
    assert read.candidates_found.all() and read.candidates(0, 0) == []
    assert len(read.people(0, 0)) == 1


@pytest.mark.parametrize("first_folder", ["k1", "BodyIndexColor", "BodyIndexColor_1"])
def test_release_files_belong_to_the_number_in_the_images_name(tmp_path, first_folder):
    recordings, calibration = write_intercap(
        tmp_path, rig_of(2), numbers=[0, 2, 3], colour=distinct_jpeg, depth=no_depth
    )
    keypoints, candidates = tmp_path / "keypoints", tmp_path / "candidates"
    for number in (0, 1, 2):
        people = [{"pose_keypoints_2d": [float(number), 5.0, 0.9] * 25}]
        path = keypoints / "k1" / f"{number:05d}_keypoints.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"people": people}))
    for folder in (first_folder, "BodyIndexColor_2"):
        (candidates / folder).mkdir(parents=True)
        for number in (1, 2, 3):
            mask = square(10 * number, 30, inside=0, outside=255)
            cv2.imwrite(str(candidates / folder / f"{number:05d}.png"), mask)
    sequence = SequenceEntry(
        sequence="s", subject="a", object="cup", layout="intercap", recordings=recordings,
        calibration=calibration, keypoints=keypoints, candidates=candidates,
    )  # fmt: skip
    read = run(sequence, tmp_path)
    assert read.num_sets == 3
    assert read.keypoints_found[:, 0].tolist() == [True, True, False]
    assert read.people(1, 0)[0, 3, 0] == 2
    for c in range(2):
        assert read.candidates_found[:, c].tolist() == [False, True, True]
        for t, number in ((1, 2), (2, 3)):
            (person,) = read.candidates(t, c)
            assert person.label == "person"
            assert np.array_equal(person.mask(), square(10 * number, 30) > 0)
        assert "no mask for 1 images" in read.notes[c]


def test_missing_behave_detections_are_an_error(behave, tmp_path):
    for pattern in ("*mask*", "*.color.json"):
        for path in behave.recordings.glob(f"t*/{pattern}"):
            path.unlink()
    with pytest.raises(UserError, match="no detections for any of its images"):
        run(behave, tmp_path)
