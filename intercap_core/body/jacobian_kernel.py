"""The derivatives of a point of the skin, compiled: by chosen parameters alone, no temporaries.

Equal to :class:`.jacobian.Linearisation` to rounding, for bodies without pose blend shapes. Rows
are n^T d point / d parameters; ``place`` (P,) says where in a row a parameter belongs, -1 = it is
not asked for. All arrays are of one floating type.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

_TRANSL, _SHAPE = 165, 168  # first columns of the translation and of the shape


class Chain(NamedTuple):
    """B posed bodies and N of their points.

    rest (B,N,3) points; rotations (B,55,3,3) and offsets (B,55,3): a point that follows joint k
    alone goes to rotations[k] @ x + offsets[k]; joints (B,55,3) posed; frames (B,55,3,3): world
    turn of a joint for a change of its axis-angle; moved (B,55,3,S): derivatives of the offsets by
    the shape. Of each point directions (N,3,S), and bones, shares, chain and below as
    ``bones``, ``bone_weights``, ``chain`` and ``below`` of :class:`.selection.Selection`.
    """

    rest: np.ndarray
    rotations: np.ndarray
    offsets: np.ndarray
    joints: np.ndarray
    frames: np.ndarray
    moved: np.ndarray
    directions: np.ndarray
    bones: np.ndarray
    shares: np.ndarray
    chain: np.ndarray
    below: np.ndarray


@numba.njit(cache=True, nogil=True)
def _add_turn(row, place, joint, frame, scale, a, n):
    """Add scale n^T (w x a) for the turns w of one joint; a, n (3,)."""
    t0 = scale * (a[1] * n[2] - a[2] * n[1])
    t1 = scale * (a[2] * n[0] - a[0] * n[2])
    t2 = scale * (a[0] * n[1] - a[1] * n[0])
    for d in range(3):
        q = place[3 * joint + d]
        if q >= 0:
            row[q] += frame[0, d] * t0 + frame[1, d] * t1 + frame[2, d] * t2


@numba.njit(cache=True, nogil=True)
def _add_point(row, place, shape, c, b, i, scale, n, arms):
    """Add scale n^T d point i / d parameters of body b to the row; returns scale n^T point.

    ``shape``: the shape's columns that are asked for, from 0. ``arms`` (L,3) is scratch.
    """
    arms[:] = 0
    x = c.rest[b, i]
    along = x[0] * 0
    t0, t1, t2 = along, along, along
    for k in range(c.bones.shape[1]):
        w = c.shares[i, k]
        if w == 0:
            continue
        m = c.bones[i, k]
        r, o, moved = c.rotations[b, m], c.offsets[b, m], c.moved[b, m]
        p0 = r[0, 0] * x[0] + r[0, 1] * x[1] + r[0, 2] * x[2] + o[0]
        p1 = r[1, 0] * x[0] + r[1, 1] * x[1] + r[1, 2] * x[2] + o[1]
        p2 = r[2, 0] * x[0] + r[2, 1] * x[1] + r[2, 2] * x[2] + o[2]
        w *= scale
        along += w * (n[0] * p0 + n[1] * p1 + n[2] * p2)
        t0 += w * (r[0, 0] * n[0] + r[1, 0] * n[1] + r[2, 0] * n[2])
        t1 += w * (r[0, 1] * n[0] + r[1, 1] * n[1] + r[2, 1] * n[2])
        t2 += w * (r[0, 2] * n[0] + r[1, 2] * n[1] + r[2, 2] * n[2])
        for s in shape:
            row[place[_SHAPE + s]] += w * (
                n[0] * moved[0, s] + n[1] * moved[1, s] + n[2] * moved[2, s]
            )
        for j in range(c.chain.shape[1]):
            part = c.below[i, j, k]
            if part != 0:
                at = c.joints[b, c.chain[i, j]]
                arms[j, 0] += part * (p0 - at[0])
                arms[j, 1] += part * (p1 - at[1])
                arms[j, 2] += part * (p2 - at[2])
    for j in range(c.chain.shape[1]):
        joint = c.chain[i, j]
        if arms[j, 0] != 0 or arms[j, 1] != 0 or arms[j, 2] != 0:
            _add_turn(row, place, joint, c.frames[b, joint], scale, arms[j], n)
    for d in range(3):
        if place[_TRANSL + d] >= 0:
            row[place[_TRANSL + d]] += scale * n[d]
    direction = c.directions[i]
    for s in shape:
        row[place[_SHAPE + s]] += t0 * direction[0, s] + t1 * direction[1, s] + t2 * direction[2, s]
    return along
