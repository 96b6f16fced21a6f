"""Starts of cameras from the sound that they share: generalised cross-correlation (GCC-PHAT).

Knapp and Carter, IEEE Trans. ASSP 24(4), 1976: the cross-spectrum of two tracks is divided by its
magnitude (phase transform). A broad-band sound then gives one sharp peak at its delay, in spite of
reverberation. Each of several windows of one track is searched for in the whole other track. A
delay is returned only if several windows agree on it, each by a peak that is far above chance and
clearly the highest. Silence, unrelated sounds and repetitive music give no result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy import fft

from intercap_core.formats.recordings.source import SOUND_RATE, Sound

# Standard deviation of one camera's sound against its images. EBU R37 allows the sound of a
# programme to lead by 40 ms and to lag by 60 ms; the deviation of a uniform distribution over this
# range is 29 ms. Sound itself takes 3 ms a metre, about 5 ms within a ring of cameras.
SOUND_SIGMA_S = 0.03


@dataclass(frozen=True)
class Delay:
    """Time of a sound in the second track minus its time in the first."""

    seconds: float
    """Delay; times count from the first image of each track."""
    spread: float
    """Standard deviation over the windows, seconds."""
    windows: int
    """Number of windows that agree."""


def sound_starts(sounds: Sequence[Sound | None]) -> tuple[np.ndarray, np.ndarray]:
    """Starts (C,) of the cameras and their standard deviations (C,), from pairwise delays.

    A start is the time of the first image, seconds on one clock. It is NaN for cameras outside the
    largest group that shares sounds.
    """
    views = len(sounds)
    heard = [(c, sound) for c, sound in enumerate(sounds) if sound is not None]
    delays = {
        (a, b): delay
        for (a, first), (b, second) in combinations(heard, 2)
        if (delay := estimate_delay(first, second)) is not None
    }
    start, sigma = np.full(views, np.nan), np.full(views, np.nan)
    while delays:
        group = _largest_group(delays, views)
        in_group = {pair: delay for pair, delay in delays.items() if pair[0] in group}
        solved = _solved(in_group, group)
        off = {(a, b): abs(solved[a] - solved[b] - d.seconds) for (a, b), d in in_group.items()}
        worst = max(off, key=lambda pair: off[pair])
        if off[worst] > 0.02:  # closure of three cameras' delays, seconds; tuned on the studio
            del delays[worst]
            continue
        spread = {c: max(d.spread for pair, d in in_group.items() if c in pair) for c in group}
        for c in group:
            start[c], sigma[c] = solved[c], np.hypot(SOUND_SIGMA_S, spread[c])
        break
    return start, sigma


def estimate_delay(first: Sound, second: Sound) -> Delay | None:
    """The delay of two tracks; None if it is not certain that they share sounds.

    Up to eight windows of the shorter track are searched for in the longer one. The delay is the
    median of the largest subset of windows that agree.
    """
    short, long = sorted((first, second), key=lambda sound: len(sound.samples))
    # Length of a window: 1 s holds several steps or words; within 10 s two clocks of 100 ppm drift
    # by 1 ms.
    size = min(max(len(short.samples) // 4, SOUND_RATE), 10 * SOUND_RATE)
    last = len(short.samples) - size
    if last < size:  # all windows would overlap, so that their agreement proves nothing
        return None
    places = np.unique(np.linspace(0, last, 8).astype(int))
    nfft = 1 << (len(long.samples) + size - 1).bit_length()  # fast
    whole = fft.rfft(long.samples, nfft)
    lags = [
        lag - place
        for place in places.tolist()
        if (lag := _lag(short.samples[place : place + size], whole, nfft, len(long.samples)))
        is not None
    ]
    agree = _agreeing(np.array(lags) / SOUND_RATE, len(short.samples) / SOUND_RATE)
    if len(agree) < max(3, len(lags) / 2):  # two may agree by chance
        return None
    middle = float(np.median(agree))
    spread = 1.4826 * float(np.median(np.abs(agree - middle)))
    seconds = middle + long.first_s - short.first_s
    return Delay(seconds if short is first else -seconds, spread, len(agree))


def _lag(window: np.ndarray, whole: np.ndarray, nfft: int, count: int) -> int | None:
    """Shift, samples, of a window (n,) in a track of ``count`` samples with spectrum ``whole``.

    None if no shift has a peak that is far above chance and clearly the highest.
    """
    cross = whole * np.conj(fft.rfft(window * np.hanning(len(window)), nfft))
    size = np.abs(cross)
    hz = fft.rfftfreq(nfft, 1 / SOUND_RATE)
    # Above hum and handling noise, below the edge of the resampler's filter.
    heard = (hz > 150.0) & (hz < 3500.0) & (size > 0)
    if not heard.any():
        return None
    white = np.zeros_like(cross)
    white[heard] = cross[heard] / size[heard]
    power = fft.irfft(white, nfft) ** 2
    smooth = round(0.001 * SOUND_RATE)  # the drift of two clocks of 100 ppm within 10 s
    # Also lags at which the window lies only partly within the other track.
    power = np.roll(power, len(window) - 1)[: count + len(window) - 1]
    power = np.convolve(power, np.ones(smooth) / smooth, mode="same")
    best = int(power.argmax())
    near = round(0.03 * SOUND_RATE)  # first echoes of a room: a detour of 10 m
    others = np.concatenate([power[: max(0, best - near)], power[best + near + 1 :]])
    # In unrelated noise (chi square), a mean over eight samples exceeds eight times the average at
    # one of 1e10 delays. The factor to the next highest peak is tuned on the studio.
    if not len(others) or power[best] < 8.0 * others.mean() or power[best] < 1.5 * others.max():
        return None
    return best - (len(window) - 1)


def _agreeing(delays: np.ndarray, seconds: float) -> np.ndarray:
    """The largest subset of ``delays`` (N,) that agree; ``seconds`` is the track's length."""
    if not len(delays):
        return delays
    near = np.abs(delays[:, None] - delays) <= 0.01 + 1e-4 * seconds  # clocks drift by 100 ppm
    return delays[near[near.sum(1).argmax()]]


def _largest_group(delays: dict[tuple[int, int], Delay], views: int) -> list[int]:
    """The largest group of cameras that delays connect; of equal ones that of the first camera."""
    from scipy.sparse.csgraph import connected_components  # slow import, for recordings with sound

    shared = np.zeros((views, views), bool)
    for pair in delays:
        shared[pair] = True
    group = connected_components(shared, directed=False)[1]  # numbered from the first camera on
    return np.flatnonzero(group == np.bincount(group).argmax()).tolist()


def _solved(delays: dict[tuple[int, int], Delay], group: list[int]) -> dict[int, float]:
    """Starts, seconds, of a ``group``'s cameras by least squares; that of the first is 0.

    A sound comes earlier in the track of a camera that starts later.
    """
    place = {c: i for i, c in enumerate(group)}
    rows = np.zeros((len(delays) + 1, len(group)))
    values = np.zeros(len(delays) + 1)
    for row, ((a, b), delay) in enumerate(delays.items()):
        rows[row, place[a]], rows[row, place[b]] = 1.0, -1.0
        values[row] = delay.seconds
    rows[-1, 0] = 1.0
    solved = np.linalg.lstsq(rows, values, rcond=None)[0]
    return dict(zip(group, (solved - solved[0]).tolist(), strict=True))
