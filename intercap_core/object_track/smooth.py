"""The most probable track over all frames, from what each frame's images say about its pose.

Around the pose at which a frame was looked at, its evidence is a quadratic form of small motions.
Neighbouring frames are tied by the accelerations that hands and gravity cause; both are robust, so
that a frame whose evidence was taken at a wrong pose and a kick or a drop cost little. Frames that
share a node share one pose: an object at rest. Solved by Gauss-Newton with a banded Cholesky
factor, whose inverse is the covariance. Beyond the paper, whose tracker ends with equation 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from intercap_core.geometry.camera.transforms import apply_step, rotation_log, step_between
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.object_track.constants import (
    ACCELERATION_M_S2,
    ACCELERATION_RAD_S2,
    IMPACT_SIGMAS,
    INVERTED_MARGIN,
    INVERTED_NODES,
    OUTLIER_SIGMAS,
    REST_SAMPLES,
    SMOOTH_CONVERGED,
    SMOOTH_MAX_TURN_RAD,
    SMOOTH_STEPS,
    TYPICAL_REACH_M,
    TYPICAL_SLACK,
    UNKNOWN_SIGMA,
)

BAND = 2  # nodes that an acceleration couples to the one before


@dataclass(frozen=True)
class FrameEvidence:
    """The evidence of T frames: ``poses`` (T, 4, 4) at which each was looked at, J'J
    ``information`` (T, 6, 6) and J'r ``gradient`` (T, 6) there, of (turn on the left, shift)."""

    poses: np.ndarray
    information: np.ndarray
    gradient: np.ndarray

    def about(self, centre: np.ndarray) -> FrameEvidence:
        """The same with poses and steps about ``centre`` (3,) of the object instead of its origin:
        the translations are where the centre is."""
        # the origin's shift is the centre's and what the turn adds
        to_origin = with_turn(self.poses[:, :3, :3] @ centre)
        back = to_origin.transpose(0, 2, 1)
        poses = self.poses.copy()
        poses[:, :3, 3] += poses[:, :3, :3] @ centre
        return FrameEvidence(
            poses,
            back @ self.information @ to_origin,
            np.einsum("tij,tj->ti", back, self.gradient),
        )

    @property
    def own(self) -> np.ndarray:
        """Steps (T, 6) to where each frame's evidence alone would have the object."""
        damped = self.information + np.diag(UNKNOWN_SIGMA**-2)
        return -np.linalg.solve(damped, self.gradient[..., None])[..., 0]


