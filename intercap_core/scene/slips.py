"""Detects images that are whole frames older than their device times, from the body's motion.

While a camera's images are late, every keypoint that moves is seen where it was a while ago. For
each camera, each number of frames and each interval of sets, the gain in log likelihood of the
keypoints is worked out under the detector's own noise over time. The best intervals are taken,
their images reassigned to the sets that they show, and the search is repeated until no interval is
significant. While nobody moves a slip cannot be seen, and none is reported.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from intercap_core.formats.recordings.synchronise import usual_steps
from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.keypoint_motion import (
    OUTLIER_SIGMA,
    KeypointMotion,
    build_motion,
    with_keypoints,
)
from intercap_core.scene.keypoint_timing import (
    MIN_TIMING_SETS,
    estimate_noise,
    estimate_offsets,
    keypoints_by_moment,
    precisions,
    windows,
)

# By how much an image is late. What holds it back is a queue, of some images, or a computer that is
# busy, for some time: slips of 1 to 4 images at 30 a second occur in InterCap's recordings, and the
# greater of the two counts at other rates.
MAX_SLIP_FRAMES, MAX_SLIP_S = 4, 4 / 30
SLIP_ROUNDS = 12  # at most: each takes the best intervals and looks again
# Log likelihood without the keypoints that gain most: limbs that a detector confuses fit a slip by
# chance, but never all over the body. Chance finds are short: what is beyond doubt depends on how
# many sets say it. Tuned on the studio.
MIN_SLIP_GAIN = 15.0
MIN_SLIP_GAIN_OF_SET = 60.0  # over the number of sets
SLIP_LEFT_OUT = 4  # keypoints
SLIP_GAIN_PER_SET = 1.0  # a set must bring this much to belong to an interval
CLEAR_SLIP_GAIN = 10.0  # of an interval over the whole recording's being late
SLIP_WORTH = 0.2  # of the best interval's gain makes another worth taking at once
SLIPS_APART_S = 1.0  # nearer in time, one slip may have brought about another
MANY_VIEWS = 4  # suffice for the body's motion without those that slip


@dataclass(frozen=True)
class SlipInterval:
    """Camera ``camera`` shows in sets ``first`` to ``last``, inclusive, what was to be seen
    ``slip`` frames before; ``gain`` in log likelihood, ``sure`` without the best keypoints."""

    camera: int
    first: int
    last: int
    slip: int
    gain: float
    sure: float

    @property
    def beyond_doubt(self) -> bool:
        """Whether its gain is significant: above what chance produces."""
        return self.sure >= MIN_SLIP_GAIN + MIN_SLIP_GAIN_OF_SET / (self.last - self.first + 1)


@dataclass(frozen=True, eq=False)
class Slips:
    """``slip`` (T, C) int32: whole frames by which each image is older than its set says, and the
    intervals that were found, in the order of their gain."""

    slip: np.ndarray
    intervals: tuple[SlipInterval, ...]


def longest_slip(fps: float) -> int:
    """By how many frames, ``fps`` a second, an image may be late."""
    return max(MAX_SLIP_FRAMES, round(MAX_SLIP_S * fps))


def find_slips(
    keypoints: np.ndarray,
    rig: Rig,
    times: np.ndarray,
    fps: float,
    *,
    master: int = 0,
) -> Slips:
    """Find slips of up to :func:`longest_slip` frames in any camera, for a while or always.

    ``keypoints`` (T, C, 135, 3) x, y, confidence of the subject by image, 0 = not seen; ``times``
    (T,) s. A delay of all images of a camera is relative to the ``master``'s.
    """
    slip = np.zeros(keypoints.shape[:2], np.int32)
    if len(times) < MIN_TIMING_SETS or len(rig) < 2:
        return Slips(slip, ())
    longest = longest_slip(fps)
    steps = [s for s in range(-longest, longest + 1) if s]
    motion = build_motion(keypoints, rig, times)
    offset: np.ndarray | None = None
    always: list[SlipInterval] = []
    for _ in range(SLIP_ROUNDS):
        seen = motion if offset is None else motion.at_offsets(offset)
        evidence = _Evidence(seen, steps, fps)
        best = [i for c in range(len(rig)) if (i := evidence.best(c)) is not None]
        if best:
            for interval in _apart(best, times):
                _apply(slip, interval)
                if _whole(interval, len(times)):
                    always.append(interval)
            motion = build_motion(
                keypoints_by_moment(keypoints, slip), rig, times, motion.paths.points
            )
        elif offset is None:
            # Slips are large against offsets, but weak ones hide behind them: look once more.
            offset = estimate_offsets(motion, master).offset
        else:
            break
    if slip.any():
        undisturbed = keypoints.copy()
        if len(rig) >= MANY_VIEWS:
            undisturbed[slip != constant_slip(slip)] = 0
        motion = build_motion(
            keypoints_by_moment(undisturbed, slip), rig, times, motion.paths.points
        )
    offset = np.zeros(len(rig)) if offset is None else offset
    slip, intervals = _polished(slip, keypoints, motion, offset, steps, fps)
    intervals = sorted([*always, *intervals], key=lambda i: -i.gain)
    of_master = sum(i.slip for i in always if i.camera == master)
    return Slips(slip - np.int32(of_master), tuple(intervals))


def _whole(interval: SlipInterval, sets: int) -> bool:
    return interval.last - interval.first + 1 == sets


def constant_slip(slip: np.ndarray) -> np.ndarray:
    """The delay common to all images of each camera (C,), in frames."""
    return np.where((slip != 0).all(0), np.median(slip, 0), 0).astype(np.int32)


def _apply(slip: np.ndarray, interval: SlipInterval) -> None:
    """Add to ``slip`` (T, C), in place, for the images that so far show the interval's moments."""
    moment = np.arange(len(slip)) - slip[:, interval.camera]
    late = (moment >= interval.first) & (moment <= interval.last)
    slip[late | _whole(interval, len(slip)), interval.camera] += interval.slip


