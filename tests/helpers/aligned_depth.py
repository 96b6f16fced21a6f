"""Depth images resampled to the colour camera's pixel grid, as released data sets have them.

Another way than the studio's, which makes recordings: so that each can be held against the other.
"""

from __future__ import annotations

import math

import numpy as np

from intercap_core.geometry.camera.clouds import HIDDEN_BEHIND_M
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply

SAMPLES_PER_PIXEL = 2.0  # along each axis of the colour image, so that a surface has no holes


def depth_on_colour(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Resample depth (H, W) uint16 mm to the colour grid: (Hc, Wc) uint16 mm, 0 = none.

    The result is the z of the colour camera's frame. Four neighbouring depth pixels are one surface
    unless they differ by more than ``HIDDEN_BEHIND_M``. Over it, pixel position and 1 / z, which is
    linear over the image of a plane, are interpolated; what lies on the nearest surface of each
    colour pixel is averaged.
    """
    lens, colour = camera.depth, camera.colour
    assert lens is not None and camera.colour_from_depth is not None
    z = depth.astype(np.float64) * 1e-3
    points = np.concatenate([lens.rays * z[..., None], z[..., None]], axis=-1)
    known = (depth > 0) & np.isfinite(points[..., 0])
    points[~known] = (0, 0, 1)
    seen = apply(camera.colour_from_depth, points.reshape(-1, 3)).reshape(points.shape)
    known &= colour.inside_model(seen)
    values = np.concatenate([colour.project(seen), 1 / seen[..., 2:]], axis=-1)
    corners = [
        (slice(dy, dy - 1 or None), slice(dx, dx - 1 or None)) for dy in (0, 1) for dx in (0, 1)
    ]
    z_corners = np.stack([z[at] for at in corners])
    surface = np.all([known[at] for at in corners], axis=0)
    surface &= np.ptp(z_corners, axis=0) < HIDDEN_BEHIND_M
    quad = np.stack([values[at][surface] for at in corners])  # (4, N, 3)
    ratio = max(colour.fx / lens.fx, colour.fy / lens.fy)
    steps = max(1, math.ceil(SAMPLES_PER_PIXEL * ratio))
    offsets = [((x + 0.5) / steps, (y + 0.5) / steps) for x, y in np.ndindex(steps, steps)]
    pixels = colour.height * colour.width
    nearest = np.full(pixels, np.inf)
    for offset in offsets:
        flat, at_z = _samples(quad, offset, camera)
        np.minimum.at(nearest, flat, at_z)
    # The mean of what lies on the nearest surface: the nearest sample alone would be biased.
    total, count = np.zeros(pixels), np.zeros(pixels)
    for offset in offsets:
        flat, at_z = _samples(quad, offset, camera)
        on_it = at_z < nearest[flat] + HIDDEN_BEHIND_M
        total += np.bincount(flat[on_it], at_z[on_it], pixels)
        count += np.bincount(flat[on_it], minlength=pixels)
    result = np.where(count > 0, np.rint(1e3 * total / np.maximum(count, 1)), 0)
    return np.clip(result, 0, 65535).astype(np.uint16).reshape(colour.height, colour.width)


def _samples(
    quad: np.ndarray, offset: tuple[float, float], camera: Camera
) -> tuple[np.ndarray, np.ndarray]:
    """Flat colour pixels and z, metres, at one place (x, y in 0..1) of quads (4, N, 3)."""
    (x, y), colour = offset, camera.colour
    weights = np.array([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y])
    sample = np.tensordot(weights, quad, axes=1)
    column, row = np.rint(sample[:, :2]).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < colour.width) & (row < colour.height)
    return row[inside] * colour.width + column[inside], 1 / sample[inside, 2]
