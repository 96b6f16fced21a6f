"""When cameras started, from the sound that they share: generalised cross-correlation.

Knapp and Carter, IEEE Trans. ASSP 24(4), 1976: the cross-spectrum of two tracks is divided by its
size (phase transform), so that a broad-band sound gives one sharp peak at its delay, in spite of
reverberation. Windows of one track are each sought in the whole of the other; only where several
find the same delay, each by a peak far above chance and clearly the best, is anything said.
Silence, unrelated sounds and music that repeats itself say nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import fft

from intercap_core.formats.recordings.source import SOUND_RATE, Sound

BAND_HZ = (150.0, 3500.0)  # above hum and handling, below the resampler's edge
WINDOWS = 8  # of a track, evenly over it
WINDOW_S = (1.0, 10.0)  # least and most; a quarter of the track between
FEWEST_WINDOWS = 3
# Power of the correlation is summed over a millisecond: clocks of 100 ppm drift by as much in 10 s.
SMOOTHED_S = 0.001
# Above the mean power: of unrelated noise the sum over eight samples (chi square) exceeds it by
# chance once in 1e10 delays.
LEAST_PEAK = 8.0
CLEAR_PEAK = 1.5  # times the next best power that is not near; tuned on the studio's rooms
NEAR_S = 0.03  # a room's first echoes: 10 m of detour
AGREE_S, DRIFT = 0.01, 1e-4  # windows agree within this, and two clocks' drift over the track
LOOP_S = 0.02  # by which the delays of three cameras may not add up
# Of one camera's sound against its images, one standard deviation. EBU R37 allows a programme's
# sound to lead by 40 ms and to lag by 60 (an even spread's deviation is 29 ms); recorders are made
# to such bounds, and none says more. Sound itself takes 3 ms a metre, some 5 ms within a ring.
SOUND_SIGMA_S = 0.03


@dataclass(frozen=True)
class Delay:
    """A sound is heard ``seconds`` later in the second track than in the first, each counted from
    its first image; ``spread`` s, a standard deviation, over the ``windows`` that agree."""

    seconds: float
    spread: float
    windows: int


def sound_starts(sounds: Sequence[Sound | None]) -> tuple[np.ndarray, np.ndarray]:
    """When cameras took their first images, seconds on one clock, and the standard deviations (C,),
    NaN where the sound says nothing: of the largest group of cameras that share sounds."""
    views = len(sounds)
    delays: dict[tuple[int, int], Delay] = {}
    for a, b in combinations(range(views), 2):
        first, second = sounds[a], sounds[b]
        if first is not None and second is not None:
            found = delay_between(first, second)
            if found is not None:
                delays[a, b] = found
    start, sigma = np.full(views, np.nan), np.full(views, np.nan)
    while delays:
        group = _largest_group(delays, views)
        own = {pair: delay for pair, delay in delays.items() if pair[0] in group}
        solved = _solved(own, group)
        off = {(a, b): abs(solved[a] - solved[b] - d.seconds) for (a, b), d in own.items()}
        worst = max(off, key=lambda pair: off[pair])
        if off[worst] > LOOP_S:
            del delays[worst]
            continue
        spread = {c: max(d.spread for pair, d in own.items() if c in pair) for c in group}
        for c in group:
            start[c], sigma[c] = solved[c], np.hypot(SOUND_SIGMA_S, spread[c])
        break
    return start, sigma


def delay_between(first: Sound, second: Sound) -> Delay | None:
    """The delay of two tracks; None where they do not surely share sounds."""
    short, long = sorted((first, second), key=lambda sound: len(sound.samples))
    least, most = (round(s * SOUND_RATE) for s in WINDOW_S)
    size = min(max(len(short.samples) // 4, least), most)
    last = len(short.samples) - size
    if last < size:  # less than two windows: nothing could disagree
        return None
    places = np.unique(np.linspace(0, last, WINDOWS).astype(int))
    nfft = fft.next_fast_len(len(long.samples) + size, real=True)
    whole = fft.rfft(long.samples, nfft)
    lags = [
        lag - place
        for place in places.tolist()
        if (lag := _lag(short.samples[place : place + size], whole, nfft, len(long.samples)))
        is not None
    ]
    agree = _agreeing(np.array(lags) / SOUND_RATE, len(short.samples) / SOUND_RATE)
    if len(agree) < max(FEWEST_WINDOWS, len(lags) / 2):
        return None
    middle = float(np.median(agree))
    spread = 1.4826 * float(np.median(np.abs(agree - middle)))
    seconds = middle + long.first_s - short.first_s
    return Delay(seconds if short is first else -seconds, spread, len(agree))


def _lag(window: np.ndarray, whole: np.ndarray, nfft: int, count: int) -> int | None:
    """Samples by which a window (n,) is best shifted to lie on a track of ``count`` samples with
    the spectrum ``whole``; None where no shift is far above chance and clearly the best."""
    cross = whole * np.conj(fft.rfft(window * np.hanning(len(window)), nfft))
    size = np.abs(cross)
    hz = fft.rfftfreq(nfft, 1 / SOUND_RATE)
    heard = (hz > BAND_HZ[0]) & (hz < BAND_HZ[1]) & (size > 0)
    if not heard.any():
        return None
    white = np.zeros_like(cross)
    white[heard] = cross[heard] / size[heard]
    power = fft.irfft(white, nfft) ** 2
    smooth = round(SMOOTHED_S * SOUND_RATE)
    # lags at which the window is not wholly within the other track are tried as well
    power = np.roll(power, len(window) - 1)[: count + len(window) - 1]
    power = np.convolve(power, np.ones(smooth) / smooth, mode="same")
    best = int(power.argmax())
    near = round(NEAR_S * SOUND_RATE)
    others = np.concatenate([power[: max(0, best - near)], power[best + near + 1 :]])
    if not len(others) or power[best] < LEAST_PEAK * others.mean():
        return None
    if power[best] < CLEAR_PEAK * others.max():
        return None
    return best - (len(window) - 1)


def _agreeing(delays: np.ndarray, seconds: float) -> np.ndarray:
    """The most of ``delays`` (N,) s that are near one of them, in a track of so many seconds."""
    if not len(delays):
        return delays
    near = np.abs(delays[:, None] - delays) <= AGREE_S + DRIFT * seconds
    return delays[near[near.sum(1).argmax()]]


def _largest_group(delays: dict[tuple[int, int], Delay], views: int) -> list[int]:
    """The most cameras that delays join; of equals those of the first camera."""
    group = list(range(views))
    for _ in range(views):  # the least number travels along the pairs
        for a, b in delays:
            group[a] = group[b] = min(group[a], group[b])
    most = max(group, key=lambda g: (group.count(g), -g))
    return [c for c in range(views) if group[c] == most]


def _solved(delays: dict[tuple[int, int], Delay], group: list[int]) -> dict[int, float]:
    """Starts of a ``group``'s cameras by least squares, the first one's 0: the sound of a camera
    that starts later comes earlier in its track."""
    place = {c: i for i, c in enumerate(group)}
    rows = np.zeros((len(delays) + 1, len(group)))
    values = np.zeros(len(delays) + 1)
    for row, ((a, b), delay) in enumerate(delays.items()):
        rows[row, place[a]], rows[row, place[b]] = 1.0, -1.0
        values[row] = delay.seconds
    rows[-1, 0] = 1.0
    solved = np.linalg.lstsq(rows, values, rcond=None)[0]
    return dict(zip(group, (solved - solved[0]).tolist(), strict=True))
