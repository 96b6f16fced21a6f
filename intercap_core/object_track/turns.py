"""On which side a nearly symmetric object is: decided over all frames together.

A mug looks much the same with its handle elsewhere, a box from its back. One frame may not show the
difference, a hand hides it for a second, and a tracker then slides away with nothing to notice.
Which turns are hard to tell apart follows from the mesh: those that bring its surface nearly back
onto itself. Every few frames all of them are compared with the images, and dynamic programming
(Viterbi 1967) finds the sequence of turns that explains all frames best while the object turns no
faster than objects do; it may change freely only where the track was lost.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from intercap_core.object_track.search import own_axes
from intercap_core.rigid.distance import DistanceField
from intercap_core.rigid.mesh import ObjectMesh

STEPS = 12  # angles of a full turn
FINE = np.pi / STEPS  # beside no turn, where a slow slide is caught first
SURFACE_POINTS = 500
PLACE_STEPS = 8
PLACE_START = 6.0  # robust scale that placing starts from, over the last
FAR_M, FAR_SHARE = 0.003, 0.01  # a point moved farther, also of the diameter, could be noticed
CHANGED = 0.3  # share of such points, below which a turn is hard to see
DISTINCT_DEG = 45.0  # flips nearer than this are one
SCORE_SIGMA = 0.01  # of the score's difference from no turn, a key frame
# To turn the track by a right angle or more takes so much more than to doubt it: images of poses
# far apart err apart, and for longer than a key frame.
APART = 2.5
SLIDE_RAD_S = np.radians(80)  # by which a tracked turn drifts from the true one in a second
JUMP_COST, BROKEN_COST = 10.0, 1.0  # of any other change: in a sound track, and where it was lost


def near_turns(mesh: ObjectMesh) -> np.ndarray:
    """Turns (N, 4, 4) of the object that hardly change it, the identity first.

    All angles about an axis of near symmetry, and single angles where the surface comes back to
    itself; elements of the symmetry group left out.
    """
    found = [np.eye(4)]
    if mesh.symmetry.sphere:
        return found[0][None]
    field = DistanceField(mesh.vertices, mesh.faces, watertight=mesh.watertight, threads=1)
    points = _surface(mesh)
    far = max(FAR_M, FAR_SHARE * mesh.diameter)
    angles = 2 * np.pi * np.arange(STEPS) / STEPS
    flips = []
    for axis in own_axes(mesh):
        half = [_placed(field, points, _about(axis, a), far) for a in angles[: STEPS // 2 + 1]]
        # turned back as much it has moved as much
        placed = half + [(np.linalg.inv(turn), share) for turn, share in half[-2:0:-1]]
        moved = np.array([share for _, share in placed])
        if moved.max() < CHANGED and mesh.symmetry.axis is None:
            fine, _ = _placed(field, points, _about(axis, FINE), far)
            found += [fine, np.linalg.inv(fine)]
            found += [turn for turn, _ in placed[1:]]
            continue
        least = (moved <= np.roll(moved, 1)) & (moved <= np.roll(moved, -1)) & (moved < CHANGED)
        flips += [placed[i][0] for i in range(1, STEPS) if least[i]]
    kept = found
    for turn in flips:
        known = np.array(kept)[:, :3, :3]
        if mesh.symmetry.rotation_error_deg(known, turn[:3, :3]).min() > DISTINCT_DEG:
            kept.append(turn)
    return np.array(kept)


def choose_turns(
    scores: np.ndarray, turns: np.ndarray, gaps: np.ndarray, broken: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Index (K,) of the turn (N, 4, 4) that each of K key frames is best corrected by, and the
    probability (K, N) of each turn given all frames.

    ``scores`` (K, N) of every turned pose, NaN rows where nothing is known; ``gaps`` (K-1,) seconds
    to the next key frame; ``broken`` (K-1,) whether the track was lost between.
    """
    # what agrees badly with every turn says little about which
    usual = max(float(np.nanmedian(scores.max(1))), 1e-6)
    trust = np.minimum(scores.max(1, keepdims=True) / usual, 1.0) ** 2
    between = angle_between(turns[:, None], turns[None])
    sigma = SCORE_SIGMA * (1 + (APART - 1) * np.minimum(between[0] / (np.pi / 2), 1.0))
    likely = np.nan_to_num((scores - scores[:, :1]) * trust / SCORE_SIGMA)
    value = likely * SCORE_SIGMA / sigma
    costs = [
        np.minimum(0.5 * (between / (SLIDE_RAD_S * gap)) ** 2, BROKEN_COST if gone else JUMP_COST)
        for gap, gone in zip(gaps, broken, strict=True)
    ]
    best, ahead, came = [value[0]], [likely[0]], []
    for k, cost in enumerate(costs, 1):
        through = best[-1][:, None] - cost
        came.append(through.argmax(0))
        best.append(through.max(0) + value[k])
        ahead.append(logsumexp(ahead[-1][:, None] - cost, axis=0) + likely[k])
    path = [int(best[-1].argmax())]
    for back in reversed(came):
        path.append(int(back[path[-1]]))
    behind = [np.zeros(len(turns))]
    for cost, after in zip(reversed(costs), likely[:0:-1], strict=True):
        behind.append(logsumexp(behind[-1] + after - cost, axis=1))
    log = np.array(ahead) + np.array(behind[::-1])
    probability = np.exp(log - logsumexp(log, axis=1, keepdims=True))
    return np.array(path[::-1]), probability


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle (...) in radians between the rotations of turns a and b (..., 4, 4)."""
    chord = np.linalg.norm(a[..., :3, :3] - b[..., :3, :3], axis=(-1, -2))
    return 2 * np.arcsin(np.clip(chord / (2 * np.sqrt(2)), 0, 1))


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    return Rotation.from_rotvec(angle * axis).as_matrix()


def _placed(
    field: DistanceField, points: np.ndarray, rotation: np.ndarray, far: float
) -> tuple[np.ndarray, float]:
    """The turn (4, 4) by ``rotation`` shifted so that most of the surface falls onto itself, and
    the share of ``points`` (N, 3) that stay farther than ``far``."""
    turned = points @ rotation.T
    shift = points.mean(0) - turned.mean(0)
    for scale in far * np.geomspace(PLACE_START, 1, PLACE_STEPS):
        at = turned + shift
        closest = field.closest(at)
        gap = closest.points - at
        weight = 1 / (1 + (gap**2).sum(1) / scale**2) ** 2
        weighted = closest.normals * weight[:, None]
        # point to plane, a little to the point where no plane holds it
        matrix = weighted.T @ closest.normals + 0.05 * weight.sum() * np.eye(3)
        pull = weighted.T @ (closest.normals * gap).sum(1) + 0.05 * weight @ gap
        shift = shift + np.linalg.solve(matrix, pull)
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = rotation, shift
    return turn, float((field.distance(turned + shift) > far).mean())


def _surface(mesh: ObjectMesh) -> np.ndarray:
    """Points (N, 3) spread evenly over the surface."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).cumsum()
    rng = np.random.default_rng(0)
    at = (np.arange(SURFACE_POINTS) + 0.5) / SURFACE_POINTS * area[-1]
    face = np.searchsorted(area, at)
    u, v = rng.random((2, SURFACE_POINTS, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[face] + u * (b - a)[face] + v * (c - a)[face]
