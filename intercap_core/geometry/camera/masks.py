"""COCO's run-length masks: validation, and reading of single pixels without decoding the image.

A compressed RLE is the string of pycocotools' ``maskApi``: lengths of alternate runs of 0 and 1, in
column-major order, beginning with 0. It does not contain the image's size, so every function takes
the size. Strings are validated here first, because the C decoder writes past its buffer if the runs
do not fill the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numba
import numpy as np
from pycocotools import mask as coco_mask

_ZERO = ord("0")  # the first character of COCO's alphabet
_LONGEST_NUMBER = 7  # characters of 5 bits: enough for a run of 2^34 pixels


class Runs:
    """A mask of one image as runs.

    ``ends`` (n,) int64 is the end of each run in the column-major image: the index after its last
    pixel. Runs 0, 2, 4, ... are background. Raises ValueError if the string is no RLE of
    ``height`` x ``width`` pixels. Its message continues a sentence about the mask.
    """

    def __init__(self, rle: bytes, height: int, width: int) -> None:
        self.height, self.width = height, width
        self.ends = _parse(rle)
        filled = int(self.ends[-1]) if len(self.ends) else 0
        if filled != height * width:
            raise ValueError(
                f"its runs hold {filled} pixels, expected {height * width} "
                f"({width} x {height}, the colour image)"
            )

    @property
    def area(self) -> int:
        """Number of pixels set."""
        return int(np.diff(self.ends, prepend=0)[1::2].sum())

    @cached_property
    def box(self) -> tuple[int, int, int, int]:
        """x, y, width, height of the pixels set; all 0 if none is set."""
        x, y, width, height = _box(self.ends, self.height)
        return x, y, width, height

    def sample(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the mask (...) bool at integer pixels x, y (...), False outside the image."""
        inside = (x >= 0) & (y >= 0) & (x < self.width) & (y < self.height)
        index = np.where(inside, x * np.int64(self.height) + y, 0)
        return inside & (np.searchsorted(self.ends, index, side="right") % 2 == 1)

    def decode(self) -> np.ndarray:
        """Return the whole mask (height, width) bool."""
        lengths = np.diff(self.ends, prepend=0)
        flat = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
        return np.ascontiguousarray(flat.reshape(self.width, self.height).T)


def encode(mask: np.ndarray) -> bytes:
    """Encode a mask (H, W), any type, non-zero = set."""
    return bytes(coco_mask.encode(np.asfortranarray(mask != 0, dtype=np.uint8))["counts"])


def encode_window(window: np.ndarray, x0: int, y0: int, height: int, width: int) -> bytes:
    """Encode an image (height, width) that is empty except for a window (h, w) bool.

    The first pixel of the window is at column x0 and row y0. The cost is that of the window, not of
    the image.
    """
    # a column of the window and an empty pixel, which ends the last run of the column
    length = window.shape[0] + 1
    columns = np.zeros(window.shape[1] * length + 1, bool)
    columns[1:].reshape(-1, length)[:, :-1] = window.T
    column, row = np.divmod(np.flatnonzero(columns[1:] != columns[:-1]), length)
    flat = (column + x0) * height + (row + y0)
    if not len(flat):
        return encode(np.zeros((height, width), np.uint8))
    starts, ends = flat[::2], flat[1::2]
    # runs that touch across columns are one: from the last row to the first one of the next column
    apart = starts[1:] != ends[:-1]
    starts, ends = starts[np.append(True, apart)], ends[np.append(apart, True)]
    edges = np.concatenate([[0], np.stack([starts, ends], 1).ravel(), [height * width]])
    lengths = np.diff(edges)
    if lengths[-1] == 0:
        lengths = lengths[:-1]
    return _compress({"size": [height, width], "counts": lengths.tolist()}, height, width)


def decode(rle: bytes, height: int, width: int) -> np.ndarray:
    """Decode to (height, width) bool. Raises ValueError as :class:`Runs` does."""
    return Runs(rle, height, width).decode()


def from_counts(counts: Sequence[int], height: int, width: int) -> bytes:
    """Compress an uncompressed RLE, a list of run lengths.

    Raises ValueError if a length is negative or no integer, or the runs do not fill the image.
    """
    lengths = np.asarray(counts)
    if lengths.ndim != 1 or (lengths.size and lengths.dtype.kind not in "iu"):
        raise ValueError("its counts are not a list of whole numbers")
    if lengths.size and lengths.min() < 0:
        raise ValueError(f"its counts hold {int(lengths.min())}, expected 0 or more")
    runs = lengths.tolist()
    filled = sum(runs)  # Python's integers do not overflow
    if filled != height * width:
        raise ValueError(
            f"its runs hold {filled} pixels, expected {height * width} "
            f"({width} x {height}, the colour image)"
        )
    return _compress({"size": [height, width], "counts": runs}, height, width)


