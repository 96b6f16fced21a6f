"""Silhouettes as evidence on a pose that is still far off, where no depth measures the object.

Of a silhouette its support function is used: h(d) = max over its pixels p of d . p, how far it
reaches in each direction of the image. The object's own is reached at a vertex of its convex hull,
so residuals of hundreds of poses cost no rendering. What a person or the image's edge cuts off has
no reach that could be compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.constants import (
    OUTLINE_CUT_PX,
    OUTLINE_DIRECTIONS,
    OUTLINE_MIN_DEPTH_M,
)
from intercap_core.object_track.object_silhouette import rim
from intercap_core.object_track.view import Candidate, View

_ANGLES = 2 * np.pi * np.arange(OUTLINE_DIRECTIONS) / OUTLINE_DIRECTIONS
_COMPASS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], 1)


@dataclass(frozen=True, eq=False)
class Outline:
    """The reach ``support`` (D,) of one view's mask, at z = 1 of its colour camera, lens undone.

    ``known`` (D,) bool: nothing cuts the mask off there. ``middle`` (2,) of its pixels and
    ``extent``, its largest width, at z = 1 too. ``colour_from_master`` (4, 4).
    """

    support: np.ndarray
    known: np.ndarray
    middle: np.ndarray
    extent: float
    colour_from_master: np.ndarray

    @classmethod
    def of(cls, view: View, candidate: Candidate) -> Outline | None:
        """The outline of a candidate's mask; None where all of it is cut off."""
        mask, lens = candidate.mask, view.geometry.lens
        row, column = np.nonzero(rim(np.pad(mask.mask, 1)))
        x, y = column + mask.x0 - 1, row + mask.y0 - 1
        rays = lens.rays[y, x].astype(np.float64)
        fine = np.isfinite(rays[:, 0])
        x, y, rays = x[fine], y[fine], rays[fine]
        if not len(rays):
            return None
        reach = rays @ _COMPASS.T
        ends = reach.argmax(0)
        support = reach[ends, np.arange(OUTLINE_DIRECTIONS)]
        width = support + np.roll(support, OUTLINE_DIRECTIONS // 2)
        known = ~_cut(view, candidate, x[ends], y[ends])
        if not known.any():
            return None
        middle = (support[:, None] * _COMPASS).sum(0) * 2 / OUTLINE_DIRECTIONS
        pose = view.geometry.camera.colour_from_master
        return cls(support, known, middle, float(width.max()), pose)

    @property
    def eye(self) -> np.ndarray:
        """The camera's centre (3,), master frame."""
        return -self.colour_from_master[:3, :3].T @ self.colour_from_master[:3, 3]

    @property
    def ray(self) -> np.ndarray:
        """Unit direction (3,), master frame, through the middle."""
        ray = self.colour_from_master[:3, :3].T @ np.append(self.middle, 1.0)
        return ray / np.linalg.norm(ray)


def _cut(view: View, candidate: Candidate, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether the mask's pixels x, y (N,) lie beside a person or the image's edge."""
    lens = view.geometry.lens
    cut = (x < OUTLINE_CUT_PX) | (y < OUTLINE_CUT_PX)
    cut |= (x >= lens.width - OUTLINE_CUT_PX) | (y >= lens.height - OUTLINE_CUT_PX)
    for dx in range(-OUTLINE_CUT_PX, OUTLINE_CUT_PX + 1):
        for dy in range(-OUTLINE_CUT_PX, OUTLINE_CUT_PX + 1):
            other = view.person.sample(x + dx, y + dy)
            cut |= other & ~candidate.mask.sample(x + dx, y + dy)
    return cut


def hull_vertices(mesh: ObjectMesh) -> np.ndarray:
    """Vertices (H, 3) of the mesh's convex hull."""
    from scipy.spatial import ConvexHull

    return mesh.vertices[ConvexHull(mesh.vertices).vertices]


def residuals(
    outline: Outline, hull: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Reach of the object beyond the mask (N, D), metres, and its Jacobian (N, D, 6).

    ``hull`` (H, 3), object frame; ``rotation`` (N, 3, 3), ``translation`` (N, 3) of
    master_from_object. The columns are a turn, then a shift, of the object in its own frame:
    pose <- pose * exp(step). Zero where the mask's end is not known.
    """
    pose = outline.colour_from_master
    turned = pose[:3, :3] @ rotation
    placed = translation @ pose[:3, :3].T + pose[:3, 3]
    points = np.einsum("nij,hj->nhi", turned, hull) + placed[:, None]
    z = np.maximum(points[..., 2], OUTLINE_MIN_DEPTH_M)
    flat = points[..., :2] / z[..., None]
    reach = flat @ _COMPASS.T  # (N, H, D)
    ends = reach.argmax(1)
    number = np.arange(len(rotation))[:, None]
    distance = np.maximum(placed[:, 2], OUTLINE_MIN_DEPTH_M)[:, None]
    residual = (np.take_along_axis(reach, ends[:, None], 1)[:, 0] - outline.support) * distance
    towards = np.broadcast_to(_COMPASS, (len(rotation), OUTLINE_DIRECTIONS, 2))
    along = -(towards * flat[number, ends]).sum(-1, keepdims=True)
    by_camera = np.concatenate([towards, along], -1) * (distance / z[number, ends])[..., None]
    by_shift = by_camera @ turned
    by_turn = np.cross(hull[ends], by_shift)
    jacobian = np.concatenate([by_turn, by_shift], -1)
    return residual * outline.known, jacobian * outline.known[:, None]
