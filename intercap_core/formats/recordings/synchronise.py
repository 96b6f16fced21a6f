"""Frame sets: one image of each camera, taken at one time according to the cameras' clocks.

Clocks may be wrong. The scene stage then finds that an image shows the moment of another set; the
difference is its slip, in sets. :func:`images_of_moments` rearranges the images accordingly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

# In periods: an image that is farther from every set starts a new set. More than half, so that no
# set starts between two regular ones.
NEW_SET_GAP = 0.6
# A longer step from one image to the next is a pause of the recording or a jump of the clock,
# microseconds. Cameras that people stop by hand end within a few seconds of each other.
LONG_STEP_US = 10_000_000


@dataclass(frozen=True)
class SetTable:
    """The images of T frame sets of C cameras."""

    times_us: np.ndarray
    """(T,) int64, increasing: device time of the master, or of others if it has no image."""
    index: np.ndarray
    """(T, C) int32: position among each camera's images; -1 = none."""
    skew_us: np.ndarray
    """(T, C) float64: time of the image minus that of the set; NaN = no image."""
    unmatched: np.ndarray
    """(C,) number of images in no set."""

    def gaps(self, period_us: float) -> list[tuple[int, int]]:
        """Gaps in which no camera has an image: (set before the gap, number of missing sets)."""
        steps = np.rint(np.diff(self.times_us) / period_us).astype(int)
        return [(int(at), int(steps[at]) - 1) for at in np.flatnonzero(steps > 1)]

    def describe_gaps(self, period_us: float) -> list[str]:
        """A note on :meth:`gaps`; [] without any."""
        gaps = self.gaps(period_us)
        if not gaps:
            return []
        note = (
            f"no camera has an image for {sum(length for _, length in gaps)} periods in "
            f"{len(gaps)} places, the first after frame set {gaps[0][0]}"
        )
        longest, length = max(gaps, key=lambda gap: gap[1])
        if length * period_us > LONG_STEP_US:
            note += (
                f"; after frame set {longest} for {length * period_us / 1e6:.1f} s: unless the "
                "recording was paused, the cameras' common clock was set ahead; set no clock (NTP, "
                "PTP) during a recording"
            )
        return [note]


