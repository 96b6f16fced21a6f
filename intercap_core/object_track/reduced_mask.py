"""Masks decoded straight onto every n-th pixel, in the smallest window that holds them.

The tracker compares silhouettes of a hundred pixels; decoding a full 1080p mask for each candidate
of each view would cost more than the fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics


@dataclass(frozen=True, eq=False)
class ReducedMask:
    """A mask (h, w) bool whose pixel [j, i] is pixel ((x0 + i), (y0 + j)) of the reduced image."""

    x0: int
    y0: int
    mask: np.ndarray

    def window(self, x0: int, y0: int, height: int, width: int) -> np.ndarray:
        """The mask on another window of the reduced image, False where this one has no pixel."""
        result = np.zeros((height, width), bool)
        own_height, own_width = self.mask.shape
        left, right = max(x0, self.x0), min(x0 + width, self.x0 + own_width)
        top, bottom = max(y0, self.y0), min(y0 + height, self.y0 + own_height)
        if left < right and top < bottom:
            result[top - y0 : bottom - y0, left - x0 : right - x0] = self.mask[
                top - self.y0 : bottom - self.y0, left - self.x0 : right - self.x0
            ]
        return result

    def sample(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The mask at integer reduced pixels x, y (N,): (N,) bool."""
        column, row = x - self.x0, y - self.y0
        inside = (
            (column >= 0) & (row >= 0) & (column < self.mask.shape[1]) & (row < self.mask.shape[0])
        )
        found = np.zeros(len(x), bool)
        found[inside] = self.mask[row[inside], column[inside]]
        return found

    @cached_property
    def area(self) -> int:
        """Number of pixels set."""
        return int(np.count_nonzero(self.mask))


EMPTY = ReducedMask(0, 0, np.zeros((0, 0), bool))


def reduced_lens(lens: Intrinsics, step: int) -> Intrinsics:
    """The lens whose pixel (i, j) is pixel (i * step, j * step) of ``lens``."""
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
    """Decode a COCO compressed RLE of ``lens``'s image at every ``step``-th pixel.

    Raises ValueError where the runs do not fill the image.
    """
    if not rle:
        return EMPTY
    runs = _counts(np.frombuffer(rle, np.uint8))
    if runs.sum() != lens.width * lens.height:
        raise ValueError(
            f"a mask of {runs.sum()} pixels does not fit an image of {lens.width} x {lens.height}"
        )
    left, right, top, bottom = _bounds(runs, lens.height, step)
    if left > right or top > bottom:
        return EMPTY
    mask = np.zeros((bottom - top + 1, right - left + 1), np.bool_)
    _fill(runs, lens.height, step, left, top, mask)
    return ReducedMask(left, top, mask)


@numba.njit(cache=True, nogil=True)
def _counts(text: np.ndarray) -> np.ndarray:
    """Run lengths of the compressed string, zeros first (format of pycocotools' maskApi.c)."""
    counts = np.empty(len(text), np.int64)
    number = 0
    position = 0
    while position < len(text):
        value, shift, more = np.int64(0), 0, True
        while more and position < len(text):
            bits = np.int64(text[position]) - 48
            value |= (bits & 0x1F) << shift
            more = (bits & 0x20) != 0
            position += 1
            shift += 5
            if not more and bits & 0x10:
                value |= np.int64(-1) << shift
        if number > 2:
            value += counts[number - 2]
        counts[number] = value
        number += 1
    return counts[:number]


@numba.njit(cache=True, nogil=True)
def _bounds(runs: np.ndarray, height: int, step: int) -> tuple[int, int, int, int]:
    """Reduced left, right, top, bottom, inclusive, of the reduced pixels set."""
    left, right, top, bottom = 1 << 30, -1, 1 << 30, -1
    start = 0
    for i in range(len(runs)):
        end = start + runs[i]
        if i % 2 == 1 and runs[i] > 0:
            for column in range(start // height, (end - 1) // height + 1):
                if column % step:
                    continue
                first = max(start - column * height, 0)
                last = min(end - 1 - column * height, height - 1)
                first, last = (first + step - 1) // step, last // step
                if first <= last:
                    left, right = min(left, column // step), max(right, column // step)
                    top, bottom = min(top, first), max(bottom, last)
        start = end
    return left, right, top, bottom


@numba.njit(cache=True, nogil=True)
def _fill(runs: np.ndarray, height: int, step: int, left: int, top: int, mask: np.ndarray) -> None:
    start = 0
    for i in range(len(runs)):
        end = start + runs[i]
        if i % 2 == 1 and runs[i] > 0:
            for column in range(start // height, (end - 1) // height + 1):
                if column % step:
                    continue
                first = max(start - column * height, 0)
                last = min(end - 1 - column * height, height - 1)
                for row in range((first + step - 1) // step, last // step + 1):
                    mask[row - top, column // step - left] = True
        start = end
