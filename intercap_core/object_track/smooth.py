"""Most probable track over all frames from the evidence of each frame.

Around the pose at which a frame was evaluated, its evidence is a quadratic form of small motions.
Neighbouring frames are coupled by their accelerations, whose standard deviations are those that
hands and gravity cause. Both parts are robust: a frame that was evaluated at a wrong pose, a kick
or a drop cost little. The unknowns are nodes: a node is the pose of one moving frame, or of all
frames of one rest. The track is solved by Gauss-Newton with a banded Cholesky factor, and the
inverse of the matrix is the covariance. Beyond the paper, whose tracker ends with equation 1.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from intercap_core.geometry.camera.transforms import apply_step, rotation_log, step_between
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.object_track.evidence import UNKNOWN_SIGMA, FrameEvidence, steps_about_point

# Standard deviations of accelerations of a carried object; a kick is an outlier.
ACCELERATION_M_S2 = 6.0  # m/s^2; tuned on the studio
ACCELERATION_RAD_S2 = 20.0  # rad/s^2; tuned on the studio
# Standard deviations at which evidence of a frame, or an acceleration (an impact), is an outlier.
INNOVATION_SIGMAS = 5.0  # tuned


def smooth(
    evidence: FrameEvidence,
    start: np.ndarray,
    node: np.ndarray,
    times: np.ndarray,
    centre: np.ndarray,
    stated: FrameEvidence | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Solve for the poses (T, 4, 4) and covariances (T, 6, 6) of all frames.

    Args:
        evidence: evidence of the frames.
        start: (T, 4, 4) start poses.
        node: (T,) number of each frame's node from 0, ascending; resting frames share a node.
        times: (T,) seconds.
        centre: (3,) of the object, whose path is smooth.
        stated: evidence of annotated poses, which is not robust and counts in full at rest.
    """
    count = int(node[-1]) + 1
    size = np.bincount(node)
    evidence = evidence.about(centre)
    information, own = evidence.information, evidence.own
    first = _typical_frames(evidence, node)
    # a rest counts as one observation, as errors of masks and calibration do not average out
    share = (1.0 / size)[node]
    state = start.copy()
    state[:, :3, 3] += state[:, :3, :3] @ centre
    state = _remove_blips(state, times)[first]
    bands = np.zeros((0, 0, 0, 0))
    given = stated.about(centre) if stated is not None else None
    for _ in range(12):
        offset = step_between(evidence.poses, state[node])
        # squared distance of the node from the frame's own minimum, in standard deviations
        distance = np.einsum("ti,tij,tj->t", offset - own, information, offset - own)
        weight = share * geman_mcclure_weight(distance, INNOVATION_SIGMAS)
        # an acceleration couples a node with itself and at most two nodes before it
        bands = np.zeros((3, count, 6, 6))
        gradient = np.zeros((count, 6))
        np.add.at(bands[0], node, weight[:, None, None] * information)
        # a weak prior about the pose of the node's typical frame determines what no image shows
        bands[0] += np.diag(UNKNOWN_SIGMA**-2)
        force = evidence.gradient + np.einsum("tij,tj->ti", information, offset)
        np.add.at(gradient, node, weight[:, None] * force)
        gradient += offset[first] * UNKNOWN_SIGMA**-2
        if given is not None:
            offset = step_between(given.poses, state[node])
            np.add.at(bands[0], node, given.information)
            force = given.gradient + np.einsum("tij,tj->ti", given.information, offset)
            np.add.at(gradient, node, force)
        _add_motion(state, node, times, bands, gradient)
        factor = cholesky_banded(_banded(bands), lower=True, check_finite=False)
        step = -cho_solve_banded((factor, True), gradient.ravel(), check_finite=False)
        step = step.reshape(-1, 6)
        step /= np.maximum(1.0, np.linalg.norm(step[:, :3], axis=1, keepdims=True) / 0.5)
        state = apply_step(state, step)
        if (np.abs(step) < np.repeat([1e-5, 1e-6], 3)).all():  # rad, metres
            break
    covariance = _covariance(_banded(bands), count)[node]
    poses = state[node]
    arms = poses[:, :3, :3] @ centre
    poses[:, :3, 3] -= arms
    to_origin = steps_about_point(arms)
    return poses, to_origin @ covariance @ to_origin.transpose(0, 2, 1)


