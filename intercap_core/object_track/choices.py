"""Weakly observed frames: several hypotheses explain the images, the neighbouring frames decide.

A tracker keeps the pose that its start leads to. Where a frame agrees with the images much less
than the track usually does, it is also fitted from poses turned a little each way; the sequence of
poses that the images and the object's inertia prefer is found by dynamic programming.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.object_track.constants import (
    SEQUENCE_MAX_MOTION_COST,
    SEQUENCE_SCORE_SIGMA,
    SEQUENCE_SPEED_M_S,
    SEQUENCE_SPEED_RAD_S,
    WEAK_FRAME_FITS,
    WEAK_FRAME_TURN_RAD,
    WEAK_SCORE,
)
from intercap_core.object_track.fit import Fit
from intercap_core.rigid.mesh import ObjectMesh


def weak_frames(scores: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Which frames (T,) agree much less with the images than is usual in this track."""
    if lost.all():
        return np.zeros(len(scores), bool)
    return ~lost & (scores < WEAK_SCORE * np.median(scores[~lost]))


def other_fits(
    mesh: ObjectMesh,
    pose: np.ndarray,
    assess_all: Callable[[np.ndarray], list[Fit]],
    fit: Callable[[np.ndarray], Fit],
) -> list[Fit]:
    """Fits of one frame from its pose (4, 4) and from the best of those turned about each axis."""
    centre = mesh.centre_of_mass
    turns = []
    for axis in np.eye(3):
        for angle in (WEAK_FRAME_TURN_RAD, -WEAK_FRAME_TURN_RAD):
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix()
            turn[:3, 3] = centre - turn[:3, :3] @ centre
            turns.append(turn)
    starts = sorted(assess_all(pose @ np.array(turns)), key=lambda found: -found.score)
    return [fit(pose), *(fit(start.pose) for start in starts[:WEAK_FRAME_FITS])]


def best_sequence(mesh: ObjectMesh, options: list[list[Fit]], times: np.ndarray) -> list[int]:
    """The most likely sequence of hypotheses: the index of the one chosen in each frame, [T]."""
    usual = float(np.median([own[0].score for own in options]))
    totals, came = [_values(options[0], usual)], []
    for t in range(1, len(options)):
        gap = times[t] - times[t - 1]
        cost = np.array([[_motion(mesh, a, b, gap) for b in options[t]] for a in options[t - 1]])
        through = totals[-1][:, None] - cost
        came.append(through.argmax(0))
        totals.append(through.max(0) + _values(options[t], usual))
    path = [int(totals[-1].argmax())]
    for back in reversed(came):
        path.append(int(back[path[-1]]))
    return path[::-1]


def _values(options: list[Fit], usual: float) -> np.ndarray:
    """Log-likelihood (N,) of each pose up to a constant; nearly flat in a frame that no pose
    explains well."""
    scores = np.array([fit.score for fit in options])
    trust = min(scores.max() / max(usual, 1e-6), 1.0) ** 2
    return scores * trust / SEQUENCE_SCORE_SIGMA


def _motion(mesh: ObjectMesh, a: Fit, b: Fit, gap: float) -> float:
    turn = np.radians(float(mesh.symmetry.rotation_error_deg(a.pose[:3, :3], b.pose[:3, :3])))
    centre = mesh.centre_of_mass
    shift = (b.pose[:3, :3] - a.pose[:3, :3]) @ centre + b.pose[:3, 3] - a.pose[:3, 3]
    speed = (turn / (SEQUENCE_SPEED_RAD_S * gap)) ** 2 + (
        np.linalg.norm(shift) / (SEQUENCE_SPEED_M_S * gap)
    ) ** 2
    return float(min(0.5 * speed, SEQUENCE_MAX_MOTION_COST))
