"""One segmented instance, and every form in which detectors write its mask.

Masks become compressed COCO RLE at the size of the colour image. A mask of the same picture at
another resolution is scaled. A mask of another aspect ratio is refused: it is of another image.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from intercap_core.formats.calibration.opencv import MAX_SIDE
from intercap_core.geometry.camera import masks
from intercap_core.inputs.files import quoted

MASK_THRESHOLD = 128  # grey level of 8 bits; JPEG blurs the two values of a mask
# Coordinates from 0 to 1, somewhat more outside the image, are shares of its width and height.
MAX_SHARE = 2.0
PERSON_LABEL = "person"  # name of the class of people in COCO and all lists that follow it


@dataclass(frozen=True)
class Instance:
    """One segmented instance."""

    label: str
    """Name of its class; "" = unknown."""
    score: float
    """From 0 to 1."""
    box: tuple[float, float, float, float]
    """x, y, width, height, px."""
    rle: bytes
    """Mask as compressed COCO RLE."""


def boxes_of(instances: list[Instance]) -> np.ndarray:
    """Boxes (N, 4) float32: x, y, width, height, px."""
    return np.array([i.box for i in instances], np.float32).reshape(-1, 4)


def make_instance(label: str, score: float, rle: bytes, size: tuple[int, int]) -> Instance | None:
    """The instance of a mask of an image of ``size`` (width, height); None if it is empty."""
    x, y, width, height = masks.Runs(rle, size[1], size[0]).box
    if not width:
        return None
    return Instance(label, score, (float(x), float(y), float(width), float(height)), rle)


def scale_to(own: tuple[int, int], size: tuple[int, int]) -> tuple[float, float]:
    """Factors (x, y) from a mask of size ``own`` (width, height) to an image of ``size``.

    Raises ValueError if the mask is no copy of the image at another resolution.
    """
    if own == size:
        return 1.0, 1.0
    x, y = size[0] / own[0], size[1] / own[1]
    # Networks reduce by 4 to 32; a side of a reduced image is rounded to a pixel.
    if x > 32 or abs(own[1] * x - size[1]) > max(x, 1):
        raise ValueError(
            f"the mask has {own[0]}x{own[1]} pixels, the image {size[0]}x{size[1]}; segment "
            "the images as recorded"
        )
    return x, y


def are_shares(coordinates: np.ndarray) -> bool:
    """Whether coordinates (N,) of one or more shapes are shares of the image's width and height.

    No person and no object that is used lies within the first two pixels of an image.
    """
    return coordinates.size > 0 and bool((np.abs(coordinates) <= MAX_SHARE).all())


def are_polygons_shares(segmentations: Iterable[Any]) -> bool:
    """Whether the corners of all polygons among a file's segmentations are shares.

    Whole numbers alone are pixels: a few pixels in the corner of the image, as ``findContours``
    outlines them. Polygons that are no finite numbers, and RLEs, are skipped.
    """
    is_any_fractional = False
    for segmentation in segmentations:
        for polygon in _polygons(segmentation) or ():
            try:
                corners = np.array(_numbers(polygon))
            except ValueError:
                continue
            if not corners.size or not np.isfinite(corners).all():
                continue
            if not are_shares(corners):
                return False
            is_any_fractional |= bool((corners % 1 != 0).any())
    return is_any_fractional


def reaches_beyond(segmentation: Any, factors: tuple[float, float], size: tuple[int, int]) -> bool:
    """Whether a corner of a polygon is more than a pixel outside an image of ``size``.

    ``factors`` scale the corners to pixels. False for an RLE.
    """
    for polygon in _polygons(segmentation) or ():
        corners = np.array(_numbers(polygon)[: len(polygon) // 2 * 2]).reshape(-1, 2) * factors
        if (corners < -1).any() or (corners > np.array(size) + 1).any():
            return True
    return False


def hint_on_size(outside: int, total: int) -> str:
    """Question for a note on detections outside the image, "" unless most of them are."""
    if 2 * outside <= total:
        return ""
    return "; are they of images of another size, or of another camera?"


def notes_on_extent(kind: str, extent: float, size: tuple[int, int]) -> list[str]:
    """Note if all detections lie in the upper left quarter of an image of ``size``.

    ``extent``: largest coordinate as a share of the image's width or height; 0 without detections.
    """
    if not 0 < extent < 0.5:
        return []
    return [
        f"all {kind} lie in the upper left quarter of the image of {size[0]}x{size[1]} pixels; are "
        "they of images of half the size?"
    ]


def resize_mask(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize a mask (h, w) to ``size`` (width, height): (H, W) bool."""
    grey = np.where(mask, np.uint8(255), np.uint8(0))
    return cv2.resize(grey, size, interpolation=cv2.INTER_LINEAR) >= MASK_THRESHOLD


