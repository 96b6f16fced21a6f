"""Masks that data sets keep as images, one file an image and instance."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from intercap_core.capture.behave import frame_folders
from intercap_core.detection import masks
from intercap_core.detection.coco import Instance
from intercap_core.detection.person_masks import PERSON_LABEL

HALF = 128  # of 8 bits; JPEG blurs the two values that a mask has
BEHAVE_PERSON = ("person_mask",)
BEHAVE_OBJECT = ("obj_rend_mask", "obj_mask")  # the second where the first is not there
SUFFIXES = ("png", "jpg")  # without loss first
_NUMBERED = re.compile(r"\D*(\d{1,9})\.(?:png|jpe?g)", re.IGNORECASE)


class UnreadableMask(Exception):
    """The file is no mask of the image; says why, in words that fit after its name."""


class MaskFile(NamedTuple):
    """One instance's mask; ``inverted``: dark pixels are the instance."""

    path: Path
    label: str
    inverted: bool = False


def read_mask(file: MaskFile, size: tuple[int, int]) -> Instance | None:
    """Read a mask for an image of ``size`` (width, height) with score 1; None = it is empty.

    Raises :class:`UnreadableMask`.
    """
    try:
        content = np.frombuffer(file.path.read_bytes(), np.uint8)
    except OSError as error:
        raise UnreadableMask(f"cannot be read ({error.strerror})") from None
    image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE) if len(content) else None
    if image is None:
        raise UnreadableMask("is no image")
    if image.shape != size[::-1]:
        raise UnreadableMask(
            f"has {image.shape[1]}x{image.shape[0]} pixels, the image {size[0]}x{size[1]}"
        )
    rle = masks.encode((image < HALF) if file.inverted else (image >= HALF))
    x, y, width, height = masks.Runs(rle, *image.shape).box
    if not width:
        return None
    return Instance(file.label, 1.0, (float(x), float(y), float(width), float(height)), rle)


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

    The masks are of one person and of the sequence's object, which is given ``object_label``.
    """

    def __init__(self, recordings: Path, object_label: str) -> None:
        self._folders = frame_folders(recordings) if recordings.is_dir() else {}
        self._labels = {BEHAVE_PERSON: PERSON_LABEL, BEHAVE_OBJECT: object_label}

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
