"""Matching of keypoints and candidates to the images of a plain recording."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from tests.helpers.plain_capture import detect, plain_entry, write_rig

SIZE = (64, 48)
CUT, ABSENT = 2, 4  # numbers of the right camera's damaged image and of the one that is not there


def keypoints(path: Path, x: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    people = [{"pose_keypoints_2d": [x, 5.0, 0.9] * 25}]
    path.write_text(json.dumps({"people": people}))


@pytest.fixture
def capture(tmp_path) -> SequenceEntry:
    """Two folders of images 1 to 6; of the right one, one is cut off and one is absent."""
    images = write_rig(tmp_path, SIZE, 60)
    for c, folder in enumerate(images.values()):
        for number in range(1, 7):
            path = folder / f"shot_{number:04d}.jpg"
            cv2.imwrite(str(path), np.full((SIZE[1], SIZE[0], 3), 30 * number + c, np.uint8))
    right = images["right"]
    (right / f"shot_{ABSENT:04d}.jpg").unlink()
    cut = right / f"shot_{CUT:04d}.jpg"
    cut.write_bytes(cut.read_bytes()[:200])
    return plain_entry(tmp_path, keypoints=tmp_path / "keypoints")


def found(capture: SequenceEntry) -> dict[str, list[float]]:
    """First x of each frame set's person by camera; 0 = nobody."""
    read = detect(capture)
    sets = range(read.num_sets)
    people = {name: [read.people(t, c) for t in sets] for c, name in enumerate(("left", "right"))}
    return {
        name: [float(persons[0, 0, 0]) if len(persons) else 0.0 for persons in in_sets]
        for name, in_sets in people.items()
    }


def test_files_numbered_by_place_count_damaged_images(capture):
    for place in range(6):
        keypoints(capture.keypoints / "left" / f"{place:012d}_keypoints.json", place + 1)
    for place, number in enumerate(n for n in range(1, 7) if n != ABSENT):
        keypoints(capture.keypoints / "right" / f"{place:012d}_keypoints.json", number)
    people = found(capture)
    assert people["left"] == [1, 2, 3, 4, 5, 6]
    assert people["right"] == [1, 0, 3, 0, 5, 6]


def test_changed_times_require_new_frames(capture):
    keypoints(capture.keypoints / "left" / "shot_0001_keypoints.json", 1)
    found(capture)
    content = json.loads(capture.calibration.read_text()) | {"fps": 7}
    capture.calibration.write_text(json.dumps(content))
    with pytest.raises(UserError, match=r"images of camera left in .*run the frames stage again"):
        detect(capture, "again.h5")
