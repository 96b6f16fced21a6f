"""Masks decoded onto every n-th pixel, in the window of the whole mask.

The tracker compares silhouettes of about a hundred pixels. Decoding a full 1080p mask for each
candidate of each view would cost more than the fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numba
import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.masks import Runs


@dataclass(frozen=True, eq=False)
class ReducedMask:
    """A mask in a window of the reduced image."""

    x0: int
    """Column of the first pixel in the reduced image."""
    y0: int
    """Row of the first pixel."""
    mask: np.ndarray
    """(h, w) bool."""

    @property
    def placed(self) -> tuple[np.ndarray, int, int]:
        """The three fields in the form in which compiled functions take a mask."""
        return self.mask, self.x0, self.y0

    def window(self, x0: int, y0: int, height: int, width: int) -> np.ndarray:
        """Return the mask in another window of the reduced image, False outside of its own."""
        return cut(self.placed, x0, y0, height, width)

    def sample(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the mask (N,) at integer reduced pixels x, y (N,)."""
        column, row = x - self.x0, y - self.y0
        inside = (
            (column >= 0) & (row >= 0) & (column < self.mask.shape[1]) & (row < self.mask.shape[0])
        )
        values = np.zeros(len(x), bool)
        values[inside] = self.mask[row[inside], column[inside]]
        return values

    @cached_property
    def area(self) -> int:
        """Number of pixels set."""
        return int(np.count_nonzero(self.mask))


@numba.njit(cache=True, nogil=True)
def cut(placed, left, top, height, width):
    """Return a mask (:attr:`ReducedMask.placed`) in the window from (left, top).

    The result (height, width) bool is False outside of the mask.
    """
    mask, x0, y0 = placed
    result = np.zeros((height, width), np.bool_)
    first, last = max(left, x0), min(left + width, x0 + mask.shape[1])
    upper, lower = max(top, y0), min(top + height, y0 + mask.shape[0])
    if first < last and upper < lower:
        result[upper - top : lower - top, first - left : last - left] = mask[
            upper - y0 : lower - y0, first - x0 : last - x0
        ]
    return result


@numba.njit(cache=True, nogil=True)
def covers(placed, x, y):
    """Return whether pixel (x, y) of the image is set in a mask (:attr:`ReducedMask.placed`)."""
    mask, x0, y0 = placed
    column, row = x - x0, y - y0
    return 0 <= column < mask.shape[1] and 0 <= row < mask.shape[0] and mask[row, column]


EMPTY = ReducedMask(0, 0, np.zeros((0, 0), bool))


def reduced_lens(lens: Intrinsics, step: int) -> Intrinsics:
    """Return the lens whose pixel (i, j) is pixel (i * step, j * step) of ``lens``."""
    return Intrinsics(
        (lens.width - 1) // step + 1,
        (lens.height - 1) // step + 1,
        lens.fx / step,
        lens.fy / step,
        lens.cx / step,
        lens.cy / step,
        lens.distortion,
        lens.metric_radius,
    )


def decode(rle: bytes, lens: Intrinsics, step: int) -> ReducedMask:
    """Decode a COCO compressed RLE of the image of ``lens`` at every ``step``-th pixel.

    Raises ValueError if the runs do not fill the image.
    """
    if not rle:
        return EMPTY
    runs = Runs(rle, lens.height, lens.width)
    x, y, width, height = runs.box
    left, top = -(-x // step), -(-y // step)  # rounded up
    shape = (y + height - 1) // step - top + 1, (x + width - 1) // step - left + 1
    if 0 in shape:
        return EMPTY
    mask = np.zeros(shape, np.bool_)
    _fill(runs.ends, lens.height, step, left, top, mask)
    return ReducedMask(left, top, mask)


@numba.njit(cache=True, nogil=True)
def _fill(ends: np.ndarray, height: int, step: int, left: int, top: int, mask: np.ndarray) -> None:
    """Set the reduced pixels of runs in ``mask``, whose first pixel is (left, top).

    ``ends`` (R,) are the ends of runs that are alternately unset and set, column by column: pixel
    number = column * height + row, at full resolution.
    """
    for i in range(1, len(ends), 2):
        start, end = ends[i - 1], ends[i]
        if end > start:
            for column in range(start // height, (end - 1) // height + 1):
                if column % step:
                    continue
                first = max(start - column * height, 0)
                last = min(end - 1 - column * height, height - 1)
                for row in range((first + step - 1) // step, last // step + 1):
                    mask[row - top, column // step - left] = True


def remove_person(mask: ReducedMask, person: ReducedMask, step: int) -> ReducedMask | None:
    """Remove the person from a candidate that covers both person and object.

    Slivers along the person's silhouette are discarded.

    Args:
        mask: the candidate.
        person: the person's mask.
        step: reduction of both masks.

    Returns:
        The largest remaining part. None if the candidate does not cover the person, or nothing
            else.
    """
    least = 0.25 * person.area  # pixels of the person that the candidate covers
    if not person.area or mask.area < least:
        return None
    here = person.window(mask.x0, mask.y0, *mask.mask.shape)
    if (here & mask.mask).sum() < least:
        return None
    rest = (mask.mask & ~here).astype(np.uint8)
    border_px = 6.0  # difference of two masks of one person at their borders, at full resolution
    size = max(3, 2 * round(0.5 * border_px / step) + 1)
    opened = cv2.morphologyEx(rest, cv2.MORPH_OPEN, np.ones((size, size), np.uint8))
    if not opened.any():
        return None
    _, parts, sizes, _ = cv2.connectedComponentsWithStats(opened)
    largest = 1 + int(sizes[1:, cv2.CC_STAT_AREA].argmax())
    left, top, width, height, area = sizes[largest]
    if area < 0.01 * mask.area:
        return None
    kept = parts[top : top + height, left : left + width] == largest
    return ReducedMask(mask.x0 + int(left), mask.y0 + int(top), kept)
