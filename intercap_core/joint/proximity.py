"""Signed distances of body points to the moving object, with derivatives.

d = n . (x - q), with q the point of the object's surface closest to x. n is the unit vector along
x - q that points out of the object. E_C of equation 6 (A.4) and the term body in object are
functions of d. Farther than 0.25 m from the object's bounding box no term needs d: there q is the
nearest point of the box, which is cheap to compute.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.rigid.distance import DistanceField, SurfacePart
from intercap_core.joint.state import frame_chunks

# Distance in metres below which the face's normal replaces the direction to the closest point. The
# direction errs by 1 % or more there: points of the surface err by up to 1e-6 (single precision).
ON_SURFACE = 1e-4

SearchableSurface = DistanceField | SurfacePart
"""An object's surface, or a part of it."""


@dataclass(frozen=True)
class Proximity:
    """Signed distances of N points in T frames to the object's surface; master frame, metres.

    The derivative of d by the object's motion is minus that of n . x for a point x that moves with
    the object (:func:`along_by_object`). The turn of n adds nothing to first order, because x - q
    is parallel to n.
    """

    distance: np.ndarray  # (T, N), negative inside
    normals: np.ndarray  # (T, N, 3) derivative of the distance by the point

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
    surface: SearchableSurface, points: np.ndarray, rotation: np.ndarray, translation: np.ndarray
) -> Proximity:
    """Measure distances of ``points`` (T, N, 3) to the object.

    ``rotation`` (T, 3, 3) and ``translation`` (T, 3) are master_from_object.
    """
    result = Proximity(np.empty(points.shape[:2]), np.empty(points.shape))
    for at in frame_chunks(len(points)):
        local = (points[at] - translation[at, None]) @ rotation[at]
        flat = local.reshape(-1, 3)
        offset = flat - np.clip(flat, *surface.box)
        length = np.linalg.norm(offset, axis=1)
        near = np.flatnonzero(length < 0.25)  # metres: many times the range of any term
        inside, closest = surface.boundary(flat[near])
        offset[near] = flat[near] - closest.points
        length[near] = np.linalg.norm(offset[near], axis=1)
        sign = np.ones(len(flat))
        sign[near[inside]] = -1.0
        direction = sign[:, None] * offset / np.maximum(length, ON_SURFACE)[:, None]
        touching = length[near] < ON_SURFACE
        direction[near[touching]] = closest.normals[touching]
        result.normals[at] = direction.reshape(local.shape) @ rotation[at].transpose(0, 2, 1)
        result.distance[at] = (sign * length).reshape(local.shape[:2])
    return result
