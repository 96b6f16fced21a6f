"""Images that are whole frames older than their device times say, found by the body's motion.

While a camera's images are late, every keypoint that moves is seen where it was a while ago. For
each camera, each number of frames and each interval of sets, the gain in log likelihood of the
keypoints is worked out under the detector's own noise over time. The best intervals are taken, the
images are put where they belong, and the search is repeated until nothing is left that is beyond
doubt. While nobody moves a slip cannot be seen, and none is reported.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from intercap_core.camera.rig import Rig
from intercap_core.scene.keypoint_motion import OUTLIER_SIGMA, Motion, build_motion
from intercap_core.scene.keypoint_timing import by_moment, noise_of, precisions, windows

# In log likelihood, without the keypoints that gain most: limbs that a detector confuses, or
# places, fit a slip by chance, but never all over the body.
MIN_GAIN = 60.0
LEFT_OUT = 4
CLEAR_GAIN = 10.0  # an interval must gain this much over the whole recording's being late
MAX_ROUNDS = 12
MIN_SETS = 8


@dataclass(frozen=True)
class Interval:
    """Camera ``camera`` shows in sets ``first`` to ``last``, inclusive, what was to be seen
    ``slip`` frames before; ``gain`` in log likelihood, ``sure`` without the best keypoints."""

    camera: int
    first: int
    last: int
    slip: int
    gain: float
    sure: float


@dataclass(frozen=True, eq=False)
class Slips:
    """``slip`` (T, C) int32: whole frames by which each image is older than its set says, and the
    intervals that were found, in the order of their gain."""

    slip: np.ndarray
    intervals: tuple[Interval, ...]


def find_slips(
    keypoints: np.ndarray,
    rig: Rig,
    times: np.ndarray,
    fps: float,
    *,
    max_slip: int = 4,
    master: int = 0,
) -> Slips:
    """Find slips of up to ``max_slip`` frames in any camera, for a while or always.

    ``keypoints`` (T, C, 135, 3) x, y, confidence of the subject by image, 0 = not seen; ``times``
    (T,) s. What all images of a camera are late by is counted from the ``master``'s.
    """
    slip = np.zeros(keypoints.shape[:2], np.int32)
    intervals: list[Interval] = []
    if len(times) < MIN_SETS or len(rig) < 2:
        return Slips(slip, ())
    for _ in range(MAX_ROUNDS):
        found = _round(by_moment(keypoints, slip), rig, times, fps, max_slip)
        if not found:
            break
        for interval in found:
            moment = np.arange(len(times)) - slip[:, interval.camera]
            late = (moment >= interval.first) & (moment <= interval.last)
            slip[late | _whole(interval, len(times)), interval.camera] += interval.slip
        intervals += found
    always = [i.slip for i in intervals if i.camera == master and _whole(i, len(times))]
    return Slips(slip - np.int32(sum(always)), tuple(intervals))


def _whole(interval: Interval, sets: int) -> bool:
    return interval.last - interval.first + 1 == sets


def _round(
    keypoints: np.ndarray, rig: Rig, times: np.ndarray, fps: float, max_slip: int
) -> list[Interval]:
    """The best interval of each camera that is beyond doubt, of those that overlap the best."""
    motion = build_motion(keypoints, rig, times)
    if not motion.valid.any():
        return []
    shifts = [s for s in range(-max_slip, max_slip + 1) if s]
    moved = np.stack([np.nan_to_num(motion.shifted(s / fps)) for s in shifts])
    evidence = _Evidence(_tolerant(motion, moved))
    best: list[Interval] = []
    for c in range(len(rig)):
        always, at_times = {}, []
        for window in evidence.windows(c):
            for shift, late in zip(shifts, moved, strict=True):
                slipped = window.slipped(late[window.part, c])
                if not window.between:
                    always[shift] = always.get(shift, 0.0) + slipped.whole()
                if shift > 0:
                    at_times.append(slipped.best(c, window.part.start, shift))
        candidates = [i for i in at_times if i.sure >= MIN_GAIN]
        top = max(candidates, key=lambda i: i.gain, default=None)
        shift = max(shifts, key=lambda s: _sure(always[s]))
        whole = always[shift]
        if _sure(whole) >= MIN_GAIN and (top is None or whole.sum() > top.gain - CLEAR_GAIN):
            top = Interval(c, 0, len(times) - 1, shift, float(whole.sum()), _sure(whole))
        if top is not None:
            best.append(top)
    best.sort(key=lambda i: -i.gain)
    taken: list[Interval] = []
    for interval in best:
        # A camera out of step makes the others look so while it lasts: one at a time.
        if all(interval.first > o.last or interval.last < o.first for o in taken):
            taken.append(interval)
    return taken


def _tolerant(motion: Motion, moved: np.ndarray) -> Motion:
    """The motion with what any slip would explain as valid, too; ``moved`` (S, T, C, K, 2) px."""
    size = np.linalg.norm(motion.residual, axis=-1)
    for late in moved:
        size = np.minimum(size, np.linalg.norm(motion.residual - late, axis=-1))
    return replace(motion, valid=motion.seen & (size < OUTLIER_SIGMA * motion.sigma))


def _sure(gains: np.ndarray) -> float:
    """The sum of the keypoints' gains (K,) without the best few."""
    return float(np.sort(gains)[:-LEFT_OUT].sum())