def from_polygons(polygons: Sequence[Sequence[float]], height: int, width: int) -> bytes:
    """Fill polygons, each x, y, x, y, ... pixels, and encode their union.

    Raises ValueError for a polygon of fewer than three corners, for coordinates that are not finite
    or exceed 1e5 px, and for outlines of more than 1e6 px in total.
    """
    outline = 0.0
    for polygon in polygons:
        values = np.asarray(polygon, np.float64)
        if values.ndim != 1 or len(values) < 6 or len(values) % 2 or not np.isfinite(values).all():
            raise ValueError("a polygon is not a list of three or more finite x, y corners")
        if np.abs(values).max() > 1e5:  # the C code counts every pixel of an edge
            raise ValueError(
                f"a polygon has a coordinate {values[np.abs(values).argmax()]:.6g}, expected "
                f"pixels of the image ({width} x {height})"
            )
        corners = values.reshape(-1, 2)
        outline += float(np.abs(corners - np.roll(corners, 1, 0)).max(1).sum())
        if outline > 1e6:  # the C code keeps five points of each pixel, and counts in 32 bits
            raise ValueError(
                "its polygons are more than 1e+06 px around, expected outlines of a shape in the "
                "image"
            )
    if not polygons:
        return encode(np.zeros((height, width), np.uint8))
    return _compress([[float(v) for v in p] for p in polygons], height, width)


def _compress(segmentation: object, height: int, width: int) -> bytes:
    """Return the compressed RLE of an uncompressed RLE, or of the union of polygons."""
    made = coco_mask.frPyObjects(segmentation, height, width)
    return bytes((coco_mask.merge(made) if isinstance(made, list) else made)["counts"])


def _parse(rle: bytes) -> np.ndarray:
    """Return the ends (n,) int64 of the runs of a compressed RLE."""
    if not rle:
        raise ValueError("its RLE is empty")
    characters = np.frombuffer(rle, np.uint8)
    if characters.min() < _ZERO or characters.max() > _ZERO + 63:
        raise ValueError("its RLE holds characters that COCO's alphabet does not have")
    if (characters[-1] - _ZERO) & 0x20:
        raise ValueError("its RLE is cut within a number")
    ends, too_long, negative = _run_ends(characters)
    if too_long:
        raise ValueError("its RLE holds a number that is too long")
    if negative:
        raise ValueError("its RLE holds a run of negative length")
    return ends


@numba.njit(cache=True, nogil=True)
def _run_ends(characters):
    """Return the ends (n,) int64 of the runs of ``characters`` (m,) uint8.

    Also returns whether a number is too long, where reading stops, and whether a run is negative.

    A number is written in groups of 5 bits, the lowest first, one character for each group. Bit 5
    of a character means that more groups follow. Bit 4 of the last group is the sign. The first
    three numbers are lengths of runs. From the fourth on, a number is the difference of a length to
    the length two runs before.
    """
    ends = np.empty(len(characters), np.int64)
    count, digits, value = 0, 0, np.int64(0)
    last, before, end = np.int64(0), np.int64(0), np.int64(0)  # the last number, the one before it
    too_long = negative = False
    for character in characters:
        bits = np.int64(character) - _ZERO
        if digits >= _LONGEST_NUMBER:
            too_long = True
            break
        value |= (bits & 0x1F) << (5 * digits)
        digits += 1
        if bits & 0x20:
            continue
        if bits & 0x10:
            value -= np.int64(1) << (5 * digits)
        if count > 2:
            value += before
        if value < 0:
            negative = True
        end += value
        ends[count] = end
        before, last = last, value
        count, digits, value = count + 1, 0, np.int64(0)
    return ends[:count].copy(), too_long, negative


@numba.njit(cache=True, nogil=True)
def _box(ends, height):
    """Return x, y, width, height of the set pixels of runs with ``ends`` (n,); zeros if none."""
    left, right, top, bottom = -1, 0, height, -1
    for run in range(1, len(ends), 2):
        start, stop = ends[run - 1], ends[run]
        if stop <= start:
            continue
        last = stop - 1
        if left < 0:
            left = start // height
        right = last // height
        if start // height != right:  # the run spans several columns, so first and last row
            top, bottom = 0, height - 1
        else:
            top, bottom = min(top, start % height), max(bottom, last % height)
    if left < 0:
        return 0, 0, 0, 0
    return left, top, right - left + 1, bottom - top + 1
