"""Segments in which the object is at rest: a change-point test on the evidence of the images.

A segment is at rest if one pose explains all its frames within their evidence. A frame in motion
has a pose of its own, and a fixed cost. Errors of masks and calibration last for some time and make
a resting object seem to creep. The cost of motion is therefore higher than what a frame at rest
would save by following such errors. The cheapest partition of the recording into rests and motions
is found exactly by dynamic programming (Jackson et al. 2005). It runs twice: the first result gives
the variance of poses at rest, with which the second finds slow motions too.
"""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.camera.transforms import rotation_exp, step_between
from intercap_core.object_track.evidence import FrameEvidence

# Longest rest of the partition, half a minute at 30 Hz. It limits the run time, which grows with
# the square of a rest's length; a minute at rest takes 1.5 times as long without it.
MAX_REST_FRAMES = 900
# Costs are minus log-likelihoods, nats.
# Of the six numbers of a pose: of each independent observation in motion, and of one more rest.
POSE_COST = 9.0  # tuned


def find_rests(evidence: FrameEvidence, share: float, centre: np.ndarray) -> np.ndarray:
    """Find the frames at rest.

    Frames without evidence rest if those around them rest at one pose. Returns the number (T,) of
    the rest segment from 0, -1 while the object moves. ``share`` is the number of independent
    observations per frame, ``centre`` (3,) is that of the object.
    """
    evidence = evidence.about(centre)
    own = evidence.own
    poses = evidence.poses.copy()
    poses[:, :3, :3] = rotation_exp(own[:, :3]) @ poses[:, :3, :3]
    poses[:, :3, 3] += own[:, 3:]
    information = evidence.information
    seen = np.trace(information, axis1=1, axis2=2) > 0
    shortest = max(3, int(1 / share))  # frames: one independent observation
    variance = 1.0
    segments = np.full(len(poses), -1)
    for _ in range(2):
        segments, spread = _partition(poses, information, seen, share / variance, share, shortest)
        if spread is None:
            break
        variance = float(np.clip(variance * spread, 0.5, 2.0))
    information = information / variance
    return _merge(_trim(segments, poses, information), poses, information * share, seen)


