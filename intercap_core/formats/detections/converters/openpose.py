"""OpenPose's JSON files: body, hands and face of every person in one image.

Body 25, hands 21 each and face 70 points become 135: body, left hand, right hand, the inner face
(dlib 17 to 67), the jaw line (dlib 0 to 16). OpenPose's two pupils (68, 69) are left out.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.body.keypoints import (
    BODY,
    CONTOUR,
    FACE,
    LEFT_HAND,
    NUM_KEYPOINTS,
    RIGHT_HAND,
)
from intercap_core.errors import UserError

_LISTS = {
    "pose_keypoints_2d": 25,
    "hand_left_keypoints_2d": 21,
    "hand_right_keypoints_2d": 21,
    "face_keypoints_2d": 70,
}
# BEHAVE keeps OpenPose's lists of one person at the top of the file, under names of its own.
_BEHAVE_LISTS = {
    "pose_keypoints_2d": "body_joints",
    "hand_left_keypoints_2d": "left_hand_joints",
    "hand_right_keypoints_2d": "right_hand_joints",
    "face_keypoints_2d": "face_joints",
}
_JAW_LINE, _INNER_FACE = slice(0, 17), slice(17, 68)
_FILE_NAME = re.compile(r"(?!\.)(?:.*?_)?(\d+)_keypoints\.json")


def keypoint_files(folder: Path) -> dict[int, Path]:
    """Find the files of one camera, by the number of the image, ``[name_]<number>_keypoints.json``.

    Raises UserError where two files have one number.
    """
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match = _FILE_NAME.fullmatch(path.name)
        if not match:
            continue
        number = int(match.group(1))
        if number in found:
            raise UserError(
                f"{folder}: image {number} has two keypoint files, {found[number].name} and "
                f"{path.name}; keep one"
            )
        found[number] = path
    return found


def named_keypoint_files(folder: Path, names: Iterable[str]) -> dict[str, Path]:
    """Find the files of one camera that are named after its images, ``<name>_keypoints.json``."""
    paths = {name: folder / f"{name}_keypoints.json" for name in names}
    return {name: path for name, path in paths.items() if path.is_file()}


def as_openpose(content: Any) -> Any:
    """BEHAVE's parsed JSON of one person as OpenPose writes it; any other content as it is."""
    if not isinstance(content, dict) or "people" in content or "body_joints" not in content:
        return content
    return {"people": [{key: content.get(theirs, []) for key, theirs in _BEHAVE_LISTS.items()}]}


def is_openpose(content: Any) -> bool:
    """Whether parsed JSON is OpenPose's."""
    return isinstance(content, dict) and "people" in content


def people_of(content: dict[str, Any], name: str) -> np.ndarray:
    """The people of one file's parsed JSON: (P, 135, 3) float64 of x, y (px) and confidence.

    Numbers are as written. A hand or face that the detector did not look for (an empty list) has
    confidence 0. P may be 0. Raises UserError where a list is not of its length; ``name`` of the
    file is in it.
    """
    people = content.get("people")
    if not isinstance(people, list):
        raise UserError(f"{name}: has no list 'people'; expected a file as OpenPose writes it")
    result = np.zeros((len(people), NUM_KEYPOINTS, 3))
    for index, person in enumerate(people):
        if not isinstance(person, dict):
            raise UserError(f"{name}: people[{index}] is not an object with keypoint lists")
        lists = {
            key: _points(person.get(key, []), count, f"{name}: people[{index}].{key}")
            for key, count in _LISTS.items()
        }
        face = lists["face_keypoints_2d"]
        result[index, BODY] = lists["pose_keypoints_2d"]
        result[index, LEFT_HAND] = lists["hand_left_keypoints_2d"]
        result[index, RIGHT_HAND] = lists["hand_right_keypoints_2d"]
        result[index, FACE], result[index, CONTOUR] = face[_INNER_FACE], face[_JAW_LINE]
    return result


def _points(values: Any, count: int, where: str) -> np.ndarray:
    if not isinstance(values, list) or len(values) not in (0, 3 * count):
        found = len(values) if isinstance(values, list) else type(values).__name__
        raise UserError(
            f"{where} has {found} numbers, expected {3 * count} (x, y, confidence of {count} "
            "points); run OpenPose with its BODY_25 model, hands and face"
        )
    if not values:
        return np.zeros((count, 3))
    try:
        # None stands for NaN in JSON that was written by careful libraries.
        points = np.array([np.nan if v is None else v for v in values], np.float64)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"{where} holds something that is not a number; write it again") from None
    if points.ndim != 1:
        raise UserError(f"{where} holds lists, expected one flat list of {3 * count} numbers")
    return points.reshape(count, 3)
