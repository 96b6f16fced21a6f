"""Depth images on the colour camera's pixel grid, as the Azure Kinect SDK makes them.

The depth image is taken for a mesh: two triangles between four neighbouring pixels, projected into
the colour image, the nearest surface winning. What the colour camera sees and the depth camera does
not stays empty.
"""

from __future__ import annotations

import numba
import numpy as np

from intercap_core.geometry.camera.rig import Camera

# Corners of one surface differ by less than this share of their depth: two pixels of the wide
# binned image (0.23 degrees apart) on a surface that is 85 degrees off the ray.
STEEPEST = 0.0469


class Aligner:
    """Of one device, by what its own calibration says."""

    def __init__(self, camera: Camera) -> None:
        if camera.depth is None or camera.colour_from_depth is None:
            raise ValueError(f"camera {camera.name} has no depth")
        self._lens, pose = camera.colour, camera.colour_from_depth
        rays = camera.depth.rays
        ahead = np.ones((*rays.shape[:2], 1))
        self._direction = np.concatenate([rays, ahead], -1) @ pose[:3, :3].T
        self._shift = pose[:3, 3]
        self._usable = np.isfinite(rays[..., 0])

    def align(self, depth: np.ndarray) -> np.ndarray:
        """Depth (H, W) uint16 mm to the colour grid (Hc, Wc) uint16 mm, z of the colour camera."""
        known = (depth > 0) & self._usable
        points = self._direction[known] * (depth[known] * 1e-3)[:, None] + self._shift
        pixels = np.full((*depth.shape, 2), np.nan, np.float32)
        z = np.zeros(depth.shape, np.float32)
        pixels[known], z[known] = self._lens.project(points), points[:, 2]
        aligned = np.full((self._lens.height, self._lens.width), np.inf, np.float32)
        _warp(pixels, z, aligned)
        return np.where(np.isfinite(aligned), np.rint(aligned * 1000), 0).astype(np.uint16)


@numba.njit(cache=True)
def _warp(pixels, z, aligned):
    """Draw the mesh of a depth image: pixels (H, W, 2) in the colour image, z (H, W) metres there,
    0 = unknown, into ``aligned`` (Hc, Wc)."""
    for v in range(z.shape[0] - 1):
        for u in range(z.shape[1] - 1):
            for second in range(2):
                # corners of the triangle, clockwise in the image
                va, ua = v + second, u + second
                vb, ub = (v + 1, u) if second else (v, u + 1)
                vc, uc = (v, u + 1) if second else (v + 1, u)
                za, zb, zc = z[va, ua], z[vb, ub], z[vc, uc]
                least = min(za, zb, zc)
                if least <= 0 or max(za, zb, zc) - least > STEEPEST * least:
                    continue
                _triangle(pixels[va, ua], pixels[vb, ub], pixels[vc, uc], za, zb, zc, aligned)


@numba.njit(cache=True)
def _triangle(a, b, c, za, zb, zc, aligned):
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if area <= 0:  # seen from behind: something nearer hides it
        return
    height, width = aligned.shape
    left = max(int(np.ceil(min(a[0], b[0], c[0]))), 0)
    right = min(int(np.floor(max(a[0], b[0], c[0]))), width - 1)
    top = max(int(np.ceil(min(a[1], b[1], c[1]))), 0)
    bottom = min(int(np.floor(max(a[1], b[1], c[1]))), height - 1)
    for y in range(top, bottom + 1):
        for x in range(left, right + 1):
            wa = (b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)
            wb = (c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)
            wc = area - wa - wb
            if wa < 0 or wb < 0 or wc < 0:
                continue
            depth = (wa * za + wb * zb + wc * zc) / area
            if depth < aligned[y, x]:
                aligned[y, x] = depth