def smooth(
    evidence: FrameEvidence,
    start: np.ndarray,
    node: np.ndarray,
    times: np.ndarray,
    centre: np.ndarray,
    stated: FrameEvidence | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (T, 4, 4) and covariances (T, 6, 6) of all frames together, from ``start`` (T, 4, 4).

    ``node`` (T,) numbers the frames from 0, never falling, frames at rest alike; ``times`` (T,)
    seconds; ``centre`` (3,) of the object, whose path is smooth. What somebody ``stated`` counts
    whole: it is no look at an object at rest, and no outlier.
    """
    count = int(node[-1]) + 1
    size = np.bincount(node)
    evidence = evidence.about(centre)
    information, own = evidence.information, evidence.own
    first = _typical_frames(evidence, node)
    share = np.minimum(1.0, REST_SAMPLES / size)[node]
    state = start.copy()
    state[:, :3, 3] += state[:, :3, :3] @ centre
    state = _without_blips(state, times)[first]
    bands = np.zeros((0, 0, 0, 0))
    told = stated.about(centre) if stated is not None else None
    for _ in range(SMOOTH_STEPS):
        offset = step_between(evidence.poses, state[node])
        distance = np.einsum("ti,tij,tj->t", offset - own, information, offset - own)
        weight = share * geman_mcclure_weight(distance, OUTLIER_SIGMAS)
        bands = np.zeros((BAND + 1, count, 6, 6))
        gradient = np.zeros((count, 6))
        np.add.at(bands[0], node, weight[:, None, None] * information)
        bands[0] += np.diag(UNKNOWN_SIGMA**-2)
        force = evidence.gradient + np.einsum("tij,tj->ti", information, offset)
        np.add.at(gradient, node, weight[:, None] * force)
        gradient += offset[first] * UNKNOWN_SIGMA**-2
        if told is not None:
            offset = step_between(told.poses, state[node])
            np.add.at(bands[0], node, told.information)
            force = told.gradient + np.einsum("tij,tj->ti", told.information, offset)
            np.add.at(gradient, node, force)
        _add_motion(state, node, times, bands, gradient)
        matrix = cholesky_banded(_banded(bands), lower=True, check_finite=False)
        step = -cho_solve_banded((matrix, True), gradient.ravel(), check_finite=False).reshape(
            -1, 6
        )
        step /= np.maximum(
            1.0, np.linalg.norm(step[:, :3], axis=1, keepdims=True) / SMOOTH_MAX_TURN_RAD
        )
        state = apply_step(state, step)
        if (np.abs(step) < SMOOTH_CONVERGED).all():
            break
    covariance = _covariance(_banded(bands), count)[node]
    poses = state[node]
    arms = poses[:, :3, :3] @ centre
    poses[:, :3, 3] -= arms
    to_origin = with_turn(arms)
    return poses, to_origin @ covariance @ to_origin.transpose(0, 2, 1)


def _typical_frames(evidence: FrameEvidence, node: np.ndarray) -> np.ndarray:
    """The frame (N,) int of each of N nodes that most of its evidence is near, ``node`` (T,) as in
    :func:`smooth`: a robust fit would believe the one wrong frame of a rest that it starts from."""
    weight = np.sqrt(np.trace(evidence.information, axis1=1, axis2=2))
    place = evidence.poses[:, :3, 3]
    found = np.zeros(int(node[-1]) + 1, int)
    for number, members in enumerate(
        np.split(np.arange(len(node)), np.flatnonzero(np.diff(node)) + 1)
    ):
        apart = np.linalg.norm(place[members, None] - place[members], axis=-1)
        cost = np.minimum(apart, TYPICAL_REACH_M) @ weight[members]
        slack = TYPICAL_SLACK * TYPICAL_REACH_M * weight[members].sum()
        near = np.flatnonzero(cost <= cost.min() + slack)
        found[number] = members[near[weight[members][near].argmax()]]
    return found


def _without_blips(poses: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Poses (T, 4, 4) in which a frame that jumps away and back lies between its neighbours.

    A robust fit that starts at a wrong pose would believe it. A kick or a drop changes the velocity
    once, a wrong frame three times to and fro.
    """
    result = poses.copy()
    if len(poses) < 5:
        return result
    step = np.diff(times)[:, None]
    rate = step_between(poses[:-1], poses[1:]) / step
    change = 2 * np.diff(rate, axis=0) / (step[1:] + step[:-1])  # of frame t + 1
    for part, limit in ((np.s_[:, :3], ACCELERATION_RAD_S2), (np.s_[:, 3:], ACCELERATION_M_S2)):
        kick = change[part]
        size = np.linalg.norm(kick, axis=1)
        back = -(kick[1:-1] * (kick[:-2] + kick[2:])).sum(1) > 0.5 * size[1:-1] ** 2
        for t in 2 + np.flatnonzero(back & (size[1:-1] > 2 * IMPACT_SIGMAS * limit)):
            past = step_between(poses[t - 1], poses[t + 1])
            ends = np.diff([rate[t - 2], past / (times[t + 1] - times[t - 1]), rate[t + 1]], axis=0)
            ends = 2 * ends / (times[[t, t + 2]] - times[[t - 2, t]])[:, None]
            # without a wrong frame the motion is smooth; between two places it never is
            if (np.linalg.norm(ends[part], axis=1) < IMPACT_SIGMAS * limit).all():
                share = (times[t] - times[t - 1]) / (times[t + 1] - times[t - 1])
                result[t] = apply_step(poses[t - 1], share * past)
    return result


def _add_motion(
    state: np.ndarray, node: np.ndarray, times: np.ndarray, bands: np.ndarray, gradient: np.ndarray
) -> None:
    """Add the accelerations of frames t-1, t, t+1 to the normal equations."""
    if len(node) < 3:
        return
    moving = node[2:] > node[:-2]
    a, b, c = node[:-2][moving], node[1:-1][moving], node[2:][moving]
    step = np.diff(times)
    before, after = step[:-1][moving][:, None], step[1:][moving][:, None]
    mean = (before + after) / 2
    place, turn = state[:, :3, 3], state[:, :3, :3]
    to_b, to_c = turn[b] @ turn[a].transpose(0, 2, 1), turn[c] @ turn[b].transpose(0, 2, 1)
    shift = (place[c] - place[b]) / after - (place[b] - place[a]) / before
    spin = rotation_log(to_c) / after
    spin -= rotation_log(to_b) / before
    residual = np.concatenate(
        [spin / mean / ACCELERATION_RAD_S2, shift / mean / ACCELERATION_M_S2], axis=1
    )
    # of d(residual) by the steps of a, b and c
    parts = np.zeros((3, len(a), 6, 6))
    eye = np.eye(3)
    one, two = (eye / before[..., None]), (eye / after[..., None])
    for rows, sigma, by in (
        (np.s_[:, :3, :3], ACCELERATION_RAD_S2, (to_b, to_c)),
        (np.s_[:, 3:, 3:], ACCELERATION_M_S2, (eye, eye)),
    ):
        parts[0][rows] = one @ by[0] / (mean[..., None] * sigma)
        parts[1][rows] = -(one + two @ by[1]) / (mean[..., None] * sigma)
        parts[2][rows] = two / (mean[..., None] * sigma)
    weight = np.ones_like(residual)
    for part in (np.s_[:, :3], np.s_[:, 3:]):
        size = (residual[part] ** 2).sum(1, keepdims=True)
        weight[part] = 1 / (1 + size / IMPACT_SIGMAS**2)
    for i, row in enumerate((a, b, c)):
        weighted = parts[i].transpose(0, 2, 1) * weight[:, None]
        np.add.at(gradient, row, np.einsum("tij,tj->ti", weighted, residual))
        for j, column in enumerate((a, b, c)):
            block = weighted @ parts[j]
            lower = row >= column  # the upper triangle is the transpose
            np.add.at(bands, ((row - column)[lower], column[lower]), block[lower])


def _banded(bands: np.ndarray) -> np.ndarray:
    """Blocks (BAND + 1, N, 6, 6), block (n + k, n), in LAPACK's lower banded layout."""
    count = bands.shape[1]
    result = np.zeros((6 * (BAND + 1), 6 * count))
    for k in range(BAND + 1):
        for row in range(6):
            for column in range(6):
                diagonal = 6 * k + row - column
                if diagonal >= 0:
                    columns = 6 * np.arange(count - k) + column
                    result[diagonal, columns] = bands[k, : count - k, row, column]
    return result


def _covariance(banded: np.ndarray, count: int) -> np.ndarray:
    """Diagonal blocks (N, 6, 6) of the inverse; far frames do not matter to each other."""
    found = np.zeros((count, 6, 6))
    for start in range(0, count, INVERTED_NODES):
        stop = min(start + INVERTED_NODES, count)
        low, high = max(start - INVERTED_MARGIN, 0), min(stop + INVERTED_MARGIN, count)
        part = banded[:, 6 * low : 6 * high].copy()
        for diagonal in range(1, len(part)):
            part[diagonal, part.shape[1] - diagonal :] = 0
        columns = np.zeros((part.shape[1], 6 * (stop - start)))
        wanted = np.arange(6 * (start - low), 6 * (stop - low))
        columns[wanted, np.arange(len(wanted))] = 1
        factor = cholesky_banded(part, lower=True, check_finite=False)
        inverse = cho_solve_banded((factor, True), columns, check_finite=False)[wanted]
        blocks = inverse.reshape(stop - start, 6, stop - start, 6)
        index = np.arange(stop - start)
        found[start:stop] = blocks[index, :, index]
    return found


def with_turn(arms: np.ndarray) -> np.ndarray:
    """Matrices (T, 6, 6) from steps about one point to steps about another, which lies ``arms``
    (T, 3) before it: the shift gains turn x -arm."""
    x, y, z = arms.T
    result = np.tile(np.eye(6), (len(arms), 1, 1))
    result[:, 3:, :3] = np.stack(
        [
            np.stack([0 * x, -z, y], 1),
            np.stack([z, 0 * x, -x], 1),
            np.stack([-y, x, 0 * x], 1),
        ],
        1,
    )
    return result
