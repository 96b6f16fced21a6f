"""People's keypoints as JSON in COCO's manner: COCO-WholeBody, mmpose, AlphaPose.

A person is an object with ``keypoints``: x, y, confidence of every point in one flat list or a list
a point, or x, y alone beside ``keypoint_scores`` (mmpose). Feet, face and hands may be lists of
their own (``foot_kpts``, ``face_kpts``, ``lefthand_kpts``, ``righthand_kpts``: COCO-WholeBody's
results). How many points there are says which:
:mod:`intercap_core.formats.detections.keypoint_layouts`.

A file is a list of people who name their image, a data set (``images``, ``annotations``), a list of
frames (``frame_id``, ``instances``: mmpose of a video), either below ``instance_info`` (its demo),
or the people of one image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from intercap_core.formats.detections.coco import (
    ImageKey,
    UnreadableCandidates,
    files_of,
    image_of,
    listed_images,
)
from intercap_core.formats.detections.keypoint_layouts import (
    COCO_BODY,
    COCO_FEET,
    FACE_68,
    HANDS,
    KNOWN_COUNTS,
    LAYOUTS,
    to_shared,
)
from intercap_core.inputs.files import quoted

# Lists beside COCO's 17 points, and how COCO-WholeBody orders their points.
_PARTS = {
    "foot_kpts": COCO_FEET,
    "face_kpts": FACE_68,
    "lefthand_kpts": HANDS[:21],
    "righthand_kpts": HANDS[21:],
}


@dataclass
class PeopleFile:
    """The people (135, 3) of one file, each with the image it is in; see ``CandidateFile``."""

    results: list[tuple[ImageKey, np.ndarray]] = field(default_factory=list)
    images: list[ImageKey] | None = None
    faults: list[str] = field(default_factory=list)
    faulty: list[ImageKey] = field(default_factory=list)
    entries: int = 0


def people_of(content: Any, *, one_image: bool = False) -> PeopleFile:
    """The people in parsed JSON, in order, their numbers as written.

    ``one_image``: they need not say their image. What cannot be used is left out, which the result
    tells. Raises :class:`UnreadableCandidates` where the file is of none of these forms.
    """
    frames, first = _frames(content)
    if frames is not None:
        return _people_of_frames(frames, first)
    found, entries, files = PeopleFile(), content, {}
    if isinstance(content, dict):
        entries = content.get("instance_info", content.get("annotations"))
        found.images = listed_images(content)
        files = files_of(found.images or [])
    if not isinstance(entries, list):
        raise UnreadableCandidates(
            f"holds {quoted(content)}, expected OpenPose's 'people', a list of people with "
            "'keypoints', COCO's 'annotations' or mmpose's 'instance_info'"
        )
    for index, entry in enumerate(entries):
        _add(found, entry, f"entry {index}", partial(image_of, files=files, one_image=one_image))
    return found


def _frames(content: Any) -> tuple[list[dict[str, Any]] | None, int]:
    """The list of frames of a video, None = the file is of another form, and the first's number.

    mmpose's demo counts frames from 1, its inferencer from 0.
    """
    entries, first = content, 0
    if isinstance(content, dict):
        entries, first = content.get("instance_info"), 1
    if not isinstance(entries, list) or not entries:
        return None, 0
    if not all(isinstance(e, dict) and "instances" in e for e in entries):
        return None, 0
    numbers = [e.get("frame_id") for e in entries]
    return entries, 0 if 0 in numbers else first


def _people_of_frames(frames: list[dict[str, Any]], first: int) -> PeopleFile:
    images: list[ImageKey] = []
    found = PeopleFile(images=images)
    for place, frame in enumerate(frames):
        number, people = frame.get("frame_id", place + first), frame["instances"]
        if type(number) is not int or number < first or not isinstance(people, list):
            raise UnreadableCandidates(
                f"has frame {quoted(number)} with {quoted(people)}, expected 'frame_id' from "
                f"{first} and a list 'instances'"
            )
        key = ImageKey(number - first, None)
        images.append(key)
        for index, person in enumerate(people):
            _add(found, person, f"frame {number}, person {index}", partial(_always, key))
    return found


def _always(key: ImageKey, _: dict[str, Any]) -> ImageKey:
    return key


def _add(
    found: PeopleFile, entry: Any, where: str, image: Callable[[dict[str, Any]], ImageKey]
) -> None:
    key = ImageKey(None, None)
    found.entries += 1
    try:
        if not isinstance(entry, dict):
            raise ValueError(f"expected a person, found {quoted(entry)}")
        key = image(entry)
        found.results.append((key, _person(entry)))
    except ValueError as error:
        told = key.name if key.name is not None else key.number
        found.faults.append(f"{where}{f' (image {told})' if told is not None else ''}: {error}")
        found.faulty.append(key)


def _person(entry: dict[str, Any]) -> np.ndarray:
    """One person's keypoints (135, 3); raises ValueError with what is wrong."""
    if "keypoints" not in entry:
        raise ValueError(f"has no 'keypoints' but {quoted(entry)}")
    points = _points("keypoints", entry["keypoints"], entry.get("keypoint_scores"))
    parts = {key: names for key, names in _PARTS.items() if entry.get(key)}
    if not parts:
        if len(points) not in LAYOUTS:
            raise ValueError(
                f"has {len(points)} keypoints, expected one of {KNOWN_COUNTS} (133 = "
                "COCO-WholeBody); run a whole-body model"
            )
        return to_shared(points, LAYOUTS[len(points)])
    names: tuple[str, ...] = COCO_BODY
    lists = [(points, names)]
    for key, own in parts.items():
        lists.append((_points(key, entry[key], None), own))
        names += own
    for (values, own), key in zip(lists, ("keypoints", *parts), strict=True):
        if len(values) != len(own):
            raise ValueError(f"{key} has {len(values)} points, expected {len(own)}")
    return to_shared(np.concatenate([values for values, _ in lists]), names)


def _points(key: str, values: Any, scores: Any) -> np.ndarray:
    """Points (K, 3) float64 of x, y, confidence; raises ValueError with what is wrong."""
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
            "or 'keypoint_scores' beside x, y"
        )
    return array


def _numbers(key: str, values: Any) -> np.ndarray:
    """An array of numbers, None as NaN; raises ValueError where it is none."""
    try:
        array = np.array(_without_none(values), np.float64)
    except (TypeError, ValueError, OverflowError, RecursionError):
        raise ValueError(f"{key} is {quoted(values)}, expected lists of numbers") from None
    if array.ndim == 3 and len(array) == 1:
        array = array[0]  # mmpose's arrays keep an axis of one person
    if array.ndim not in (1, 2):
        raise ValueError(f"{key} is {quoted(values)}, expected lists of numbers")
    return array


def _without_none(values: Any) -> Any:
    if isinstance(values, list):
        return [_without_none(v) for v in values]
    if values is None:  # for NaN, in JSON that careful libraries wrote
        return np.nan
    if isinstance(values, str):
        raise ValueError
    return values