def _apart(intervals: list[SlipInterval], times: np.ndarray) -> list[SlipInterval]:
    """The best interval and those that it cannot have caused.

    An unsynchronised camera makes others look so: much weaker intervals, and those near it in time,
    are left to the next round.
    """
    ordered = sorted(intervals, key=lambda i: -i.gain)
    taken: list[SlipInterval] = []
    for interval in ordered:
        early, late = times[interval.first] - SLIPS_APART_S, times[interval.last] + SLIPS_APART_S
        if interval.gain >= SLIP_WORTH * ordered[0].gain and all(
            times[other.last] < early or times[other.first] > late for other in taken
        ):
            taken.append(interval)
    return taken


def _runs(chosen: np.ndarray) -> list[np.ndarray]:
    """The places of each unbroken run of True."""
    places = np.flatnonzero(chosen)
    return np.split(places, np.flatnonzero(np.diff(places) > 1) + 1) if len(places) else []


def _polished(
    slip: np.ndarray,
    keypoints: np.ndarray,
    motion: KeypointMotion,
    offset: np.ndarray,
    steps: list[int],
    fps: float,
) -> tuple[np.ndarray, list[SlipInterval]]:
    """Find each interval once more, against the motion that no slip disturbs any longer."""
    result, intervals = slip.copy(), []
    for c in range(slip.shape[1]):
        constant = constant_slip(slip)[c]
        for run in _runs(slip[:, c] != constant):
            before = slip.copy()
            before[run, c] = constant
            shown = with_keypoints(motion, keypoints_by_moment(keypoints, before))
            found = _Evidence(shown.at_offsets(offset), steps, fps).best(c)
            result[run, c] = constant
            if found is not None and not _whole(found, len(slip)):
                _apply(result, found)
                intervals.append(found)
    return result, intervals


def _tolerant(motion: KeypointMotion, moved: np.ndarray) -> KeypointMotion:
    """The motion, where residuals that a slip would explain count as valid, too; ``moved`` (S, T,
    C, K, 2) px."""
    size = np.linalg.norm(motion.residual, axis=-1)
    for late in moved:
        size = np.minimum(size, np.linalg.norm(motion.residual - late, axis=-1))
    return replace(motion, valid=motion.seen & (size < OUTLIER_SIGMA * motion.sigma))


def _sure(gains: np.ndarray) -> float:
    """The sum of the keypoints' gains (K,) without the best few."""
    return float(np.sort(gains)[:-SLIP_LEFT_OUT].sum())