def synchronise(
    times_us: Sequence[np.ndarray], *, period_us: float, max_skew_us: float, master: int
) -> SetTable:
    """Group the images of C cameras into sets.

    Each image of the master makes a set. Images of other cameras that are more than ``NEW_SET_GAP``
    periods away from these sets make further sets: images within ``max_skew_us`` of the earliest
    one share a set at their median time. An image joins the nearest set if it is within
    ``max_skew_us`` and no other image of its camera is nearer.

    Args:
        times_us: device times (N_c,) int64 of each camera's images, microseconds of one clock, in
            any order; empty for a missing camera.
        period_us: time between images.
        max_skew_us: less than half a period, otherwise ValueError is raised.
        master: index of the master.
    """
    if not 0 <= master < len(times_us):
        raise ValueError(f"master {master} is none of {len(times_us)} cameras")
    if not 0 < max_skew_us < period_us / 2:
        raise ValueError(f"max_skew {max_skew_us} us is not below half of {period_us} us")
    cameras = [np.asarray(t, np.int64) for t in times_us]
    sets = _distinct(np.sort(cameras[master]), NEW_SET_GAP * period_us)
    orphans = np.sort(np.concatenate(cameras))
    orphans = orphans[distance_to(orphans, sets) > NEW_SET_GAP * period_us]
    extra: list[int] = []
    while len(orphans):
        group = orphans[orphans - orphans[0] <= max_skew_us]
        extra.append(int(group[(len(group) - 1) // 2]))  # the median, an actual time
        orphans = orphans[orphans - extra[-1] > NEW_SET_GAP * period_us]
    sets = np.sort(np.concatenate([sets, np.array(extra, np.int64)]))
    index = np.stack([nearest_images(sets, t, max_skew_us) for t in cameras], axis=1)
    skew = np.full(index.shape, np.nan)
    for camera, times in enumerate(cameras):
        has = index[:, camera] >= 0
        skew[has, camera] = times[index[has, camera]] - sets[has]
    counts = np.array([len(t) for t in cameras])
    return SetTable(sets, index, skew, counts - (index >= 0).sum(axis=0))


def nearest_images(sets_us: np.ndarray, times_us: np.ndarray, max_skew_us: float) -> np.ndarray:
    """Position (T,) of each set's image among ``times_us`` (N,); -1 = none.

    Image and set are each other's nearest and at most ``max_skew_us`` apart, so that no image is
    used twice. ``sets_us`` (T,) is increasing.
    """
    index = np.full(len(sets_us), -1, np.int32)
    if not len(sets_us) or not len(times_us):
        return index
    nearest_set = _nearest(times_us, sets_us)
    distance = np.abs(times_us - sets_us[nearest_set])
    order = np.lexsort((np.arange(len(times_us)), distance))[::-1]  # the nearest is written last
    order = order[distance[order] <= max_skew_us]
    index[nearest_set[order]] = order
    return index


def images_of_moments(slip: np.ndarray, available: np.ndarray) -> np.ndarray:
    """The set (T, C) int32 whose image of each camera shows the moment of each set; -1 = none.

    Of two images that show one moment, the result is the one that slipped less.

    Args:
        slip: (T, C) int: the image of set t shows the moment of set t - slip.
        available: (T, C) bool: the set holds an image of the camera.
    """
    shown = np.full(slip.shape, -1, np.int32)
    sets = len(slip)
    for camera in range(slip.shape[1]):
        images = np.flatnonzero(available[:, camera])
        late = slip[images, camera]  # sets by which the image is older than its set's time
        moments = images - late
        order = np.argsort(-np.abs(late), kind="stable")  # the least slip is written last
        order = order[(moments[order] >= 0) & (moments[order] < sets)]
        shown[moments[order], camera] = images[order]
    return shown


def frame_interval(times: np.ndarray) -> float:
    """Usual time between the sets at ``times`` (T,), seconds; a Kinect's for a single set."""
    return float(np.median(np.diff(times))) if len(times) > 1 else 1 / 30


def in_step_sigma(interval: float) -> float:
    """Standard deviation, seconds, of the time offset of an image in its nearest set.

    The distribution is uniform over half an ``interval`` (seconds) before and after the set.
    """
    return interval / np.sqrt(12)


def usual_steps(available: np.ndarray) -> np.ndarray:
    """Median number of sets (C,) from one image of a camera to its next; 1 for fewer than 2 images.

    ``available`` (T, C) bool: the set holds an image of the camera.
    """
    steps = [np.diff(np.flatnonzero(camera)) for camera in available.T]
    return np.array([float(np.median(step)) if len(step) else 1.0 for step in steps])


def _nearest(values: np.ndarray, sorted_targets: np.ndarray) -> np.ndarray:
    """Position of the target nearest to each value; of two equally near ones the first."""
    right = np.clip(np.searchsorted(sorted_targets, values), 1, max(1, len(sorted_targets) - 1))
    if len(sorted_targets) == 1:
        return np.zeros(len(values), np.int64)
    left = right - 1
    nearer_right = sorted_targets[right] - values < values - sorted_targets[left]
    return np.where(nearer_right, right, left)


def distance_to(values: np.ndarray, sorted_targets: np.ndarray) -> np.ndarray:
    """Distance (N,) of each value to the nearest target; inf without targets."""
    if not len(sorted_targets):
        return np.full(len(values), np.inf)
    return np.abs(values - sorted_targets[_nearest(values, sorted_targets)])


def _distinct(sorted_times: np.ndarray, gap: float) -> np.ndarray:
    """Drop repeats: times that follow a kept one by less than ``gap``."""
    kept: list[int] = []
    for time in sorted_times.tolist():
        if not kept or time - kept[-1] >= gap:
            kept.append(time)
    return np.array(kept, np.int64)


OUTLIER = -1  # epoch of a single wrong time


def split_into_epochs(times_us: np.ndarray) -> np.ndarray:
    """Epoch (N,) of each image, from 0: a new one begins where the device's clock was reset.

    ``times_us`` (N,) int64 are device times in the order of recording. An epoch ends where time
    jumps back. If leaving out a single image makes time increase again, that image is an
    ``OUTLIER`` and ends no epoch.
    """
    epoch = np.zeros(len(times_us), np.int64)
    times = times_us.tolist()
    kept: list[int] = []  # images of the current epoch
    number = 0
    for at, time in enumerate(times):
        if kept and time <= times[kept[-1]]:
            later = times[at + 1] if at + 1 < len(times) else None
            if later is not None and later > times[kept[-1]]:
                epoch[at] = OUTLIER
                continue
            if len(kept) > 1 and time > times[kept[-2]]:
                epoch[kept.pop()] = OUTLIER
            else:
                number += 1
                kept = []
        kept.append(at)
        epoch[at] = number
    return epoch


def choose_epoch(
    times_us: np.ndarray, epoch: np.ndarray, reference_us: np.ndarray, within_us: float
) -> int:
    """The epoch that overlaps the other cameras' times; the longest one if none does.

    Only the clock before its reset agrees with the other cameras. Therefore the result is the first
    epoch with at least half as many images near a reference time as any other epoch.

    Args:
        times_us: (N,) device times.
        epoch: (N,) result of :func:`split_into_epochs`.
        reference_us: (M,) increasing times of the other cameras.
        within_us: distance up to which an image is near a reference time.
    """
    near = (distance_to(times_us, reference_us) <= within_us) & (epoch >= 0)
    if not near.any():
        return int(np.argmax(np.bincount(epoch[epoch >= 0])))
    counts = np.bincount(epoch[near])
    return int(np.argmax(counts >= counts.max() * 0.5))


class ClockJump(NamedTuple):
    """A place where a device's clock was set ahead."""

    image: int
    """The first image with the new time."""
    before_us: int
    """Device time of the image before."""
    ahead_us: int
    """Time by which the clock was set ahead."""

    def undo(self, times_us: np.ndarray) -> np.ndarray:
        """Times (N,) of images of the device, in which those after the jump continue the others."""
        later = times_us > self.before_us + self.ahead_us // 2
        return times_us - np.where(later, self.ahead_us, 0)


def find_clock_jumps(
    times_us: np.ndarray, others_us: Sequence[np.ndarray], period_us: float
) -> list[ClockJump]:
    """Jumps ahead of a camera's clock that other cameras' clocks do not make, the latest first.

    A long step is a pause if the images after it agree with the other cameras, and a jump if the
    camera ends later than the others by its length. A step that a camera shares is no evidence
    against that camera, so that a pause of the whole recording is no jump.

    Args:
        times_us: (N,) int64 device times in the order of recording.
        others_us: (N_c,) the same of each other camera.
        period_us: usual time between two images.
    """
    jumps = _long_steps(times_us, period_us)
    reference = [
        times
        for times in others_us
        if not any(
            abs(own.ahead_us - other.ahead_us) < 2 * period_us
            for own in jumps
            for other in _long_steps(times, period_us)
        )
    ]
    if not jumps or not reference:
        return []
    late_us = times_us.max() - max(times.max() for times in reference)
    explained: list[ClockJump] = []
    tolerance = 0.25  # of the jump, by which the ends of the cameras may differ
    for jump in sorted(jumps, key=lambda jump: -jump.ahead_us):
        if late_us > (1 - tolerance) * jump.ahead_us:
            explained.append(jump)
            late_us -= jump.ahead_us
    if late_us > tolerance * sum(jump.ahead_us for jump in explained):
        return []
    return sorted(explained, reverse=True)


def _long_steps(times_us: np.ndarray, period_us: float) -> list[ClockJump]:
    """Each step to the next image that is longer than ``LONG_STEP_US``, as a jump."""
    steps = np.diff(times_us)
    return [
        ClockJump(int(at) + 1, int(times_us[at]), int(steps[at] - period_us))
        for at in np.flatnonzero(steps > LONG_STEP_US)
    ]


def clock_drift_us(times_us: np.ndarray, skew_us: np.ndarray) -> float:
    """Drift of a camera's clock against the sets' times over the recording, microseconds.

    It is the difference between the median skews of the last and the first quarter, extrapolated
    to the whole recording.

    Args:
        times_us: (T,) times of the sets.
        skew_us: (T,) device time minus that of the set; NaN = no image.
    """
    has = np.flatnonzero(np.isfinite(skew_us))
    quarter = len(has) // 4
    if quarter < 2:
        return 0.0
    early, late = has[:quarter], has[-quarter:]
    moved = float(np.median(skew_us[late]) - np.median(skew_us[early]))
    span = float(np.median(times_us[late]) - np.median(times_us[early]))
    return moved * float(times_us[-1] - times_us[0]) / span