class _Evidence:
    """What the residuals of each camera say, whitened over views."""

    def __init__(self, motion: Motion) -> None:
        self._motion = motion
        self._noise = noise_of(motion)
        whole = windows(len(motion.times))
        between = [
            slice((a.start + a.stop) // 2, (b.start + b.stop) // 2)
            for a, b in zip(whole, whole[1:], strict=False)
        ]
        self._parts = [(part, False) for part in whole] + [(part, True) for part in between]
        self._precisions = [precisions(motion, self._noise, part) for part, _ in self._parts]

    def windows(self, camera: int) -> Iterator[_Window]:
        """The windows over the recording, first those that cover it, then those between them."""
        root, series = _own_series(self._motion, camera)
        for (part, between), precision in zip(self._parts, self._precisions, strict=True):
            yield _Window(part, between, root[part], series[part], precision[:, camera])


def _own_series(motion: Motion, camera: int) -> tuple[np.ndarray, np.ndarray]:
    """One camera's residuals given all other views': ``root`` (T, K, 2, 2) makes its pixels of unit
    variance, ``series`` (T, K, 2) are the residuals so.

    With the projector N = (I - P) W^(1/2), the information on the camera's own pixels is
    w (I - P)_cc w; its symmetric root is ``root``.
    """
    both = slice(2 * camera, 2 * camera + 2)
    scale = np.where(motion.valid[:, camera], 1 / motion.sigma[camera], 0.0)[..., None, None]
    block = motion.projector[:, :, both, both] / np.maximum(scale, 1e-12)
    # Two views leave but one direction: a hair of the other keeps the root invertible.
    block = block + 1e-6 * np.eye(2)
    determinant = np.sqrt(np.maximum(np.linalg.det(block), 0))[..., None, None]
    trace = np.trace(block, axis1=2, axis2=3)[..., None, None]
    half = (block + determinant * np.eye(2)) / np.sqrt(trace + 2 * determinant)
    weighted = motion.projected(motion.residual)[..., both]
    return half * scale, np.linalg.solve(half, weighted[..., None])[..., 0]


@dataclass(frozen=True, eq=False)
class _Window:
    """``part`` of the sets, W of them; ``root`` (W, K, 2, 2) and ``series`` (W, K, 2) as
    :func:`_own_series` gives; ``precision`` (K, W, W) over time."""

    part: slice
    between: bool
    root: np.ndarray
    series: np.ndarray
    precision: np.ndarray

    def slipped(self, late: np.ndarray) -> _Slipped:
        """The case that keypoints are displaced by ``late`` (W, K, 2) px."""
        change = np.einsum("tkij,tkj->ktj", self.root, late)
        weighted = self.precision @ np.swapaxes(self.series, 0, 1)
        return _Slipped(change, (change * weighted).sum(-1), self.precision)


@dataclass(frozen=True, eq=False)
class _Slipped:
    """``change`` (K, W, 2) of the whitened residuals, ``linear`` (K, W) its product with them."""

    change: np.ndarray
    linear: np.ndarray
    precision: np.ndarray

    def whole(self) -> np.ndarray:
        """The keypoints' gains (K,) if the whole window is late."""
        return self._gains(0, self.linear.shape[1])

    def _gains(self, first: int, end: int) -> np.ndarray:
        part = slice(first, end)
        change, precision = self.change[:, part], self.precision[:, part, part]
        energy = (change * (precision @ change)).sum((1, 2))
        return self.linear[:, part].sum(1) - energy / 2

    def best(self, camera: int, start: int, shift: int) -> Interval:
        """The interval of greatest gain; sets counted from the window's ``start``."""
        energy = (self.precision * (self.change @ np.swapaxes(self.change, 1, 2))).sum(0)
        gain = interval_gains(self.linear.sum(0), energy)
        first, end = np.unravel_index(int(np.argmax(gain)), gain.shape)
        sure = _sure(self._gains(int(first), int(end)))
        return Interval(
            camera, start + int(first), start + int(end) - 1, shift, float(gain[first, end]), sure
        )


def interval_gains(linear: np.ndarray, quadratic: np.ndarray) -> np.ndarray:
    """Gains (W + 1, W + 1) of intervals [first, end): the sum of ``linear`` (W,) less half the sum
    of ``quadratic`` (W, W) over them; -inf where they hold nothing."""
    size = len(linear)
    sums = np.r_[0.0, np.cumsum(linear)]
    table = np.zeros((size + 1, size + 1))
    table[1:, 1:] = quadratic.cumsum(0).cumsum(1)
    corner = np.diag(table)
    energy = corner[None, :] + corner[:, None] - table - table.T
    gain = sums[None, :] - sums[:, None] - energy / 2
    return np.where(np.tri(size + 1, dtype=bool), -np.inf, gain)
