"""Distances between surfaces that face each other: the rule by which a point can be in contact.

A point within millimetres of another surface does not touch it if a wall lies between: the inner
wall of a cup is as near to a finger on its outside as the finger's skin to the outer wall. A point
faces a point of the other surface if the normals oppose each other and no other surface lies
between them. Where the surfaces penetrate each other, the opposed point is behind the point, within
the material of either.
"""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.rigid.surface_tree import ShapedSurface

_OFF_M = 2e-5  # ends of a segment are moved off the surfaces that they lie on
_OTHER_M = 0.01  # farthest point that is faced although another point of the surface is nearer


def facing_distance(
    points: np.ndarray,
    normals: np.ndarray,
    signed: np.ndarray,
    own: ShapedSurface,
    other: ShapedSurface,
    reach: float,
) -> np.ndarray:
    """Signed distance (N,) of points to the nearest point of another surface that they face.

    It is inf for points that face none within ``reach``, negative for points that have penetrated
    the other surface.

    Args:
        points: (N, 3) on the surface ``own``, metres.
        normals: (N, 3) outward unit normals there; zeros if ``own`` has no outside (an open mesh).
        signed: (N,) signed distances to ``other``, negative inside.
        own: surface of the points.
        other: the other surface, in the same frame.
        reach: largest distance, metres.
    """
    distance = np.full(len(points), np.inf)
    near = np.flatnonzero(signed < reach)
    if len(near) == 0:
        return distance
    start, normal, outside = points[near], normals[near], signed[near] >= 0
    kind, away, end = other.opposed(start, normal, signed[near], min(reach, _OTHER_M))
    nearest, another = kind == 2, kind == 1
    behind = another & (((end - start) * normal).sum(1) < 0)
    along = (end - start) / np.maximum(away, _OFF_M)[:, None]
    start, end = start + _OFF_M * along, end - _OFF_M * along
    # nothing lies between a point and the nearest point of a surface that it has penetrated
    tested = (another | (nearest & outside)) & (away > 2 * _OFF_M)
    blocked = _blocked(own, start, end, tested)
    blocked |= _blocked(other, start, end, tested & another & ~behind)
    value = np.where(nearest, signed[near], np.where(behind, -away, away))
    distance[near] = np.where((kind > 0) & ~blocked, value, np.inf)
    return distance


def _blocked(
    surface: ShapedSurface, start: np.ndarray, end: np.ndarray, tested: np.ndarray
) -> np.ndarray:
    """Mask (N,) of the ``tested`` (N,) segments ``start`` to ``end`` (N, 3) that hit a surface."""
    blocked = ~tested
    surface.blocks(start, end, blocked)
    return blocked & tested
