"""Patches: windows of a view around the object, whose points and contours a fit compares with
renderings.

A patch is cut when a view chooses its candidate, with a margin within which the pose may move.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from intercap_core.geometry.camera.projection_kernels import project_point
from intercap_core.geometry.rigid.shots import Rendering
from intercap_core.object_track.object_silhouette import rim_pixels, transform_point
from intercap_core.object_track.reduced_mask import ReducedMask, covers
from intercap_core.object_track.view import View

# Metres that the pose may move before measured points leave the patch: more than the first robust
# scale of a fit.
PATCH_MARGIN_M = 0.08
OUTSIDE_MASK_WEIGHT = 0.3  # of depth pixels outside of the candidate; tuned on the studio


@dataclass(frozen=True, eq=False)
class DepthPatch:
    """Measured points in a window of the reduced depth image."""

    corner: tuple[int, int]
    """First pixel (x, y) in the reduced depth image."""
    depth: np.ndarray
    """(h, w) metres, 0 where invalid."""
    points: np.ndarray
    """(h, w, 3) float32, master frame."""
    trust: np.ndarray
    """(h, w) weight: 1 inside the candidate, 0 on a person, else ``OUTSIDE_MASK_WEIGHT``."""

    @classmethod
    def cut(cls, view: View, mask: ReducedMask, predicted: Rendering) -> DepthPatch | None:
        """Cut the patch around a rendering in the depth image.

        ``mask`` is the candidate in the reduced colour image. Returns None without depth or outside
        of the image.
        """
        geometry = view.geometry
        lens = geometry.depth_lens
        if view.depth is None or lens is None or predicted.area == 0:
            return None
        margin = int(_pixels_per_metre(predicted, lens.fx) * PATCH_MARGIN_M) + 2
        left, top, right, bottom = _around(predicted, margin, view.depth.shape)
        if left >= right or top >= bottom:
            return None
        colour_from_depth = geometry.camera.colour_from_depth
        assert colour_from_depth is not None
        depth, points, trust = _lift(
            view.depth[top:bottom, left:right], lens.rays, left, top, np.asarray(colour_from_depth),
            geometry.camera.master_from_depth, geometry.lens.parameters,
            mask.placed, view.person.placed,
        )  # fmt: skip
        return cls((left, top), depth, points, trust)


@dataclass(frozen=True, eq=False)
class ContourPatch:
    """The candidate's mask in a window of the reduced colour image."""

    corner: tuple[int, int]
    """First pixel (x, y) in the reduced colour image."""
    inside: np.ndarray
    """(h, w) bool, the mask."""
    person: np.ndarray
    """(h, w) bool, people outside of the mask."""
    rim: np.ndarray
    """(R, 2) pixels x, y of the window on the mask's border, row by row."""
    starts: np.ndarray
    """(h + 1,) index of the first rim pixel of each row."""
    contour: np.ndarray
    """(K, 2) rim pixels that are not next to a person, who may hide a part of the object."""

    @classmethod
    def cut(cls, view: View, mask: ReducedMask, predicted: Rendering) -> ContourPatch | None:
        """Cut the patch around a rendering in the colour image; None if the mask has no border
        there.
        """
        lens = view.geometry.lens
        margin = int(_pixels_per_metre(predicted, lens.fx) * PATCH_MARGIN_M) + 4
        left, top, right, bottom = _around(predicted, margin, (lens.height, lens.width))
        shape = (max(bottom - top, 0), max(right - left, 0))
        inside = mask.window(left, top, *shape)
        person = view.person.window(left, top, *shape) & ~inside
        border, starts = rim_pixels(inside)
        if not len(border):
            return None
        return cls((left, top), inside, person, border, starts, _own(border, person))

    def holds(self, image: Rendering) -> bool:
        """Return whether a rendering lies inside the window."""
        height, width = image.face.shape
        left, top = image.x0 - self.corner[0], image.y0 - self.corner[1]
        fits_in_width = 0 <= left <= self.inside.shape[1] - width
        return fits_in_width and 0 <= top <= self.inside.shape[0] - height


def _pixels_per_metre(rendering: Rendering, focal: float) -> float:
    depth = rendering.depth[rendering.mask]
    return focal / float(np.median(depth)) if len(depth) else 0.0


def _around(image: Rendering, margin: int, shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Widen a rendering's window and clip it to the image (H, W): left, top, right, bottom."""
    height, width = image.face.shape
    return (
        max(image.x0 - margin, 0),
        max(image.y0 - margin, 0),
        min(image.x0 + width + margin, shape[1]),
        min(image.y0 + height + margin, shape[0]),
    )


@numba.njit(cache=True, nogil=True)
def _own(border, person):
    """Keep the border pixels (K, 2) that have no person (h, w) among their eight neighbours."""
    height, width = person.shape
    kept = np.empty_like(border)
    count = 0
    for i in range(border.shape[0]):
        x, y = border[i, 0], border[i, 1]
        free = True
        for v in range(max(y - 1, 0), min(y + 2, height)):
            for u in range(max(x - 1, 0), min(x + 2, width)):
                free &= not person[v, u]
        if free:
            kept[count] = border[i]
            count += 1
    return kept[:count].copy()


@numba.njit(cache=True, nogil=True)
def _lift(image, rays, left, top, colour_from_depth, master_from_depth, colour, mask, person):
    """Compute depth, points and trust of a :class:`DepthPatch`.

    ``image`` is a window of the depth image, whose first pixel is (left, top). Each pixel is lifted
    along its ray and projected into the colour image of the reduced lens with parameters ``colour``
    (13,), whose masks (:attr:`.reduced_mask.ReducedMask.placed`) decide its weight.
    """
    height, width = image.shape
    depth = np.zeros((height, width), np.float32)
    points = np.zeros((height, width, 3), np.float32)
    trust = np.full((height, width), np.float32(OUTSIDE_MASK_WEIGHT), np.float32)
    for v in range(height):
        for u in range(width):
            z = np.float64(image[v, u])
            ray_x, ray_y = rays[top + v, left + u, 0], rays[top + v, left + u, 1]
            if not z > 0 or not np.isfinite(ray_x):
                continue
            x, y = ray_x * z, ray_y * z
            depth[v, u] = z
            at_x, at_y, at_z = transform_point(master_from_depth, x, y, z)
            points[v, u, 0], points[v, u, 1], points[v, u, 2] = at_x, at_y, at_z
            cx, cy, cz = transform_point(colour_from_depth, x, y, z)
            column, row = project_point(cx, cy, cz, colour)
            i, j = int(np.rint(column)), int(np.rint(row))
            if covers(mask, i, j):
                trust[v, u] = 1.0
            elif covers(person, i, j):
                trust[v, u] = 0.0
    return depth, points, trust
