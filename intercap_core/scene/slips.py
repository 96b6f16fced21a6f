"""Detects slips: images that are whole frames older than their device times, by the body's motion.

A late image shows moving keypoints at their earlier positions. The hypothesis that the images of
one camera in one interval of sets are late by one number of frames changes the expected keypoints.
Its *gain* is the log likelihood ratio against no slip, with the detector's noise correlated over
time (:mod:`.keypoint_timing`).

1. Gains are computed for each camera, number of frames and interval.
2. The images of the best intervals are reassigned to the sets that they show.
3. Both are repeated until no interval is significant, at most 12 times.

A temporary slip is always late. A slip of the whole recording may have either sign, because the
master itself may be late. Without motion no slip is detectable, and none is reported.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from intercap_core.formats.recordings.synchronise import usual_steps
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.solve.robust import OUTLIER_SIGMAS
from intercap_core.geometry.solve.time_series import runs
from intercap_core.scene.keypoint_motion import KeypointMotion, build_motion, motion_along
from intercap_core.scene.keypoint_timing import (
    MIN_TIMING_SETS,
    estimate_noise,
    estimate_offsets,
    keypoints_by_moment,
    precisions,
    windows,
)


@dataclass(frozen=True)
class SlipInterval:
    """Run of late images of one camera."""

    camera: int
    """Camera index."""
    first: int
    """First set."""
    last: int
    """Last set, inclusive."""
    slip: int
    """Frames by which the images are late."""
    gain: float
    """Log likelihood ratio, summed over keypoints."""
    robust_gain: float
    """The same without the four keypoints of greatest gain."""

    @property
    def significant(self) -> bool:
        """Whether ``robust_gain`` reaches 15 + 60 / (number of sets), because false detections are
        short; tuned on the studio."""
        return self.robust_gain >= 15.0 + 60.0 / (self.last - self.first + 1)


@dataclass(frozen=True, eq=False)
class Slips:
    """Late images of a recording."""

    slip: np.ndarray
    """(T, C) int32: whole frames by which each image is older than its set."""
    intervals: tuple[SlipInterval, ...]
    """Detected intervals, by decreasing gain."""


def longest_slip(fps: float) -> int:
    """Largest number of frames by which an image may be late at ``fps`` frames per second.

    InterCap's recordings have slips of up to 4 frames at 30 per second. A full image queue loses a
    number of frames, a busy computer a time. At other rates the larger of 4 frames and 4/30 s is
    used.
    """
    return max(4, round(4 / 30 * fps))


def find_slips(
    keypoints: np.ndarray, rig: Rig, times: np.ndarray, fps: float, *, master: int = 0
) -> Slips:
    """Find slips of up to :func:`longest_slip` frames, temporary or constant.

    A constant delay of a camera is relative to the ``master``. Time offsets are estimated once
    nothing else is significant, and the search continues with their effect removed. Finally each
    interval is estimated again, from a motion that does not use the late images.

    Args:
        keypoints: (T, C, 135, 3) x, y, confidence of the subject by image; 0 = not seen.
        times: (T,) seconds.
    """
    slip = np.zeros(keypoints.shape[:2], np.int32)
    if len(times) < MIN_TIMING_SETS or len(rig) < 2:
        return Slips(slip, ())
    longest = longest_slip(fps)
    steps = [s for s in range(-longest, longest + 1) if s]
    motion = build_motion(keypoints, rig, times)
    offset: np.ndarray | None = None
    always: list[SlipInterval] = []
    for _ in range(12):
        seen = motion if offset is None else motion.at_offsets(offset)
        evidence = _Evidence(seen, steps, fps)
        best = evidence.best(range(len(rig)))
        if best:
            for interval in _apart(best, longest):
                _apply(slip, interval)
                if _spans_all(interval, len(times)):
                    always.append(interval)
            motion = build_motion(
                keypoints_by_moment(keypoints, slip), rig, times, motion.paths.points
            )
        elif offset is None:
            # sub-frame offsets hide weak slips: remove their effect and search again
            offset = estimate_offsets(motion, master, np.zeros(len(rig))).offset
        else:
            break
    if slip.any():
        undisturbed = keypoints.copy()
        if len(rig) >= 4:  # enough other views determine the motion
            undisturbed[slip != constant_slip(slip)] = 0
        motion = build_motion(
            keypoints_by_moment(undisturbed, slip), rig, times, motion.paths.points
        )
    offset = np.zeros(len(rig)) if offset is None else offset
    slip, intervals = _polished(slip, keypoints, motion, offset, steps, fps)
    intervals = sorted([*always, *intervals], key=lambda i: -i.gain)
    of_master = sum(i.slip for i in always if i.camera == master)
    return Slips(slip - np.int32(of_master), tuple(intervals))


def _spans_all(interval: SlipInterval, sets: int) -> bool:
    return interval.last - interval.first + 1 == sets


def constant_slip(slip: np.ndarray) -> np.ndarray:
    """Delay common to all images of each camera (C,), in frames."""
    return np.where((slip != 0).all(0), np.median(slip, 0), 0).astype(np.int32)


def _apply(slip: np.ndarray, interval: SlipInterval) -> None:
    """Add an interval to ``slip`` (T, C), in place.

    The interval counts moments. It applies to the images that show them by the slips so far.
    """
    moment = np.arange(len(slip)) - slip[:, interval.camera]
    late = (moment >= interval.first) & (moment <= interval.last)
    slip[late | _spans_all(interval, len(slip)), interval.camera] += interval.slip


def _apart(intervals: list[SlipInterval], margin: int) -> list[SlipInterval]:
    """The intervals that are accepted in one round, greatest gain first: none within ``margin``
    sets of another, because a late camera distorts the paths, so that others look late."""
    chosen: list[SlipInterval] = []
    for interval in sorted(intervals, key=lambda i: -i.gain):
        first, last = interval.first - margin, interval.last + margin
        if all(other.last < first or other.first > last for other in chosen):
            chosen.append(interval)
    return chosen


def _polished(
    slip: np.ndarray,
    keypoints: np.ndarray,
    motion: KeypointMotion,
    offset: np.ndarray,
    steps: list[int],
    fps: float,
) -> tuple[np.ndarray, list[SlipInterval]]:
    """Estimate each temporary slip again with the given ``motion``, which excludes late images.

    Args:
        slip: (T, C) slips found so far.
        keypoints: (T, C, 135, 3) by image.
        offset: (C,) time offsets, seconds.
        steps: tried numbers of frames.

    Returns:
        Slips (T, C), and the intervals.
    """
    result, intervals = slip.copy(), []
    for c in range(slip.shape[1]):
        constant = constant_slip(slip)[c]
        for first, last in runs(slip[:, c] != constant):
            run = slice(first, last + 1)
            before = slip.copy()
            before[run, c] = constant
            by_moment = keypoints_by_moment(keypoints, before)
            shown = motion_along(motion.paths, by_moment, motion.rig, motion.sigma, motion.bias)
            found = _Evidence(shown.at_offsets(offset), steps, fps).best([c])
            result[run, c] = constant
            for interval in found:
                if not _spans_all(interval, len(slip)):
                    _apply(result, interval)
                    intervals.append(interval)
    return result, intervals


def _tolerant(motion: KeypointMotion, moved: np.ndarray) -> KeypointMotion:
    """The motion with outliers made valid whose residual one of the tried slips explains.

    ``moved``: (S, T, C, K, 2) displacements by the S slips, px.
    """
    size = np.linalg.norm(motion.residual, axis=-1)
    for late in moved:
        size = np.minimum(size, np.linalg.norm(motion.residual - late, axis=-1))
    return replace(motion, valid=motion.seen & (size < OUTLIER_SIGMAS * motion.sigma))


def _robust_gain(gains: np.ndarray) -> float:
    """Sum of the keypoints' gains (K,) without the four greatest.

    A limb that the detector confuses may fit a slip by chance; a true slip moves the whole body.
    """
    return float(np.sort(gains)[:-4].sum())


class _Evidence:
    """Gains of all slips for one motion.

    Intervals are searched within windows of at most 96 sets. Windows shifted by half of their
    length are searched too, for intervals that cross a border.
    """

    def __init__(self, motion: KeypointMotion, steps: list[int], fps: float) -> None:
        self._steps = steps
        self._late = np.empty((len(steps), *motion.residual.shape))
        for number, step in enumerate(steps):
            self._late[number] = np.nan_to_num(motion.shifted(step / fps))
        self._motion = _tolerant(motion, self._late)
        # (C,) sets between two images; a camera of half the rate can only slip by even numbers
        self._own_steps = np.rint(usual_steps(np.any(motion.seen, -1))).astype(int)
        self._noise = estimate_noise(self._motion)
        whole = windows(len(motion.times))
        between = [
            slice((a.start + a.stop) // 2, (b.start + b.stop) // 2) for a, b in pairwise(whole)
        ]
        self._parts = [(part, False) for part in whole] + [(part, True) for part in between]

    def best(self, cameras: Sequence[int]) -> list[SlipInterval]:
        """The significant interval of greatest gain of each camera that has one.

        An interval of all sets stands for a constant delay, which is preferred to a temporary slip
        whose gain is greater by less than 10; tuned on the studio.
        """
        sets, count = self._motion.valid.shape[0], self._motion.valid.shape[2]
        always = {camera: np.zeros((len(self._steps), count)) for camera in cameras}
        top: dict[int, SlipInterval] = {}
        for part, between in self._parts:
            motion = self._motion.window(part)
            precision = precisions(motion, self._noise)
            for camera in cameras:
                own = *_own_series(motion, camera), precision[:, camera]
                cases = {
                    step: _Slipped.of(*own, late[part, camera])
                    for step, late in zip(self._steps, self._late, strict=True)
                }
                if not between:
                    gains = [case.gains(0, part.stop - part.start) for case in cases.values()]
                    always[camera] += np.stack(gains)
                own_step = self._own_steps[camera]
                interval = _best_of_window(
                    {s: case for s, case in cases.items() if s > 0 and s % own_step == 0}
                )
                if interval is not None and (camera not in top or interval.gain > top[camera].gain):
                    first, last = part.start + interval.first, part.start + interval.last
                    top[camera] = replace(interval, camera=camera, first=first, last=last)
        for camera in cameras:
            robust = [_robust_gain(gains) for gains in always[camera]]
            chosen = int(np.argmax(robust))
            gain = float(always[camera][chosen].sum())
            whole = SlipInterval(camera, 0, sets - 1, self._steps[chosen], gain, robust[chosen])
            if whole.significant and (camera not in top or whole.gain > top[camera].gain - 10.0):
                top[camera] = whole
        return [top[camera] for camera in cameras if camera in top]


def _best_of_window(cases: dict[int, _Slipped]) -> SlipInterval | None:
    """The interval, by place in the window, with the greatest gain, if significant."""
    intervals = [case.best(step) for step, case in cases.items()]
    intervals = [interval for interval in intervals if interval.significant]
    if not intervals:
        return None
    most = max(intervals, key=lambda i: i.gain)
    # The gain determines the interval. The number of frames is that of the least misfit in it.
    return min(intervals, key=lambda i: cases[i.slip].misfit(most.first, most.last + 1))


def _own_series(motion: KeypointMotion, camera: int) -> tuple[np.ndarray, np.ndarray]:
    """One camera's residuals, given the keypoints of all other views.

    The projector of the motion is N = (I - P) W^(1/2). Let (I - P)_cc be its 2 x 2 diagonal block
    of the camera, without the weights, and w = 1 / sigma. The information matrix of the camera's
    pixel is w (I - P)_cc w.

    Returns:
        Matrices (T, K, 2, 2) that whiten the camera's pixels: root of (I - P)_cc times w.
        Whitened residuals (T, K, 2).
    """
    both = slice(2 * camera, 2 * camera + 2)
    scale = np.where(motion.valid[:, camera], 1 / motion.sigma[camera], 0.0)[..., None, None]
    block = motion.projector[:, :, both, both] / np.maximum(scale, 1e-12)
    # two views constrain one direction only: a small ridge keeps the root invertible
    block = block + 1e-6 * np.eye(2)
    determinant = np.sqrt(np.maximum(np.linalg.det(block), 0))[..., None, None]
    trace = np.trace(block, axis1=2, axis2=3)[..., None, None]
    # square root of a symmetric 2 x 2 matrix in closed form; ``determinant`` is already a root
    half = (block + determinant * np.eye(2)) / np.sqrt(trace + 2 * determinant)
    weighted = motion.projected_residual[..., both]
    return half * scale, np.linalg.solve(half, weighted[..., None])[..., 0]


@dataclass(frozen=True, eq=False)
class _Slipped:
    """One camera's residuals under the hypothesis of a slip."""

    series: np.ndarray
    """(K, W, 2) whitened residuals."""
    change: np.ndarray
    """(K, W, 2) change of the whitened residuals by the slip."""
    linear: np.ndarray
    """(K, W) product of ``change`` with the residuals times ``precision``; its sum over an interval
    is the linear part of the gain."""
    precision: np.ndarray
    """(K, W, W) inverse covariance over time."""

    @classmethod
    def of(
        cls, root: np.ndarray, series: np.ndarray, precision: np.ndarray, late: np.ndarray
    ) -> _Slipped:
        """The hypothesis that keypoints are displaced by ``late`` (W, K, 2) px.

        Args:
            root: (W, K, 2, 2), see :func:`_own_series`.
            series: (W, K, 2), see :func:`_own_series`.
            precision: (K, W, W) inverse covariance over time.
        """
        change = np.einsum("tkij,tkj->ktj", root, late)
        series = np.swapaxes(series, 0, 1)
        return cls(series, change, (change * (precision @ series)).sum(-1), precision)

    def gains(self, first: int, end: int) -> np.ndarray:
        """The keypoints' gains (K,) if the sets from ``first`` to before ``end`` are late."""
        part = slice(first, end)
        change, precision = self.change[:, part], self.precision[:, part, part]
        energy = (change * (precision @ change)).sum((1, 2))
        return self.linear[:, part].sum(1) - energy / 2

    def misfit(self, first: int, end: int) -> float:
        """Sum of truncated squared residuals that remain with the slip, in sets ``first`` to
        ``end`` - 1.

        They are not whitened over time, because whitening amplifies fast errors of the paths.
        """
        left = self.series[:, first:end] - self.change[:, first:end]
        return float(np.minimum((left**2).sum(-1), OUTLIER_SIGMAS**2).sum())

    def best(self, step: int) -> SlipInterval:
        """The interval of greatest gain. Sets are counted within the window; ``camera`` is 0."""
        energy = (self.precision * (self.change @ np.swapaxes(self.change, 1, 2))).sum(0)
        gain = interval_gains(self.linear.sum(0), energy)
        first, end = (int(i) for i in np.unravel_index(int(np.argmax(gain)), gain.shape))
        gains = self.gains(first, end)
        return SlipInterval(0, first, end - 1, step, float(gains.sum()), _robust_gain(gains))


def interval_gains(linear: np.ndarray, quadratic: np.ndarray) -> np.ndarray:
    """Gains (W + 1, W + 1) of all intervals [first, end), by first (row) and end; -inf = empty.

    A gain is the sum of ``linear`` (W,) minus half the sum of ``quadratic`` (W, W) over the
    interval. All are computed at once from cumulative sums.
    """
    size = len(linear)
    sums = np.r_[0.0, np.cumsum(linear)]
    table = np.zeros((size + 1, size + 1))
    table[1:, 1:] = quadratic.cumsum(0).cumsum(1)
    corner = np.diag(table)
    energy = corner[None, :] + corner[:, None] - table - table.T
    gain = sums[None, :] - sums[:, None] - energy / 2
    return np.where(np.tri(size + 1, dtype=bool), -np.inf, gain)
