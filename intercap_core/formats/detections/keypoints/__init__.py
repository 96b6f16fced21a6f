"""Keypoints of detectors: the layouts of their points and the readers of their files.

A module of this package adds layouts by ``LAYOUTS``, a tuple of :class:`KeypointLayout`, or a form
of file by ``READER``, a :class:`KeypointReader`. docs/extending.md has an example of each.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.body.keypoints import (
    BODY,
    KEYPOINT_INDEX,
    KEYPOINT_NAMES,
    LIMB_BONES,
    NUM_KEYPOINTS,
    of_side,
)
from intercap_core.formats.detections.coco import (
    DetectionFile,
    UnreadableDetections,
    read_json,
)
from intercap_core.inputs.files import quoted
from intercap_core.plugins import modules_of

# Key by which a file, a person in it or an ONNX model's metadata may name its layout.
LAYOUT_KEY = "keypoint_layout"


@dataclass(frozen=True)
class KeypointLayout:
    """Points that a detector gives for a person."""

    name: str
    """Name by which a file may state the layout."""
    points: tuple[str, ...]
    """Name of each point in the detector's order. Points are matched by name; names that
    ``body.keypoints.KEYPOINT_NAMES`` does not have are left out."""
    is_default: bool = False
    """Whether people with this number of points have this layout if their file names none. Needed
    only if another layout has the same number of points."""


@dataclass
class PeopleFile(DetectionFile[np.ndarray]):
    """Keypoints (135, 3) of each person of one file: x, y (px) and confidence as written."""

    assumed: set[str] = field(default_factory=set)
    """Layouts that were selected by the number of points alone."""

    def layout_of(self, count: int, name: str | None) -> KeypointLayout:
        """The layout of a person, as :func:`find_layout`; records what was assumed."""
        layout = find_layout(count, name)
        if name is None:
            self.assumed.add(layout.name)
        return layout


@dataclass(frozen=True)
class KeypointReader:
    """Reader of one form of keypoint files."""

    tool: str
    """Name of the detector."""
    expects: str
    """Content of the files, for messages."""
    recognises: Callable[[Any], bool]
    """Whether loaded content is of this form."""
    read: Callable[[Any, bool, str | None], PeopleFile]
    """Reads loaded content. Raises :class:`UnreadableDetections` if nothing can be used. Arguments:

    - the content;
    - True for a file of one image, whose people need not state their image;
    - name of the layout according to the settings, None = the file or the number of points decides.
    """
    camera_files: tuple[str, ...] = ()
    """Names of files for all images of a camera, such as ``{camera}.json``; () = there are none."""
    image_files: tuple[str, ...] = ()
    """Names of files for one image in the camera's folder, such as ``{image}.json``."""
    load: Callable[[Path], Any] = read_json
    """Loads a file. Readers with the same function share the files that their names match."""
    rank: int = 1
    """Position in the order in which readers are tried; the lowest is first."""

    def match_images(self, paths: Iterable[Path]) -> dict[str, Path]:
        """Files that may hold one image, by the image's name."""
        matched = {}
        for path in paths:
            for name in self.image_files:
                before, after = name.split("{image}")
                match = re.fullmatch(f"{re.escape(before)}(.+){re.escape(after)}", path.name)
                if match:
                    matched[match[1]] = path
                    break
        return matched


@cache
def layouts() -> dict[str, KeypointLayout]:
    """All layouts by name."""
    modules = modules_of("intercap_core.formats.detections.keypoints")
    return {layout.name: layout for module in modules for layout in getattr(module, "LAYOUTS", ())}


@cache
def readers() -> tuple[KeypointReader, ...]:
    """All readers in the order in which they are tried."""
    modules = modules_of("intercap_core.formats.detections.keypoints")
    unsorted = [module.READER for module in modules if hasattr(module, "READER")]
    return tuple(sorted(unsorted, key=lambda reader: (reader.rank, reader.tool)))


def find_layout(count: int, name: str | None = None) -> KeypointLayout:
    """The layout of a person with ``count`` points; ``name`` if the file states it.

    Raises ValueError if there is none. The message continues a sentence that begins with the name
    of the person or the model.
    """
    if name is not None:
        if not isinstance(name, str) or name not in layouts():  # from a user's file
            known = ", ".join(sorted(layouts()))
            raise ValueError(f"states {LAYOUT_KEY} {quoted(name)}, expected one of {known}")
        expected = len(layouts()[name].points)
        if expected != count:
            raise ValueError(f"has {count} keypoints, expected the {expected} of layout {name}")
        return layouts()[name]
    matching = [layout for layout in layouts().values() if len(layout.points) == count]
    matching = [layout for layout in matching if layout.is_default] or matching
    if not matching:
        counts = sorted({len(layout.points) for layout in layouts().values()})
        raise ValueError(
            f"has {count} keypoints, expected one of {', '.join(map(str, counts))} "
            "(133 = COCO-WholeBody); run a whole-body model"
        )
    if len(matching) > 1:
        names = ", ".join(layout.name for layout in matching)
        raise ValueError(f"has {count} keypoints, as have layouts {names}; state '{LAYOUT_KEY}'")
    return matching[0]


