"""Masks that detectors keep as image files: an instance a file, or several numbered in one."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from intercap_core.formats.detections.class_names import MAX_LABEL
from intercap_core.formats.detections.instance import (
    MASK_THRESHOLD,
    MAX_PIXELS,
    PERSON_LABEL,
    Instance,
    instance_of,
    resized,
    scale_to,
)
from intercap_core.formats.recordings.behave import frame_folders
from intercap_core.formats.recordings.image_files import encoded_size
from intercap_core.inputs.files import MAX_IMAGE_BYTES, Unreadable, printable, read_bytes

BEHAVE_PERSON = ("person_mask",)
BEHAVE_OBJECT = ("obj_rend_mask", "obj_mask")  # the second where the first is not there
SUFFIXES = ("png", "jpg")  # without loss first
_NUMBERED = re.compile(r"\D*(\d{1,9})\.(?:png|jpe?g)", re.IGNORECASE)
MAX_MASK_VALUES = 1000  # instances in one mask image; an image with more is not a mask
WHITE = 255
BETWEEN = "__"  # an image's name, a label and a number in the name of a mask
_AROUND_LABEL = "0123456789_-. "


class UnreadableMask(Exception):
    """The file is no mask of the image; says why, in words that fit after its name."""


class MaskFile(NamedTuple):
    """One file of masks of one image.

    ``inverted``: dark pixels are the instance. ``numbered``: where no pixel is white, each value
    but 0 is an instance of its own.
    """

    path: Path
    label: str
    inverted: bool = False
    numbered: bool = False


def read_masks(file: MaskFile, size: tuple[int, int]) -> list[Instance]:
    """Read the masks of an image of ``size`` (width, height), score 1; empty ones are none.

    A mask of the whole picture at another resolution is scaled. Raises :class:`UnreadableMask`.
    """
    try:
        content = read_bytes(file.path, MAX_IMAGE_BYTES)
    except Unreadable as error:
        raise UnreadableMask(error.reason) from None
    found = encoded_size(content)
    if found is None or found[0] * found[1] > MAX_PIXELS:
        raise UnreadableMask("is no image" if found is None else "is too large an image")
    kind = cv2.IMREAD_UNCHANGED if file.numbered else cv2.IMREAD_GRAYSCALE
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), kind)
    except cv2.error:  # of an image that takes more memory than OpenCV allows
        image = None
    if image is None:
        raise UnreadableMask("is no image")
    if image.ndim == 3:
        image = image[..., :3].max(-1)
    try:
        scale_to((image.shape[1], image.shape[0]), size)
    except ValueError:
        raise UnreadableMask(
            f"has {image.shape[1]}x{image.shape[0]} pixels, the image {size[0]}x{size[1]}"
        ) from None
    instances = []
    for mask in _split(image, file):
        fitting = mask if mask.shape == size[::-1] else resized(mask, size)
        instance = instance_of(file.label, 1.0, fitting)
        if instance is not None:
            instances.append(instance)
    return instances


def _split(image: np.ndarray, file: MaskFile) -> Iterator[np.ndarray]:
    """The masks (H, W) bool that a grey image holds."""
    if file.inverted:
        yield image < MASK_THRESHOLD
    elif not file.numbered or (image.dtype == np.uint8 and image.max() == WHITE):
        yield image >= MASK_THRESHOLD
    else:
        values = np.unique(image)
        if len(values) > MAX_MASK_VALUES:
            raise UnreadableMask(
                f"has {len(values)} different values, expected black and white or a number for "
                "each instance"
            )
        for value in values[values != 0]:
            yield image == value


def instance_masks(folder: Path) -> dict[str, list[MaskFile]]:
    """Masks of one camera by the name of their image.

    ``<image>.png`` without a label, ``<image>__<label>.png``, ``<image>__<label>__<n>.png``, or
    files in a folder ``<image>/`` whose names hold the label between digits: ``3_cup.png``.
    """
    found: dict[str, list[MaskFile]] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            for inner in sorted(path.iterdir()):
                if _is_png(inner):
                    label = printable(inner.stem).strip(_AROUND_LABEL)[:MAX_LABEL]
                    found.setdefault(path.name, []).append(MaskFile(inner, label, numbered=True))
        elif _is_png(path):
            image, _, rest = path.stem.partition(BETWEEN)
            label = printable(rest.partition(BETWEEN)[0])[:MAX_LABEL]
            found.setdefault(image, []).append(MaskFile(path, label, numbered=True))
    return found


def _is_png(path: Path) -> bool:
    return path.suffix.lower() == ".png" and not path.name.startswith(".") and path.is_file()


def release_masks(candidates: Path, camera: str) -> dict[int, MaskFile] | None:
    """Person masks of one camera as the InterCap release's tools keep them, by image number.

    ``<camera>/<number>.png`` or ``BodyIndexColor_<n>/<number>.png``, without ``_<n>`` for camera 1,
    with 0 for the person and 255 for the background; None where there is no such folder.
    """
    number = camera[1:]
    names = [camera, f"BodyIndexColor_{number}", *(["BodyIndexColor"] if number == "1" else [])]
    for name in names:
        folder = candidates / name
        if folder.is_dir():
            matches = ((path, _NUMBERED.fullmatch(path.name)) for path in sorted(folder.iterdir()))
            return {int(m.group(1)): MaskFile(path, PERSON_LABEL, True) for path, m in matches if m}
    return None


class BehaveFiles:
    """Keypoints and masks beside BEHAVE's images, by the time of the image, microseconds.

    The masks are of one person and of the sequence's object, which is given ``object_label``; None
    leaves them out.
    """

    def __init__(self, recordings: Path, object_label: str | None) -> None:
        self._folders = frame_folders(recordings) if recordings.is_dir() else {}
        self._labels: dict[tuple[str, ...], str] = {BEHAVE_PERSON: PERSON_LABEL}
        if object_label is not None:
            self._labels[BEHAVE_OBJECT] = object_label

    def keypoints(self, time_us: int, camera: str) -> Path | None:
        """The keypoint file of one image, None = there is none."""
        return self._existing(time_us, f"{camera}.color.json")

    def masks(self, time_us: int, camera: str) -> list[MaskFile]:
        """The masks of one image."""
        found = []
        for kinds, label in self._labels.items():
            paths = (
                self._existing(time_us, f"{camera}.{kind}.{suffix}")
                for kind in kinds
                for suffix in SUFFIXES
            )
            path = next((path for path in paths if path is not None), None)
            if path is not None:
                found.append(MaskFile(path, label))
        return found

    def _existing(self, time_us: int, name: str) -> Path | None:
        folder = self._folders.get(time_us)
        path = folder / name if folder is not None else None
        return path if path is not None and path.is_file() else None
