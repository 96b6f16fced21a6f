"""Functions of time series: runs, interpolation of gaps, velocities, and Viterbi's algorithm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.geometry.camera.transforms import rotation_log


def sample_evenly(available: np.ndarray, most: int) -> np.ndarray:
    """Return at most ``most`` frame indices, spread evenly over the ``available`` (T,) frames."""
    frames = np.flatnonzero(available)
    if len(frames) <= most:
        return frames
    return frames[np.linspace(0, len(frames) - 1, most).round().astype(int)]


def runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """Return the first and last frame of each unbroken run of set frames of a mask (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(first, stop - 1) for first, stop in edges.reshape(-1, 2).tolist()]


def nearest(known: np.ndarray | Sequence[int], frames: np.ndarray | Sequence[int]) -> np.ndarray:
    """Return the nearest of ``known`` (n,) frames, ascending and not empty, to ``frames`` (k,).

    Of two that are as near, the first is returned.
    """
    known, frames = np.asarray(known), np.asarray(frames)
    after = np.searchsorted(known, frames)
    low, high = known[np.maximum(after - 1, 0)], known[np.minimum(after, len(known) - 1)]
    return np.where(np.abs(frames - low) <= np.abs(high - frames), low, high)


def filled_linearly(values: np.ndarray, at: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return values (T, D) with rows that are not ``known`` (T,) interpolated linearly.

    ``at`` (T,) are increasing times or frame numbers. Before the first and after the last known row
    its values are repeated. Without a known row the values are returned unchanged.
    """
    result = values.copy()
    if known.any() and not known.all():
        for column in range(values.shape[1]):
            result[~known, column] = np.interp(at[~known], at[known], values[known, column])
    return result


def limited_velocity(
    positions: np.ndarray, times: np.ndarray, *, max_speed: float, known: np.ndarray | None = None
) -> np.ndarray:
    """Return velocities (T, ..., D) of positions (T, ..., D) by central differences.

    Differences are of fourth order if two positions on each side are known, else of second order.
    Hands reverse within a few frames: of the speed of a motion at 2 Hz, recorded at 15 frames per
    second, second order recovers 89 % and fourth order 98 %. With one known neighbour the one-sided
    difference is used.

    A single wrong position enlarges one of the two one-sided differences at each of its neighbours.
    Velocities are therefore limited to twice the shorter one-sided difference (van Leer's slope
    limiter, 1977, for vectors).

    Args:
        positions: (T, ..., D) metres.
        times: (T,) seconds.
        max_speed: largest speed of the result, m/s.
        known: (T, ...) bool; None = finite positions. Unknown positions have velocity 0 and are no
            neighbours.
    """
    known = np.isfinite(positions).all(-1) if known is None else known
    change = np.diff(np.where(known[..., None], positions, 0), axis=0)
    return limited_rate(change, times, max_speed=max_speed, known=known)


def limited_rate(
    change: np.ndarray, times: np.ndarray, *, max_speed: float, known: np.ndarray
) -> np.ndarray:
    """Return rates (T, ..., D) as :func:`limited_velocity`, from changes between samples.

    This serves quantities that cannot be subtracted, such as rotations.

    Args:
        change: (T - 1, ..., D) change from each sample to the next.
        times: (T,) seconds.
        max_speed: largest rate of the result.
        known: (T, ...) bool, the sample is known.
    """
    if len(times) < 2:
        return np.zeros((len(times), *change.shape[1:]))
    step = np.diff(times).reshape(-1, *[1] * (change.ndim - 1))
    both = known[1:] & known[:-1] & (step[..., 0] < 0.25)  # seconds; a longer interval is a gap
    slope = np.where(both[..., None], change, 0) / step
    none, still = np.zeros((1, *both.shape[1:]), bool), np.zeros((1, *slope.shape[1:]))
    ahead, behind = np.concatenate([slope, still]), np.concatenate([still, slope])
    has_ahead, has_behind = np.concatenate([both, none]), np.concatenate([none, both])
    after, before = np.concatenate([step, step[-1:]]), np.concatenate([step[:1], step])
    central = (before * ahead + after * behind) / (before + after)
    central = central + _fourth_order(slope, both, step)
    longest = 2.0 * np.minimum(_length(ahead), _length(behind))
    central = _shortened(central, longest)
    two = (has_ahead & has_behind)[..., None]
    return _shortened(np.where(two, central, ahead + behind), max_speed)


def rigid_velocity(poses: np.ndarray, known: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return velocities (T, 6): angular velocity (rad/s), then velocity of the origin (m/s).

    They are 0 for unknown poses, and limited as in :func:`limited_velocity`, with maxima of
    20 rad/s and 8 m/s for the fastest thrown or kicked objects.

    Args:
        poses: (T, 4, 4) master_from_object.
        known: (T,) whether a pose is reliable.
        times: (T,) seconds.
    """
    if len(poses) < 2:
        return np.zeros((len(poses), 6))
    turns = rotation_log(poses[1:, :3, :3] @ poses[:-1, :3, :3].transpose(0, 2, 1))
    turn = limited_rate(turns, times, max_speed=20.0, known=known)
    shifts = np.diff(poses[:, :3, 3], axis=0)
    shift = limited_rate(shifts, times, max_speed=8.0, known=known)
    return np.concatenate([turn, shift], axis=1)


def _fourth_order(slope: np.ndarray, both: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return what a fourth-order difference adds to a central one, (T, ..., D).

    With the time step h it is (8 (x_1 - x_-1) - (x_2 - x_-2)) / (12 h) minus (x_1 - x_-1) / (2 h).
    It is 0 if one of the four slopes is unknown or the steps differ by more than 20 %.

    Args:
        slope: (T - 1, ..., D) slope between consecutive samples.
        both: (T - 1, ...) bool, both samples are known.
        step: (T - 1, ...) seconds between them.
    """
    result = np.zeros((len(slope) + 1, *slope.shape[1:]))
    if len(slope) >= 4:
        one, two, three, four = (slope[k : len(slope) - 3 + k] for k in range(4))
        known = both[:-3] & both[1:-2] & both[2:-1] & both[3:]
        widest = np.maximum.reduce([step[k : len(step) - 3 + k] for k in range(4)])
        narrowest = np.minimum.reduce([step[k : len(step) - 3 + k] for k in range(4)])
        even = widest < 1.2 * narrowest
        result[2:-2] = np.where(known[..., None] & even, (two + three - one - four) / 12, 0)
    return result


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vectors, axis=-1, keepdims=True)


def _shortened(vectors: np.ndarray, longest: np.ndarray | float) -> np.ndarray:
    return vectors * np.minimum(1.0, longest / np.maximum(_length(vectors), 1e-12))


def cheapest_sequence(
    first: np.ndarray, steps: np.ndarray, last: np.ndarray | None = None
) -> np.ndarray:
    """Return states (T,) int64 that minimise first[s_0] + sum_t steps[t, s_t, s_t+1] + last[s_T-1].

    Viterbi, IEEE Trans. Inf. Theory 13(2):260, 1967. Of equal costs the lowest state is chosen.

    Args:
        first: (S,) cost of each state at the start.
        steps: (T - 1, S, S) cost of a transition, including the cost of the next state.
        last: (S,) additional cost of each state at the end.
    """
    total, came_from = np.asarray(first), []
    for step in steps:
        reach = total[:, None] + step
        came_from.append(reach.argmin(0))
        total = reach.min(0)
    chosen = [int((total if last is None else total + last).argmin())]
    for back in reversed(came_from):
        chosen.append(int(back[chosen[-1]]))
    return np.array(chosen[::-1])
