"""Depth pixels as masks of the colour image (COCO RLE), and the segmentation result of a view."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numba
import numpy as np

from intercap_core.geometry.camera.masks import from_counts
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply


@dataclass(frozen=True)
class ImageCandidate:
    """Mask of a possible object in one view."""

    rle: bytes
    """Mask, COCO RLE."""
    score: float
    """Prior probability that it is a handled object, 0 to 1."""
    extent_m: float
    """Diagonal of the 3D bounding box, metres; NaN = unknown (colour only)."""
    component: int
    """Number of the 3D component, common to all views that show it; -1 = none (colour only)."""


@dataclass(frozen=True)
class ViewSegments:
    """Segmentation of one view."""

    person: bytes
    """RLE of the person; empty = not seen."""
    candidates: list[ImageCandidate]
    """Possible objects."""
    beside: bytes = b""
    """RLE of the pixels in which the border of the person's mask must not be used as the outline of
    the body; empty = nowhere."""


@dataclass(frozen=True, eq=False)
class ColourCells:
    """N points projected into the colour image, which is divided into square cells.

    A cell covers about one depth pixel.
    """

    cell: np.ndarray
    """(N,) flat index; -1 = outside the image, or occluded."""
    z: np.ndarray
    """(N,) depth in the colour camera, metres."""
    height: int
    """Rows of cells."""
    width: int
    """Columns of cells."""
    scale: int
    """Side of a cell, pixels."""
    colour_size: tuple[int, int]
    """Width and height of the image, pixels."""

    @classmethod
    def of(cls, points: np.ndarray, camera: Camera) -> ColourCells:
        """Project ``points`` (N, 3) float32, metres, in the depth camera's frame."""
        colour, depth = camera.colour, camera.depth
        assert depth is not None and camera.colour_from_depth is not None
        scale = max(1, round(colour.fx / depth.fx))
        width, height = -(-colour.width // scale), -(-colour.height // scale)
        moved = apply(camera.colour_from_depth, points)
        pixel = np.nan_to_num((colour.project(moved) + 0.5) / scale, nan=-1.0)
        column, row = np.floor(pixel).astype(np.int64).T
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        inside &= colour.inside_model(moved)
        cell = np.where(inside, row * width + column, -1)
        return cls(cell, moved[:, 2], height, width, scale, (colour.width, colour.height))

    def __getitem__(self, chosen: np.ndarray) -> ColourCells:
        """The points ``chosen`` by a mask or by indices."""
        return replace(self, cell=self.cell[chosen], z=self.z[chosen])

    @classmethod
    def joined(cls, parts: list[ColourCells]) -> ColourCells:
        """Concatenate points of one image."""
        cell, z = (np.concatenate([getattr(part, key) for part in parts]) for key in ("cell", "z"))
        return replace(parts[0], cell=cell, z=z)

    def visible(self) -> ColourCells:
        """The same points; those clearly behind others of their cell get the cell -1."""
        hidden = _hidden(self.cell, self.z, self.height * self.width)
        return replace(self, cell=np.where(hidden, -1, self.cell))

    def rle(self, chosen: np.ndarray, others: np.ndarray) -> bytes:
        """Mask of the points ``chosen`` (N,) bool as COCO RLE; empty bytes if none is visible.

        Holes between projected cells are closed morphologically (3 x 3), except over cells of the
        points ``others`` (N,) bool.
        """
        row, column = self._places(chosen)
        if not len(row):
            return b""
        top, left = max(int(row.min()) - 2, 0), max(int(column.min()) - 2, 0)
        bottom, right = int(row.max()) + 3, int(column.max()) + 3
        drawn = np.zeros((bottom - top, right - left), np.uint8)
        drawn[row - top, column - left] = 1
        mask = cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        taken_row, taken_column = self._places(others)
        near = (taken_row >= top) & (taken_row < bottom)
        near &= (taken_column >= left) & (taken_column < right)
        mask[taken_row[near] - top, taken_column[near] - left] = 0
        mask[row - top, column - left] = 1
        width, height = self.colour_size
        return encode_window(mask, left, top, self.scale, width, height)

    def _places(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the cells of the visible points among ``chosen`` (N,) bool."""
        visible = np.flatnonzero(chosen & (self.cell >= 0))
        rows, columns = self._rows_and_columns
        return rows.take(visible), columns.take(visible)

    @cached_property
    def _rows_and_columns(self) -> tuple[np.ndarray, np.ndarray]:
        """(N,) each; divided once because an image has many candidates."""
        return np.divmod(self.cell, self.width)


def encode_window(
    mask: np.ndarray, left: int, top: int, scale: int, width: int, height: int
) -> bytes:
    """COCO compressed RLE of an image whose mask is given by a window of cells.

    Cells that exceed the image are cut off.

    Args:
        mask: (h, w) uint8, cells of the window.
        left, top: column and row of the window's first cell, in cells.
        scale: side of a cell, pixels.
        width, height: size of the image, pixels.
    """
    columns = min(mask.shape[1] * scale, width - left * scale)
    rows = min(mask.shape[0] * scale, height - top * scale)
    counts = [width * height]
    if columns > 0 and rows > 0:
        counts = _counts(mask, left, top, scale, width, height).tolist()
    return from_counts(counts, height, width)


@numba.njit(cache=True)
def _hidden(cell: np.ndarray, z: np.ndarray, cells: int) -> np.ndarray:
    """Mask (N,) of points more than 3 cm behind the nearest point of their cell.

    A surface seen at an angle varies by less within a cell; tuned on the studio.
    """
    nearest = np.full(cells, np.float32(1e9))
    for i in range(len(cell)):
        if cell[i] >= 0 and z[i] < nearest[cell[i]]:
            nearest[cell[i]] = z[i]
    hidden = np.zeros(len(cell), np.bool_)
    for i in range(len(cell)):
        hidden[i] = cell[i] >= 0 and z[i] > nearest[cell[i]] + np.float32(0.03)
    return hidden


@numba.njit(cache=True)
def _counts(
    mask: np.ndarray, left: int, top: int, scale: int, width: int, height: int
) -> np.ndarray:
    """Run lengths of the image in column-major order, the first run of zeros.

    Runs are found cell by cell, without drawing the image: each column of pixels passes through one
    column of cells, and a run ends where the cell's value changes.
    """
    counts = np.empty(2 + 2 * mask.size * scale, np.int64)
    number, start, inside = 0, 0, False  # runs written; start and value of the current run
    for column in range(left * scale, min((left + mask.shape[1]) * scale, width)):
        x = column // scale - left
        for y in range(mask.shape[0] + 1):
            row = min((top + y) * scale, height)
            here = y < mask.shape[0] and mask[y, x] != 0 and row < height
            if here != inside:
                at = column * height + row
                counts[number] = at - start
                number += 1
                start, inside = at, here
    counts[number] = width * height - start
    return counts[: number + 1]
