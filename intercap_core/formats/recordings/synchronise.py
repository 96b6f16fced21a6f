"""Sets of images taken at one moment by several cameras, found by device time alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

NEW_SET_GAP = 0.6  # of a period: an image this far from every set starts one of its own


@dataclass(frozen=True)
class SetTable:
    """Which image of each camera belongs to each of T sets.

    ``times_us`` (T,) int64 increasing, the master's device time or, where it has no image, that of
    the others; ``index`` (T, C) int32 into each camera's images, -1 = none; ``skew_us`` (T, C)
    float64, image time minus set time, NaN = none; ``unmatched`` (C,) images in no set.
    """

    times_us: np.ndarray
    index: np.ndarray
    skew_us: np.ndarray
    unmatched: np.ndarray

    def gaps(self, period_us: float) -> list[tuple[int, int]]:
        """Where time runs on without any image: (set before the gap, number of sets missing)."""
        steps = np.rint(np.diff(self.times_us) / period_us).astype(int)
        return [(int(at), int(steps[at]) - 1) for at in np.flatnonzero(steps > 1)]


def synchronise(
    times_us: Sequence[np.ndarray], *, period_us: float, max_skew_us: float, master: int
) -> SetTable:
    """Group the images of C cameras into sets.

    ``times_us``: for each camera the device times (N_c,) int64 of its images, microseconds of one
    common clock, in any order, empty for a missing camera. The master's images each make a set;
    where it has none (more than ``NEW_SET_GAP`` periods to the next set) the other cameras' do.
    An image joins the nearest set if it is within ``max_skew_us`` and no image of its camera is
    nearer. Raises ValueError unless 0 <= master < C and max_skew_us < period_us / 2.
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
    """Return for each set (T,) the position of its image among ``times_us`` (N,), -1 = none.

    Image and set are each other's nearest and at most ``max_skew_us`` apart, so that no image is
    used twice. ``sets_us`` is increasing.
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
    """Return the set (T, C) int32 whose image of each camera shows the moment of each set.

    ``slip`` (T, C): the image of set t shows the moment of set t - slip; ``available`` (T, C): the
    set holds an image of the camera. Where two images show one moment, the one that slipped less
    is taken; -1 = none does.
    """
    shown = np.full(slip.shape, -1, np.int32)
    sets = len(slip)
    for camera in range(slip.shape[1]):
        images = np.flatnonzero(available[:, camera])
        late = slip[images, camera]
        moments = images - late
        order = np.argsort(-np.abs(late), kind="stable")  # what slipped least is written last
        order = order[(moments[order] >= 0) & (moments[order] < sets)]
        shown[moments[order], camera] = images[order]
    return shown


def usual_steps(available: np.ndarray) -> np.ndarray:
    """Sets (C,) from one image of a camera to its next, usually; 1 for a camera with fewer than 2.

    ``available`` (T, C): the set holds an image of the camera.
    """
    steps = [np.diff(np.flatnonzero(camera)) for camera in available.T]
    return np.array([float(np.median(step)) if len(step) else 1.0 for step in steps])


def _nearest(values: np.ndarray, sorted_targets: np.ndarray) -> np.ndarray:
    """Return the position of the target nearest to each value; of two equally near the first."""
    right = np.clip(np.searchsorted(sorted_targets, values), 1, max(1, len(sorted_targets) - 1))
    if len(sorted_targets) == 1:
        return np.zeros(len(values), np.int64)
    left = right - 1
    nearer_right = sorted_targets[right] - values < values - sorted_targets[left]
    return np.where(nearer_right, right, left)


def distance_to(values: np.ndarray, sorted_targets: np.ndarray) -> np.ndarray:
    """Return how far each value (N,) is from the nearest target; inf where there is none."""
    if not len(sorted_targets):
        return np.full(len(values), np.inf)
    return np.abs(values - sorted_targets[_nearest(values, sorted_targets)])


def _distinct(sorted_times: np.ndarray, gap: float) -> np.ndarray:
    """Drop times that follow a kept one by less than ``gap``: repeats of one image."""
    kept: list[int] = []
    for time in sorted_times.tolist():
        if not kept or time - kept[-1] >= gap:
            kept.append(time)
    return np.array(kept, np.int64)


OUTLIER = -1
EARLIER_IS_ENOUGH = 0.5  # of the images of the fullest stretch


def split_into_epochs(times_us: np.ndarray) -> np.ndarray:
    """Return for each image (N,) the stretch of running time that it belongs to, from 0.

    ``times_us`` (N,) int64 are device times in the order of recording. Where time jumps back, a
    stretch ends and the next begins (the device's clock was reset). A single time that its
    neighbours on both sides contradict is ``OUTLIER`` and ends nothing.
    """
    stretch = np.zeros(len(times_us), np.int64)
    times = times_us.tolist()
    kept: list[int] = []  # of the current stretch
    number = 0
    for at, time in enumerate(times):
        if kept and time <= times[kept[-1]]:
            later = times[at + 1] if at + 1 < len(times) else None
            if later is not None and later > times[kept[-1]]:
                stretch[at] = OUTLIER
                continue
            if len(kept) > 1 and time > times[kept[-2]]:
                stretch[kept.pop()] = OUTLIER
            else:
                number += 1
                kept = []
        kept.append(at)
        stretch[at] = number
    return stretch


def choose_epoch(
    times_us: np.ndarray, stretch: np.ndarray, reference_us: np.ndarray, within_us: float
) -> int:
    """Return the stretch that overlaps the others' times; the longest where none does.

    ``stretch`` (N,) is what :func:`split_into_epochs` says of ``times_us`` (N,); ``reference_us``
    (M,) are
    increasing times of the others. A reset takes a clock out of step with them, so that of several
    stretches among their times the earlier is right: the first one with at least half as many
    images near a reference time as any other.
    """
    near = (distance_to(times_us, reference_us) <= within_us) & (stretch >= 0)
    if not near.any():
        return int(np.argmax(np.bincount(stretch[stretch >= 0])))
    counts = np.bincount(stretch[near])
    return int(np.argmax(counts >= counts.max() * EARLIER_IS_ENOUGH))


def clock_drift_us(times_us: np.ndarray, skew_us: np.ndarray) -> float:
    """Return by how much a clock ran away from the sets' over the recording, microseconds.

    ``skew_us`` (T,) is device time minus the set's at ``times_us`` (T,), NaN = no image; the
    difference between the medians of the last and the first quarter, stretched to the whole.
    """
    has = np.flatnonzero(np.isfinite(skew_us))
    quarter = len(has) // 4
    if quarter < 2:
        return 0.0
    early, late = has[:quarter], has[-quarter:]
    moved = float(np.median(skew_us[late]) - np.median(skew_us[early]))
    span = float(np.median(times_us[late]) - np.median(times_us[early]))
    return moved * float(times_us[-1] - times_us[0]) / span
