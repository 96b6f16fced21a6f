"""Keypoints as JSON in COCO's manner: COCO-WholeBody, mmpose, AlphaPose; and the layouts they use.

A person is an object with ``keypoints``: x, y, confidence of every point in one flat list or a list
for each point, or x, y with separate ``keypoint_scores`` (mmpose). Feet, face and hands may be
separate lists (``foot_kpts``, ``face_kpts``, ``lefthand_kpts``, ``righthand_kpts``:
COCO-WholeBody's results). The number of points determines the layout, unless the person or the file
states ``keypoint_layout``, or ``meta_info.dataset_name`` as mmpose does.

A file is a list of people who state their image, a data set (``images``, ``annotations``), a list
of frames (``frame_id``, ``instances``: mmpose of a video), either of these below ``instance_info``
(mmpose's demo), or the people of one image.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from intercap_core.body.keypoints import BODY as OPENPOSE_BODY
from intercap_core.body.keypoints import KEYPOINT_NAMES, LEFT_HAND, RIGHT_HAND
from intercap_core.formats.detections.coco import (
    ImageKey,
    UnreadableDetections,
    image_of,
    listed_images,
    read_listed_images,
)
from intercap_core.formats.detections.keypoints import (
    LAYOUT_KEY,
    KeypointLayout,
    KeypointReader,
    PeopleFile,
    layouts,
    to_shared,
)
from intercap_core.inputs.files import quoted

BODY = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder",
    "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee",
    "right_knee", "left_ankle", "right_ankle",
)  # fmt: skip
FEET = (
    "left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel",
)  # fmt: skip
FACE = tuple(f"face_{i}" for i in range(68))  # dlib's order
# Wrist, then thumb, index, middle, ring and little finger from the root to the tip: the same in
# OpenPose, COCO-WholeBody, Halpe and MediaPipe. Sides are the person's own.
LEFT, RIGHT = KEYPOINT_NAMES[LEFT_HAND], KEYPOINT_NAMES[RIGHT_HAND]
HALPE_BODY = (
    *BODY, "head", "neck", "mid_hip", "left_big_toe", "right_big_toe", "left_small_toe",
    "right_small_toe", "left_heel", "right_heel",
)  # fmt: skip
# OpenPose's older body without neck. DWPose and rtmlib insert a computed one, which is left out.
OPENPOSE_17 = (
    "nose", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder", "left_elbow",
    "left_wrist", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle",
    "right_eye", "left_eye", "right_ear", "left_ear",
)  # fmt: skip
DWPOSE_BODY = ("nose", "middle_of_shoulders", *OPENPOSE_17[1:])
WHOLE_BODY = (*BODY, *FEET, *FACE, *LEFT, *RIGHT)

# OpenPose's experimental BODY_25B: COCO's points, neck and top of the head, feet.
BODY_25B = (*BODY, "upper_neck", "head", *FEET)
# PoseTrack18: COCO's points with neck and top of the head in place of the eyes.
POSETRACK18 = ("nose", "upper_neck", "head", *BODY[3:])
# Human3.6M, as VideoPose3D and mmpose order it. Its neck lies at the chin.
H36M = (
    "mid_hip", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle",
    "spine", "thorax", "upper_neck", "head", "left_shoulder", "left_elbow", "left_wrist",
    "right_shoulder", "right_elbow", "right_wrist",
)  # fmt: skip
# Kinect for Windows SDK 2.0, JointType; NTU RGB+D.
KINECT_V2 = (
    "mid_hip", "spine", "upper_neck", "head", "left_shoulder", "left_elbow", "left_wrist",
    "left_palm", "right_shoulder", "right_elbow", "right_wrist", "right_palm", "left_hip",
    "left_knee", "left_ankle", "left_foot", "right_hip", "right_knee", "right_ankle", "right_foot",
    "neck", "left_fingers", "left_thumb", "right_fingers", "right_thumb",
)  # fmt: skip

# Names are those of mmpose's data sets, where it has them.
LAYOUTS = (
    KeypointLayout("body_25", KEYPOINT_NAMES[OPENPOSE_BODY], is_default=True),
    KeypointLayout("body_25b", BODY_25B),
    KeypointLayout("kinect_v2", KINECT_V2),
    KeypointLayout("h36m", H36M),
    KeypointLayout("openpose_17", OPENPOSE_17),
    KeypointLayout("posetrack18", POSETRACK18),
    KeypointLayout("coco", BODY, is_default=True),
    KeypointLayout("coco_feet", (*BODY, *FEET), is_default=True),
    KeypointLayout("coco_wholebody", WHOLE_BODY, is_default=True),
    KeypointLayout("dwpose", (*DWPOSE_BODY, *FEET, *FACE, *LEFT, *RIGHT), is_default=True),
    KeypointLayout("halpe26", HALPE_BODY, is_default=True),
    KeypointLayout("halpe", (*HALPE_BODY, *FACE, *LEFT, *RIGHT), is_default=True),
)
# Separate lists of a person, and the order of their points in COCO-WholeBody.
_PARTS = {
    "foot_kpts": FEET, "face_kpts": FACE, "lefthand_kpts": LEFT, "righthand_kpts": RIGHT,
}  # fmt: skip


LayoutOf = Callable[[dict[str, Any]], str | None]  # name of the layout that an entry states


def _entries(content: Any) -> Any:
    """The list of people or frames."""
    if isinstance(content, dict):
        return content.get("instance_info", content.get("annotations"))
    return content


def _read(content: Any, one_image: bool, layout: str | None = None) -> PeopleFile:
    """Read the people in their order; entries that cannot be used are left out with a reason."""
    entries, of_file = _entries(content), _stated_layout(content)

    def layout_of(entry: dict[str, Any]) -> str | None:
        return layout or entry.get(LAYOUT_KEY, of_file)

    result = PeopleFile()
    if entries and all(isinstance(e, dict) and "instances" in e for e in entries):
        _read_frames(result, entries, layout_of, from_1=isinstance(content, dict))
        return result
    if isinstance(content, dict):
        result.images = read_listed_images(content)
    image = partial(image_of, listed=listed_images(result.images), one_image=one_image)
    for index, entry in enumerate(entries):
        _add(result, entry, f"entry {index}", image, layout_of)
    return result


READER = KeypointReader(
    tool="COCO",
    expects="a list of people with 'keypoints', COCO's 'annotations' or mmpose's 'instance_info'",
    recognises=lambda content: isinstance(_entries(content), list),
    read=_read,
    camera_files=("{camera}.json", "results_{camera}.json", "{camera}/alphapose-results.json"),
    image_files=("results_{image}.json", "{image}.json"),
)


def _stated_layout(content: Any) -> str | None:
    """Name of the layout that a file states for all people; None = it states none."""
    if not isinstance(content, dict):
        return None
    meta = content.get("meta_info")
    data_set = meta.get("dataset_name") if isinstance(meta, dict) else None
    is_known = isinstance(data_set, str) and data_set in layouts()
    return content.get(LAYOUT_KEY, data_set if is_known else None)


def _read_frames(
    result: PeopleFile, frames: list[dict[str, Any]], layout_of: LayoutOf, *, from_1: bool
) -> None:
    """Add the people of a video's frames. mmpose's demo counts from 1, its inferencer from 0."""
    first = 0 if not from_1 or 0 in [frame.get("frame_id") for frame in frames] else 1
    result.images = []
    for at, frame in enumerate(frames):
        number, people = frame.get("frame_id", at + first), frame["instances"]
        if type(number) is not int or number < first or not isinstance(people, list):
            raise UnreadableDetections(
                f"has frame {quoted(number)} with {quoted(people)}, expected 'frame_id' from "
                f"{first} and a list 'instances'"
            )
        key = ImageKey(number - first, None)
        result.images.append(key)
        for index, person in enumerate(people):
            where = f"frame {number}, person {index}"
            _add(result, person, where, lambda _, key=key: key, layout_of)  # type: ignore[misc]


def _add(
    result: PeopleFile,
    entry: Any,
    where: str,
    image: Callable[[dict[str, Any]], ImageKey],
    layout_of: LayoutOf,
) -> None:
    """Add one person to ``result``, or a fault.

    ``image`` and ``layout_of`` return the image and the stated layout of an entry.
    """
    key = ImageKey(None, None)
    result.entries += 1
    try:
        if not isinstance(entry, dict):
            raise ValueError(f"expected a person, found {quoted(entry)}")
        key = image(entry)
        result.results.append((key, _person(result, entry, layout_of(entry))))
    except ValueError as error:
        result.add_fault(where, key, error)


def _person(result: PeopleFile, entry: dict[str, Any], layout: str | None) -> np.ndarray:
    """Keypoints (135, 3) of one person; raises ValueError with the reason if there are none."""
    if "keypoints" not in entry:
        raise ValueError(f"has no 'keypoints' but {quoted(entry)}")
    points = _points("keypoints", entry["keypoints"], entry.get("keypoint_scores"))
    parts = {key: names for key, names in _PARTS.items() if entry.get(key)}
    if not parts:
        return to_shared(points, result.layout_of(len(points), layout).points)
    lists: list[tuple[str, np.ndarray, tuple[str, ...]]] = [("keypoints", points, BODY)]
    lists += [(key, _points(key, entry[key], None), names) for key, names in parts.items()]
    for key, values, names in lists:
        if len(values) != len(names):
            raise ValueError(f"{key} has {len(values)} points, expected {len(names)}")
    all_names = tuple(name for _, _, names in lists for name in names)
    return to_shared(np.concatenate([values for _, values, _ in lists]), all_names)


def _points(key: str, values: Any, scores: Any) -> np.ndarray:
    """Points (K, 3) of x, y, confidence; raises ValueError with the reason if there are none."""
    array = _numbers(key, values)
    if scores is not None:
        confidence = _numbers("keypoint_scores", scores)
        if array.ndim == 1 and array.size == 2 * confidence.size:
            array = array.reshape(-1, 2)
        if array.ndim != 2 or array.shape[1] < 2 or confidence.shape != (len(array),):
            raise ValueError(
                f"{key} has the shape {list(array.shape)} and keypoint_scores "
                f"{list(confidence.shape)}, expected K times x, y and K"
            )
        return np.column_stack([array[:, :2], confidence])
    if array.ndim == 1 and array.size % 3 == 0:
        array = array.reshape(-1, 3)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(
            f"{key} has the shape {list(array.shape)}, expected x, y, confidence of every point, "
            "or x, y and 'keypoint_scores'"
        )
    return array


def _numbers(key: str, values: Any) -> np.ndarray:
    """An array of numbers, None as NaN; raises ValueError for anything else."""
    try:
        array = np.array(_replace_none(values), np.float64)
    except (TypeError, ValueError, OverflowError, RecursionError):
        raise ValueError(f"{key} is {quoted(values)}, expected lists of numbers") from None
    if array.ndim == 3 and len(array) == 1:
        array = array[0]  # mmpose's arrays keep an axis of one person
    if array.ndim not in (1, 2):
        raise ValueError(f"{key} is {quoted(values)}, expected lists of numbers")
    return array


def _replace_none(values: Any) -> Any:
    """Nested lists with NaN for None, which stands for NaN in JSON of some libraries."""
    if isinstance(values, list):
        return [_replace_none(v) for v in values]
    if values is None:
        return np.nan
    if isinstance(values, str):
        raise ValueError
    return values