# Bones of any body layout, by the names of their ends.
_BONES = [
    *of_side("left", LIMB_BONES), *of_side("right", LIMB_BONES),
    *of_side("left", (("shoulder", "hip"), ("eye", "ear"), ("big_toe", "small_toe"))),
    *of_side("right", (("shoulder", "hip"), ("eye", "ear"), ("big_toe", "small_toe"))),
    ("neck", "left_shoulder"), ("neck", "right_shoulder"), ("nose", "neck"),
    ("nose", "left_eye"), ("nose", "right_eye"), ("left_hip", "right_hip"),
    ("mid_hip", "left_hip"), ("mid_hip", "right_hip"),
]  # fmt: skip
MAX_COMPARED = 2000  # people of a camera; one takes 30 kB at the peak (tracemalloc, 20,000 people)
BONE_QUANTILE = 0.75  # a few bones with a misplaced end do not change it
_BONE_ENDS = np.array([[KEYPOINT_INDEX[end] for end in bone] for bone in _BONES])


def visible(points: np.ndarray) -> np.ndarray:
    """Mask (...) of points (..., 3) that are finite, not at (0, 0), and of confidence above 0."""
    with np.errstate(invalid="ignore"):
        return np.isfinite(points).all(-1) & (points[..., 2] > 0) & (points[..., :2] != 0).any(-1)


def _upper_quartile(lengths: np.ndarray) -> np.ndarray:
    return np.nanquantile(lengths, BONE_QUANTILE, axis=1)


def mean_length(lengths: np.ndarray) -> np.ndarray:
    """Mean (P,) of the known lengths (P, B); sensitive to a few misplaced points."""
    return np.nanmean(lengths, axis=1)


def compare_bones(
    people: np.ndarray, statistic: Callable[[np.ndarray], np.ndarray] = _upper_quartile
) -> float | None:
    """Length of a person's bones as a share of the median distance of two body points.

    A wrong layout joins points at random, so its share is near 1. Returns the median over at most
    ``MAX_COMPARED`` people; None if no person has enough points.

    Args:
        people: keypoints (P, 135, 3) in the shared order.
        statistic: one length (P,) for the lengths (P, B) of a person's bones, NaN = unseen.
    """
    body = people[:, BODY]
    seen = visible(body)
    points = np.where(seen[..., None], body[..., :2], np.nan)[seen.sum(1) >= 8]
    extent = np.nanmax(points, axis=1, initial=-np.inf) - np.nanmin(points, axis=1, initial=np.inf)
    # collinear points do not determine a layout
    points = points[extent.min(-1) > 0.02 * extent.max(-1)]
    if not len(points):
        return None
    if len(points) > MAX_COMPARED:
        points = points[np.linspace(0, len(points) - 1, MAX_COMPARED).astype(int)]
    apart = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
    first, second = np.triu_indices(points.shape[1], 1)
    bones = apart[:, _BONE_ENDS[:, 0], _BONE_ENDS[:, 1]]
    known = np.isfinite(bones).sum(1) >= 5
    if not known.any():
        return None
    bones, pairs = bones[known], apart[known][:, first, second]
    share = statistic(bones) / np.maximum(np.nanmedian(pairs, axis=1), 1e-9)
    return float(np.median(share))


def to_shared(points: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Order points of a detector as the 135 keypoints of ``body.keypoints``.

    Returns (..., 135, 3). Points that the detector does not give have confidence 0. Those include
    COCO's neck and middle of the hips, which are estimated in space later
    (:func:`intercap_core.person.subject_joints.fill_middles`).

    Args:
        points: (..., K, 3) of x, y, confidence.
        names: name of each of the K points.
    """
    index = {name: at for at, name in enumerate(KEYPOINT_NAMES)}
    result = np.zeros((*points.shape[:-2], NUM_KEYPOINTS, 3))
    kept = [at for at, name in enumerate(names) if name in index]
    result[..., [index[names[at]] for at in kept], :] = points[..., kept, :]
    return result


def read_people(
    content: Any,
    load: Callable[[Path], Any] = read_json,
    *,
    one_image: bool,
    layout: str | None = None,
) -> PeopleFile:
    """Read loaded content by the reader that recognises it.

    Raises :class:`UnreadableDetections` if there is none, or as the reader does.

    Args:
        load: function that loaded the file.
        layout: name of the layout according to the settings.
    """
    possible = [
        reader
        for reader in readers()
        if reader.load is load and (reader.image_files if one_image else reader.camera_files)
    ]
    for reader in possible:
        if reader.recognises(content):
            return reader.read(content, one_image, layout)
    expected = ", ".join(reader.expects for reader in possible)
    raise UnreadableDetections(f"holds {quoted(content)}, expected {expected}")
