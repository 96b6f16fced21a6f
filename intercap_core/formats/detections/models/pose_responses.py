"""Points of the responses that pose models give: bins of columns and rows, or heatmaps.

SimCC: Li et al. 2022, "SimCC: a Simple Coordinate Classification Perspective for Human Pose
Estimation"; a point is at its likeliest bin. Heatmaps: Zhang et al. 2020, "Distribution-Aware
Coordinate Representation for Human Pose Estimation" (DARK); a peak is taken for that of a Gaussian,
found from the logarithm's second-order expansion around the highest cell.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from intercap_core.formats.detections.constants import HEATMAP_BLUR

HeatmapGrid = Literal["msra", "udp"]

_EDGE = 2  # cells from the border within which no second difference is there
_TINY = 1e-10  # a response whose logarithm is taken, at least


def simcc_points(columns: np.ndarray, rows: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Points (B, K, 3) of x, y in an input of ``size`` (width, height) and confidence.

    columns (B, K, X) and rows (B, K, Y) are responses; the confidence is the smaller of the two.
    """
    x = columns.argmax(-1) * size[0] / columns.shape[-1]
    y = rows.argmax(-1) * size[1] / rows.shape[-1]
    response = np.minimum(columns.max(-1), rows.max(-1))
    return np.stack([x, y, np.maximum(response, 0)], -1)


def heatmap_points(maps: np.ndarray, size: tuple[int, int], grid: HeatmapGrid) -> np.ndarray:
    """Points (B, K, 3) of x, y in an input of ``size`` (width, height) and confidence.

    maps (B, K, h, w). Cell i of w stands for pixel i W/w with the grid "msra" (mmpose's
    MSRAHeatmap), for i (W-1)/(w-1) with "udp" (Huang et al. 2020, "The Devil is in the Details:
    Delving into Unbiased Data Processing for Human Pose Estimation"). The confidence is the
    highest response.
    """
    batch, count, height, width = maps.shape
    flat = maps.reshape(batch * count, height, width).astype(np.float64)
    places = peaks(flat)
    cells, pixels = np.array([width, height]), np.array(size)
    scale = pixels / cells if grid == "msra" else (pixels - 1) / np.maximum(cells - 1, 1)
    response = np.maximum(flat.max((1, 2)), 0)
    return np.column_stack([places * scale, response]).reshape(batch, count, 3)


def peaks(maps: np.ndarray) -> np.ndarray:
    """Places (N, 2) of x, y in cells of the peaks of maps (N, h, w), finer than cells.

    Where the expansion is none of a peak within a cell, or at the border, it is the highest cell.
    """
    number, height, width = maps.shape
    row, column = np.divmod(maps.reshape(number, -1).argmax(1), width)
    places = np.column_stack([column, row]).astype(np.float64)
    inside = np.minimum(column, row) >= _EDGE
    inside &= (column < width - _EDGE) & (row < height - _EDGE)
    fine = np.flatnonzero(inside & (maps.max((1, 2)) > 0))
    if not len(fine):
        return places
    log = np.log(np.maximum(_smooth_around(maps[fine], row[fine], column[fine]), _TINY))
    slope = np.stack([log[:, 2, 3] - log[:, 2, 1], log[:, 3, 2] - log[:, 1, 2]], -1) / 2
    dxx = (log[:, 2, 4] - 2 * log[:, 2, 2] + log[:, 2, 0]) / 4
    dyy = (log[:, 4, 2] - 2 * log[:, 2, 2] + log[:, 0, 2]) / 4
    dxy = (log[:, 3, 3] - log[:, 1, 3] - log[:, 3, 1] + log[:, 1, 1]) / 4
    determinant = dxx * dyy - dxy**2
    peak = (dxx < 0) & (determinant > 0)
    inverse = np.stack([dyy, -dxy, -dxy, dxx], -1).reshape(-1, 2, 2)
    inverse /= np.where(peak, determinant, 1)[:, None, None]
    offset = -(inverse @ slope[..., None])[..., 0]
    peak &= np.abs(offset).max(1) <= 1
    places[fine[peak]] += offset[peak]
    return places


def _smooth_around(maps: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """(N, 5, 5) around a cell of each of the maps (N, h, w) after a Gaussian blur.

    The blur makes one hill of what noise made several; zero beyond the border, as mmpose has it.
    """
    reach = max(1, round(HEATMAP_BLUR * min(maps.shape[1:]) / 2 - 0.5))
    kernel = cv2.getGaussianKernel(2 * reach + 1, 0)[:, 0]  # OpenCV's own deviation for the width
    side = np.arange(2 * (reach + _EDGE) + 1)
    padded = np.pad(maps, ((0, 0), (reach + _EDGE,) * 2, (reach + _EDGE,) * 2))
    each = np.arange(len(maps))[:, None, None]
    patches = padded[each, (row[:, None] + side)[:, :, None], (column[:, None] + side)[:, None]]
    blur = np.zeros((2 * _EDGE + 1, len(side)))
    for i in range(len(blur)):
        blur[i, i : i + len(kernel)] = kernel
    return blur @ patches @ blur.T