def _typical_frames(evidence: FrameEvidence, node: np.ndarray) -> np.ndarray:
    """Return for each node the frame (N,) whose position is near most of the node's frames.

    The robust fit of a node starts there: from the one wrong frame of a rest it would not leave it.
    ``node`` (T,) as in :func:`smooth`.
    """
    reach_m = 0.03  # frames of a rest farther apart do not show one place; tuned on the studio
    weight = np.sqrt(np.trace(evidence.information, axis1=1, axis2=2))
    place = evidence.poses[:, :3, 3]
    typical = np.zeros(int(node[-1]) + 1, int)
    for number, members in enumerate(
        np.split(np.arange(len(node)), np.flatnonzero(np.diff(node)) + 1)
    ):
        parts = [
            np.minimum(np.linalg.norm(place[some, None] - place[members], axis=-1), reach_m)
            @ weight[members]
            for some in np.split(members, range(1000, len(members), 1000))  # memory: (1000, n, 3)
        ]
        cost = np.concatenate(parts)
        slack = 0.1 * reach_m * weight[members].sum()
        near = np.flatnonzero(cost <= cost.min() + slack)
        typical[number] = members[near[weight[members][near].argmax()]]
    return typical


def _remove_blips(poses: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return poses (T, 4, 4) with single frames that jump away and back moved between neighbours.

    A robust fit that starts at a wrong pose would stay there. A kick or a drop changes the velocity
    once, a wrong frame three times in alternating directions.
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
        for t in 2 + np.flatnonzero(back & (size[1:-1] > 2 * INNOVATION_SIGMAS * limit)):
            past = step_between(poses[t - 1], poses[t + 1])
            ends = np.diff([rate[t - 2], past / (times[t + 1] - times[t - 1]), rate[t + 1]], axis=0)
            ends = 2 * ends / (times[[t, t + 2]] - times[[t - 2, t]])[:, None]
            # without a wrong frame the motion is smooth; between two places it never is
            if (np.linalg.norm(ends[part], axis=1) < INNOVATION_SIGMAS * limit).all():
                share = (times[t] - times[t - 1]) / (times[t + 1] - times[t - 1])
                result[t] = apply_step(poses[t - 1], share * past)
    return result


def _add_motion(
    state: np.ndarray, node: np.ndarray, times: np.ndarray, bands: np.ndarray, gradient: np.ndarray
) -> None:
    """Add the robust accelerations of frames t-1, t, t+1 to ``bands`` and ``gradient`` in place.

    ``state`` (N, 4, 4) are the nodes' poses. Frames of one node have no acceleration.
    """
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
    # derivatives of the residual by the steps of a, b and c
    parts = np.zeros((3, len(a), 6, 6))
    eye = np.eye(3)
    rate_before, rate_after = (eye / before[..., None]), (eye / after[..., None])
    for rows, sigma, by in (
        (np.s_[:, :3, :3], ACCELERATION_RAD_S2, (to_b, to_c)),
        (np.s_[:, 3:, 3:], ACCELERATION_M_S2, (eye, eye)),
    ):
        parts[0][rows] = rate_before @ by[0] / (mean[..., None] * sigma)
        parts[1][rows] = -(rate_before + rate_after @ by[1]) / (mean[..., None] * sigma)
        parts[2][rows] = rate_after / (mean[..., None] * sigma)
    weight = np.ones_like(residual)
    for part in (np.s_[:, :3], np.s_[:, 3:]):
        size = (residual[part] ** 2).sum(1, keepdims=True)
        weight[part] = 1 / (1 + size / INNOVATION_SIGMAS**2)  # Cauchy's
    for i, row in enumerate((a, b, c)):
        weighted = parts[i].transpose(0, 2, 1) * weight[:, None]
        np.add.at(gradient, row, np.einsum("tij,tj->ti", weighted, residual))
        for j, column in enumerate((a, b, c)):
            block = weighted @ parts[j]
            lower = row >= column  # the upper triangle is the transpose
            np.add.at(bands, ((row - column)[lower], column[lower]), block[lower])


def _banded(bands: np.ndarray) -> np.ndarray:
    """Convert blocks (B, N, 6, 6), block (n + k, n), to LAPACK's lower banded layout."""
    width, count = bands.shape[:2]
    result = np.zeros((6 * width, 6 * count))
    for k in range(width):
        for row in range(6):
            for column in range(6):
                diagonal = 6 * k + row - column
                if diagonal >= 0:
                    columns = 6 * np.arange(count - k) + column
                    result[diagonal, columns] = bands[k, : count - k, row, column]
    return result


def _covariance(banded: np.ndarray, count: int) -> np.ndarray:
    """Return the diagonal blocks (N, 6, 6) of the inverse, an approximation.

    64 nodes are inverted at a time, together with 40 nodes before and after. The influence of nodes
    farther away is neglected.
    """
    covariance = np.zeros((count, 6, 6))
    for start in range(0, count, 64):
        stop = min(start + 64, count)
        low, high = max(start - 40, 0), min(stop + 40, count)
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
        covariance[start:stop] = blocks[index, :, index]
    return covariance