def to_rle(
    segmentation: Any,
    size: tuple[int, int],
    stated: tuple[int, int] | None = None,
    *,
    shares: bool = False,
) -> tuple[bytes, tuple[float, float]]:
    """Compressed RLE of a segmentation, and the factors (x, y) by which the mask was scaled.

    Raises ValueError, whose message continues a sentence that begins with the entry's name.

    Args:
        segmentation: an RLE with size and counts (compressed, also as the text of Python's bytes;
            or a list of lengths), polygons, one flat polygon, or lists ``x`` and ``y`` of corners.
        size: width and height of the result.
        stated: size of the image according to the file. An RLE states its own size.
        shares: corners of polygons are shares of the image's width and height.
    """
    if isinstance(segmentation, dict) and "counts" in segmentation:
        return _from_rle(segmentation, size)
    given = _polygons(segmentation)
    if given is None:
        raise ValueError("has no segmentation; expected an RLE with size and counts, or polygons")
    polygons = [_numbers(polygon) for polygon in given]
    if shares:
        x, y = map(float, size)
    else:
        x, y = scale_to(stated, size) if stated is not None else (1.0, 1.0)
    scaled = [[v * (y if i % 2 else x) for i, v in enumerate(polygon)] for polygon in polygons]
    return masks.from_polygons(scaled, size[1], size[0]), (x, y)


def _from_rle(
    segmentation: dict[str, Any], size: tuple[int, int]
) -> tuple[bytes, tuple[float, float]]:
    """Convert an object with ``size`` (height, width) and ``counts``; see :func:`to_rle`."""
    stated = segmentation.get("size")
    if (
        not isinstance(stated, list)
        or len(stated) != 2
        or not all(type(n) is int and n > 0 for n in stated)
        or max(stated) > MAX_SIDE
    ):
        raise ValueError(
            f"the mask's size is {quoted(stated)}, expected [{size[1]}, {size[0]}] (height, "
            "width of the colour image)"
        )
    height, width = stated
    factors = scale_to((width, height), size)
    rle = _compressed(segmentation["counts"], height, width)
    runs = masks.Runs(rle, height, width)
    if factors == (1.0, 1.0):
        return rle, factors
    return masks.encode(resize_mask(runs.decode(), size)), factors


def _compressed(counts: Any, height: int, width: int) -> bytes:
    """Compressed RLE of ``counts`` that are compressed, text, or a list of run lengths."""
    if isinstance(counts, bytes):
        return counts
    if isinstance(counts, str):
        if counts[:2] in ("b'", 'b"') and counts[-1:] == counts[1]:  # str() of bytes
            counts = counts[2:-1].replace("\\\\", "\\")
        try:
            return counts.encode("ascii")
        except UnicodeEncodeError:
            raise ValueError(
                "its RLE holds characters that COCO's alphabet does not have"
            ) from None
    if isinstance(counts, list):
        try:
            return masks.from_counts(counts, height, width)
        except (TypeError, OverflowError):
            raise ValueError("its counts are not a list of whole numbers") from None
    raise ValueError("has no segmentation; its counts are neither text nor a list")


def _polygons(value: Any) -> list[list[Any]] | None:
    """Polygons as flat lists; None if the value holds none."""
    if isinstance(value, dict) and isinstance(value.get("x"), list):
        x, y = value["x"], value.get("y")
        if not isinstance(y, list) or len(x) != len(y):
            return None
        return [[v for corner in zip(x, y, strict=True) for v in corner]]
    if not isinstance(value, list):
        return None
    if value and all(type(v) in (int, float) for v in value):
        return [value]
    return value if all(isinstance(polygon, list) for polygon in value) else None


def _numbers(polygon: list[Any]) -> list[float]:
    try:
        return [float(v) for v in polygon]
    except (TypeError, ValueError, OverflowError):
        raise ValueError("a polygon is not a list of numbers") from None
