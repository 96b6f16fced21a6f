"""Signed distances of body points to the moving object, with derivatives.

Shared by E_C of equation 6 (A.4) and the term of body in object, which goes beyond it. E_C may ask
for those to the part of the surface that is annotated as likely touched.

d = n . (x - q), with q the point of the object's surface closest to x and n the outward direction
from q to x. Both terms are functions of this one distance. Far from the object, where neither says
anything, q is the nearest point of its box: the most costly searches of the surface are those.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from intercap_core.geometry.rigid.distance import Closest

# Farther from the object's box than this, metres, the box stands for the surface: many times what
# any term or contact asks about.
FAR_FROM_BOX = 0.25
# Nearer to the surface than this, metres, the direction to the closest point is noise: the face's
# normal is used. Tuned on the studio.
ON_SURFACE = 1e-4

_FRAMES_TOGETHER = 32  # what is between the points and the result is kept of so many at a time


class Surface(Protocol):
    """An object's surface, or a part of it; ``box`` (2, 3) holds it."""

    box: np.ndarray

    def boundary(self, points: np.ndarray) -> tuple[np.ndarray, Closest]:
        """Which of points (N, 3) of its frame are inside, and its closest points."""


@dataclass(frozen=True)
class Proximity:
    """Distances of N points in T frames to the object's surface, master frame, metres.

    ``distance`` (T, N), negative inside; ``normals`` (T, N, 3) d distance / d point. By the object
    its derivative is minus that of a point at the same place that moves with it
    (:func:`along_by_object`): x - q is parallel to n, and turning n changes nothing to first order.
    """

    distance: np.ndarray
    normals: np.ndarray

    def at(self, index: np.ndarray) -> Proximity:
        """The same for the points ``index`` (M,) alone."""
        return Proximity(self.distance[:, index], self.normals[:, index])


def along_by_object(points: np.ndarray, along: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """d (a . x) / d (w, d) (T, N, 6) of points x (T, N, 3) that move with the object,
    X' = exp(w)(X - t) + t + d; ``along`` (T, N, 3) are the directions a, ``translation`` (T, 3)
    is t."""
    return np.concatenate([np.cross(points - translation[:, None], along), along], axis=2)


def proximity(
    surface: Surface,
    points: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> Proximity:
    """Distances of ``points`` (T, N, 3) to the object at ``rotation`` (T, 3, 3) and
    ``translation`` (T, 3), all in the master frame, with exact first derivatives."""
    shape = points.shape[:2]
    found = Proximity(np.empty(shape), np.empty((*shape, 3)))
    for start in range(0, len(points), _FRAMES_TOGETHER):
        at = slice(start, start + _FRAMES_TOGETHER)
        found.distance[at], found.normals[at] = _proximity(
            surface, points[at], rotation[at], translation[at]
        )
    return found


def _proximity(
    surface: Surface,
    points: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Distance and normals of a few frames."""
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