class _Evidence:
    """Evidence of the residuals for slips of ``steps`` frames."""

    def __init__(self, motion: KeypointMotion, steps: list[int], fps: float) -> None:
        self._steps = steps
        self._late = np.stack([np.nan_to_num(motion.shifted(s / fps)) for s in steps])
        self._motion = _tolerant(motion, self._late)
        # a camera of half the rate slips by two sets at a time
        self._own_steps = np.rint(usual_steps(np.any(motion.seen, -1))).astype(int)
        noise = estimate_noise(self._motion)
        whole = windows(len(motion.times))
        between = [
            slice((a.start + a.stop) // 2, (b.start + b.stop) // 2) for a, b in pairwise(whole)
        ]
        self._parts = [(part, False) for part in whole] + [(part, True) for part in between]
        self._precisions = [precisions(self._motion, noise, part) for part, _ in self._parts]

    def best(self, camera: int) -> SlipInterval | None:
        """The interval of one camera with the greatest gain, if significant."""
        sets, own_step = len(self._motion.times), self._own_steps[camera]
        root, series = _own_series(self._motion, camera)
        always = {step: np.zeros(series.shape[1]) for step in self._steps}
        top = None
        for (part, between), precision in zip(self._parts, self._precisions, strict=True):
            window = _Window(root[part], series[part], precision[:, camera])
            cases = {
                step: window.slipped(late[part, camera])
                for step, late in zip(self._steps, self._late, strict=True)
            }
            if not between:
                for step, case in cases.items():
                    always[step] += case.gains(0, part.stop - part.start)
            found = _best_of_window(
                {s: case for s, case in cases.items() if s > 0 and s % own_step == 0}
            )
            if found is not None and (top is None or found.gain > top.gain):
                top = replace(
                    found,
                    camera=camera,
                    first=part.start + found.first,
                    last=part.start + found.last,
                )
        step = max(self._steps, key=lambda s: _sure(always[s]))
        whole = SlipInterval(
            camera, 0, sets - 1, step, float(always[step].sum()), _sure(always[step])
        )
        if whole.beyond_doubt and (top is None or whole.gain > top.gain - CLEAR_SLIP_GAIN):
            return whole
        return top


def _best_of_window(cases: dict[int, _Slipped]) -> SlipInterval | None:
    """The interval, by place in the window, with the greatest gain, if significant."""
    found = [case.best(step) for step, case in cases.items()]
    found = [interval for interval in found if interval.beyond_doubt]
    if not found:
        return None
    most = max(found, key=lambda i: i.gain)
    # the gain shows best that and when images are late, the misfit by how much
    return min(found, key=lambda i: cases[i.slip].misfit(most.first, most.last + 1))


def _own_series(motion: KeypointMotion, camera: int) -> tuple[np.ndarray, np.ndarray]:
    """One camera's residuals given all other views': ``root`` (T, K, 2, 2) makes its pixels of unit
    variance, ``series`` (T, K, 2) are the residuals so.

    With the projector N = (I - P) W^(1/2), the information on the camera's own pixels is
    w (I - P)_cc w; its symmetric root is ``root``.
    """
    both = slice(2 * camera, 2 * camera + 2)
    scale = np.where(motion.valid[:, camera], 1 / motion.sigma[camera], 0.0)[..., None, None]
    block = motion.projector[:, :, both, both] / np.maximum(scale, 1e-12)
    # two views constrain one direction only: a small ridge keeps the root invertible
    block = block + 1e-6 * np.eye(2)
    determinant = np.sqrt(np.maximum(np.linalg.det(block), 0))[..., None, None]
    trace = np.trace(block, axis1=2, axis2=3)[..., None, None]
    half = (block + determinant * np.eye(2)) / np.sqrt(trace + 2 * determinant)
    weighted = motion.projected(motion.residual)[..., both]
    return half * scale, np.linalg.solve(half, weighted[..., None])[..., 0]


@dataclass(frozen=True, eq=False)
class _Window:
    """W sets: ``root`` (W, K, 2, 2) and ``series`` (W, K, 2) as :func:`_own_series` gives;
    ``precision`` (K, W, W) over time."""

    root: np.ndarray
    series: np.ndarray
    precision: np.ndarray

    def slipped(self, late: np.ndarray) -> _Slipped:
        """The hypothesis that keypoints are displaced by ``late`` (W, K, 2) px."""
        change = np.einsum("tkij,tkj->ktj", self.root, late)
        weighted = self.precision @ np.swapaxes(self.series, 0, 1)
        series = np.swapaxes(self.series, 0, 1)
        return _Slipped(series, change, (change * weighted).sum(-1), self.precision)


@dataclass(frozen=True, eq=False)
class _Slipped:
    """Residuals ``series`` (K, W, 2), their ``change`` (K, W, 2) by the slip, and ``linear`` (K, W)
    the product of the two, whitened over time by ``precision`` (K, W, W)."""

    series: np.ndarray
    change: np.ndarray
    linear: np.ndarray
    precision: np.ndarray

    def gains(self, first: int, end: int) -> np.ndarray:
        """The keypoints' gains (K,) if the sets from ``first`` to before ``end`` are late."""
        part = slice(first, end)
        change, precision = self.change[:, part], self.precision[:, part, part]
        energy = (change * (precision @ change)).sum((1, 2))
        return self.linear[:, part].sum(1) - energy / 2

    def misfit(self, first: int, end: int) -> float:
        """Truncated squares of what the slip leaves. Not whitened over time: that would count the
        errors of the paths themselves, which change fast, as much as the motion."""
        left = self.series[:, first:end] - self.change[:, first:end]
        return float(np.minimum((left**2).sum(-1), OUTLIER_SIGMA**2).sum())

    def best(self, step: int) -> SlipInterval:
        """The interval of greatest gain, by place in the window, of camera 0."""
        energy = (self.precision * (self.change @ np.swapaxes(self.change, 1, 2))).sum(0)
        gain = interval_gains(self.linear.sum(0) - SLIP_GAIN_PER_SET, energy)
        first, end = (int(i) for i in np.unravel_index(int(np.argmax(gain)), gain.shape))
        gains = self.gains(first, end)
        return SlipInterval(0, first, end - 1, step, float(gains.sum()), _sure(gains))


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