def _partition(
    poses: np.ndarray,
    information: np.ndarray,
    seen: np.ndarray,
    weight: float,
    share: float,
    shortest: int,
) -> tuple[np.ndarray, float | None]:
    """Find the cheapest partition into rests and motions, by dynamic programming.

    ``best_rest[e]`` and ``best_move[e]`` are the costs of the cheapest partition of the frames
    before e whose last frame rests or moves. A rest from a to e costs ``POSE_COST`` and half of the
    squared distances of its frames from their mean pose, weighted. A moving frame costs
    ``POSE_COST`` times ``share``. Between two rests at least one frame moves.

    The partition is traced back from the last frame: ``began[e]`` is the first frame of the rest
    before e, and ``rested_before[e]`` tells whether the frames before the moving frame e - 1 end
    with a rest.

    Args:
        poses, information: (T, 4, 4) and (T, 6, 6) of each frame's own minimum.
        seen: (T,) frames with evidence.
        weight: factor of the squared residuals.
        share: independent observations per frame.
        shortest: frames of the shortest rest.

    Returns:
        Number (T,) of the rest segment, -1 in motion; and the mean squared residual per degree of
            freedom at rest, None without rest.
    """
    count = len(poses)
    moving = np.where(seen, POSE_COST, 1.0) * share  # a frame without evidence costs 1
    best_rest, best_move = np.full(count + 1, np.inf), np.full(count + 1, np.inf)
    best_rest[0] = best_move[0] = 0.0
    began = np.zeros(count + 1, int)
    rested_before = np.zeros(count + 1, bool)
    residual = np.zeros(count + 1)
    # ascending, so that the cheapest partition of the frames before a is known
    for a in range(count):
        if a:
            stay, go = best_move[a - 1], best_rest[a - 1]
            best_move[a] = min(stay, go) + moving[a - 1]
            rested_before[a] = go < stay
        until = min(a + MAX_REST_FRAMES, count)
        spread = _spread(poses[a:until], information[a:until], seen[a:until])
        ends = a + 1 + np.arange(len(spread))
        # A rest at the start or the end of the recording may be cut off, so it may be half as long
        # and cost less: 5, plus nine tenths of the cost of motion for each frame from the shortest
        # whole rest on, but at most the cost of a whole rest.
        length = ends - a
        cut = (a == 0) | (ends == count)
        longer = np.maximum(length - shortest + 1, 0) * POSE_COST * share * 0.9
        own = np.where(cut, np.minimum(5.0 + longer, POSE_COST), POSE_COST)
        cost = best_move[a] + own + 0.5 * weight * spread
        least = np.where(cut, (shortest + 1) // 2, shortest)
        better = (cost < best_rest[ends]) & (length >= least)
        best_rest[ends[better]] = cost[better]
        began[ends[better]] = a
        residual[ends[better]] = spread[better]
    best_move[count] = min(best_move[count - 1], best_rest[count - 1]) + moving[-1]
    rested_before[count] = best_rest[count - 1] < best_move[count - 1]
    segments = np.full(count, -1)
    squares, freedom, number, end = 0.0, 0.0, 0, count
    rests = bool(best_rest[count] < best_move[count])
    while end > 0:
        if rests:
            start = int(began[end])
            segments[start:end] = number
            squares += residual[end]
            freedom += 6.0 * max(int(seen[start:end].sum()) - 1, 0)
            number, end, rests = number + 1, start, False
        else:
            rests = bool(rested_before[end])
            end -= 1
    segments = np.where(segments >= 0, number - 1 - segments, -1)
    return segments, squares / freedom * weight / share if freedom else None


def _spread(poses: np.ndarray, information: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return for the first 1, 2, ... L frames the sum of squared distances from their mean pose.

    Distances are in standard deviations, and the mean pose is that of minimal sum. The L frames end
    before the first one that is too far from frame 0 for a rest: 0.35 rad or 10 cm.
    """
    offset = step_between(np.broadcast_to(poses[0], poses.shape), poses)
    offset[~seen] = 0
    far = (np.abs(offset) > np.repeat([0.35, 0.10], 3)).any(1)
    count = int(far.argmax()) if far.any() else len(poses)
    offset, information = offset[:count], information[:count]
    weighted_offset = np.einsum("tij,tj->ti", information, offset)
    total = information.cumsum(0) + 1e-9 * np.eye(6)
    gradient = weighted_offset.cumsum(0)
    common = np.linalg.solve(total, gradient[..., None])[..., 0]
    squares = np.einsum("ti,ti->t", weighted_offset, offset).cumsum()
    return np.maximum(squares - np.einsum("ti,ti->t", gradient, common), 0.0)


def _trim(segments: np.ndarray, poses: np.ndarray, information: np.ndarray) -> np.ndarray:
    """Remove frames from both ends of segments (T,) if they are far from the segment's mean pose.

    Such a frame already moves: lasting errors would not begin just at the end of a rest.
    """
    result = segments.copy()
    for number in range(segments.max(initial=-1) + 1):
        rest = np.flatnonzero(segments == number)
        offset = step_between(poses[rest[[len(rest) // 2]]], poses[rest])
        gradient = np.einsum("tij,tj->i", information[rest], offset)
        common = np.linalg.solve(information[rest].sum(0) + 1e-9 * np.eye(6), gradient)
        off = (
            np.einsum("ti,tij,tj->t", offset - common, information[rest], offset - common)
            > 9.0  # chi square with 6 degrees of freedom: mean 6, 95 % below 12.6
        )
        # frames without evidence at the ends do not count as resting
        inside = np.flatnonzero(~off & (np.trace(information[rest], axis1=1, axis2=2) > 0))
        if not len(inside):
            continue
        if rest[0] > 0:
            result[rest[: inside[0]]] = -1
        if rest[-1] < len(segments) - 1:
            result[rest[inside[-1] + 1 :]] = -1
    return result


def _merge(
    segments: np.ndarray, poses: np.ndarray, information: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """Merge segments (T,) at most two frames apart if one pose costs less than another rest.

    ``MAX_REST_FRAMES`` or one or two outliers may have split a rest: nothing moves away and back in
    two frames, 0.1 s at 30 Hz.
    """
    result = np.full_like(segments, -1)
    number, last = -1, np.zeros(0, int)
    for old in range(segments.max(initial=-1) + 1):
        rest = np.flatnonzero(segments == old)
        if len(last) and rest[0] - last[-1] <= 3:
            both = np.concatenate([last, rest])
            spreads = [_spread(poses[i], information[i], seen[i]) for i in (both, last, rest)]
            apart = 0.5 * (spreads[0][-1] - spreads[1][-1] - spreads[2][-1])
            if len(spreads[0]) == len(both) and apart < POSE_COST:
                result[last[0] : rest[-1] + 1] = number
                last = both
                continue
        number, last = number + 1, rest
        result[rest] = number
    return result
