"""Signed distances of body points to the moving object, with derivatives.

Both E_C of equation 6 (A.4) and the term body in object are functions of this distance. E_C may
measure it to the annotated part of the surface.

d = n . (x - q), with q the point of the object's surface closest to x and n the outward direction
from q to x. Far from the object, where no term asks for d, q is the nearest point of the object's
box: searches of the surface are the most expensive there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from intercap_core.geometry.rigid.distance import Closest

# Distance to the object's box beyond which the box replaces the surface, metres: many times the
# range of any term.
FAR_FROM_BOX = 0.25
# Distance below which the direction to the closest point is noise and the face's normal replaces
# it, metres. Tuned on the studio.
ON_SURFACE = 1e-4

_CHUNK = 32  # frames that are computed at a time, to bound the memory


class SearchableSurface(Protocol):
    """An object's surface, or a part of it."""

    box: np.ndarray
    """(2, 3) corners of a box that holds the surface."""

    def boundary(self, points: np.ndarray) -> tuple[np.ndarray, Closest]:
        """Mask of the points (N, 3) that are inside, and their closest points; object frame."""


@dataclass(frozen=True)
class Proximity:
    """Signed distances of N points in T frames to the object's surface; master frame, metres.

    The derivative by the object is minus that of a point at the same place that moves with it
    (:func:`along_by_object`): x - q is parallel to n, so that turning n changes nothing to first
    order.
    """

    distance: np.ndarray
    """(T, N), negative inside."""
    normals: np.ndarray
    """(T, N, 3) derivative of the distance by the point."""

    def at(self, index: np.ndarray) -> Proximity:
        """The distances of the points ``index`` (M,)."""
        return Proximity(self.distance[:, index], self.normals[:, index])


def along_by_object(points: np.ndarray, along: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Derivative (T, N, 6) of a . x by a turn w and a shift d of the object.

    Args:
        points: (T, N, 3) points x that move with the object, X' = exp(w)(X - t) + t + d.
        along: (T, N, 3) directions a.
        translation: (T, 3) the object's translation t.
    """
    return np.concatenate([np.cross(points - translation[:, None], along), along], axis=2)


def proximity(
    surface: SearchableSurface,
    points: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> Proximity:
    """Measure distances of ``points`` (T, N, 3) to the object.

    ``rotation`` (T, 3, 3) and ``translation`` (T, 3) are master_from_object.
    """
    shape = points.shape[:2]
    near = Proximity(np.empty(shape), np.empty((*shape, 3)))
    for start in range(0, len(points), _CHUNK):
        at = slice(start, start + _CHUNK)
        near.distance[at], near.normals[at] = _measure(
            surface, points[at], rotation[at], translation[at]
        )
    return near


def _measure(
    surface: SearchableSurface,
    points: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (T, N) and normals (T, N, 3)."""
    frames, count = points.shape[:2]
    local = (points - translation[:, None]) @ rotation
    flat = local.reshape(-1, 3)
    offset = flat - np.clip(flat, *surface.box)
    length = np.linalg.norm(offset, axis=1)
    near = np.flatnonzero(length < FAR_FROM_BOX)
    inside, closest = surface.boundary(flat[near])
    offset[near] = flat[near] - closest.points
    length[near] = np.linalg.norm(offset[near], axis=1)
    sign = np.ones(len(flat))
    sign[near[inside]] = -1.0
    direction = sign[:, None] * offset / np.maximum(length, ON_SURFACE)[:, None]
    touching = length[near] < ON_SURFACE
    direction[near[touching]] = closest.normals[touching]
    normals = direction.reshape(frames, count, 3) @ rotation.transpose(0, 2, 1)
    return (sign * length).reshape(frames, count), normals
