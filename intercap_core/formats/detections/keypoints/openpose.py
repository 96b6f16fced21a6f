"""OpenPose's JSON files: body, hands and face of every person in one image.

Body 25, hands 21 each and face 70 points become 135: body, left hand, right hand, the inner face
(dlib 17 to 67), the jaw line (dlib 0 to 16). OpenPose's two pupils (68, 69) are left out. Pose2Sim
and rtmlib write the points of any other layout in ``pose_keypoints_2d``. BEHAVE keeps OpenPose's
lists of one person at the top of the file, under names of its own.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from intercap_core.body.keypoints import (
    CONTOUR,
    FACE,
    LEFT_HAND,
    NUM_KEYPOINTS,
    RIGHT_HAND,
)
from intercap_core.formats.detections.coco import ImageKey, UnreadableDetections
from intercap_core.formats.detections.keypoints import (
    LAYOUT_KEY,
    KeypointReader,
    PeopleFile,
    to_shared,
)

_BODY_LIST = "pose_keypoints_2d"
# Key, BEHAVE's key, number of points (None = any layout).
_LISTS: tuple[tuple[str, str, int | None], ...] = (
    (_BODY_LIST, "body_joints", None),
    ("hand_left_keypoints_2d", "left_hand_joints", 21),
    ("hand_right_keypoints_2d", "right_hand_joints", 21),
    ("face_keypoints_2d", "face_joints", 70),
)


def _recognises(content: Any) -> bool:
    return isinstance(content, dict) and ("people" in content or "body_joints" in content)


def _read(content: dict[str, Any], one_image: bool, layout: str | None = None) -> PeopleFile:
    """Read the people of one image. A part that OpenPose did not look for has confidence 0."""
    if "people" not in content:
        content = {"people": [{key: content.get(behave_key, []) for key, behave_key, _ in _LISTS}]}
    people = content["people"]
    if not isinstance(people, list):
        raise UnreadableDetections("has no list 'people'; expected a file as OpenPose writes it")
    result = PeopleFile(entries=len(people))
    for index, person in enumerate(people):
        if not isinstance(person, dict):
            raise UnreadableDetections(
                f"has people[{index}] that is not an object with keypoint lists"
            )
        body, left, right, face = (
            _points(person.get(key, []), count, f"people[{index}].{key}")
            for key, _, count in _LISTS
        )
        points = np.zeros((NUM_KEYPOINTS, 3))
        points[LEFT_HAND], points[RIGHT_HAND] = left, right
        points[FACE], points[CONTOUR] = face[17:68], face[:17]
        if len(body):
            stated = layout or person.get(LAYOUT_KEY, content.get(LAYOUT_KEY))
            try:
                names = result.layout_of(len(body), stated).points
            except ValueError as error:
                raise UnreadableDetections(
                    f"has {3 * len(body)} numbers in people[{index}].{_BODY_LIST}, expected 75 "
                    f"(x, y, confidence of OpenPose's BODY_25) or another layout: {error}"
                ) from None
            given = to_shared(body, names)
            points = np.where(given[:, 2:] > 0, given, points)
        result.results.append((ImageKey(None, None), points))
    return result


READER = KeypointReader(
    tool="OpenPose",
    expects="OpenPose's 'people'",
    recognises=_recognises,
    read=_read,
    image_files=("{image}_keypoints.json",),
    rank=0,
)


def _points(values: Any, count: int | None, where: str) -> np.ndarray:
    """Points (count, 3) of one list; zeros if it is empty."""
    is_list = isinstance(values, list)
    if not is_list or (len(values) not in (0, 3 * count) if count else len(values) % 3):
        size = len(values) if is_list else type(values).__name__
        expected = f"{3 * count} (x, y, confidence of {count} points)" if count else "75 (BODY_25)"
        raise UnreadableDetections(
            f"has {size} numbers in {where}, expected {expected}; run OpenPose with its BODY_25 "
            "model, hands and face"
        )
    if not values:
        return np.zeros((count or 0, 3))
    try:
        # None stands for NaN in JSON of libraries that avoid NaN.
        points = np.array([np.nan if v is None else v for v in values], np.float64)
    except (TypeError, ValueError, OverflowError):
        raise UnreadableDetections(f"has a value in {where} that is not a number") from None
    if points.ndim != 1:
        raise UnreadableDetections(f"has lists in {where}, expected one flat list of numbers")
    return points.reshape(-1, 3)
