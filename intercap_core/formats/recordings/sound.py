"""The sound track of a video file: one channel at a low rate, on the clock of its images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np

from intercap_core.formats.recordings.containers import LATEST_US, open_container
from intercap_core.inputs.files import Unreadable

SOUND_RATE = 8000  # samples a second: telephony's, steps and voices are within 4 kHz
MAX_SOUND_S = 600.0  # that are read: 19 MB a camera
JUMP_S = 0.05  # by which a packet's time differs from the samples before it: a gap


@dataclass(frozen=True, eq=False)
class Sound:
    """``samples`` (N,) float32 at :data:`SOUND_RATE`; the first one was recorded ``first_s``
    seconds after the first image, by the file's own clock."""

    samples: np.ndarray
    first_s: float


def read_sound(path: Path, first_image_s: float) -> Sound | None:
    """Read a video's first sound track; None where it has none that can be decoded.

    ``first_image_s`` is the time of the first image on the file's clock. Damaged packets are left
    out, as gaps.
    """
    parts: list[np.ndarray] = []
    start: float | None = None
    count = 0
    for time_s, samples in _pieces(path):
        if start is None:
            start = time_s
        gap = round((time_s - start) * SOUND_RATE) - count
        if gap > JUMP_S * SOUND_RATE:
            if count + gap > MAX_SOUND_S * SOUND_RATE:
                break
            parts.append(np.zeros(gap, np.float32))
            count += gap
        parts.append(samples)
        count += len(samples)
        if count >= MAX_SOUND_S * SOUND_RATE:
            break
    if start is None or not count:
        return None
    return Sound(np.concatenate(parts), start - first_image_s)


def _pieces(path: Path) -> Iterator[tuple[float, np.ndarray]]:
    """Times on the file's clock and samples (n,), as they are decoded."""
    try:
        container = open_container(path)
    except (Unreadable, av.error.FFmpegError, OSError):
        return
    with container:
        streams: Any = container.streams.audio
        if not streams or streams[0].codec_context is None:
            return
        resampler = av.AudioResampler(format="flt", layout="mono", rate=SOUND_RATE)
        after = 0.0
        for frame in _frames(container, streams[0]):
            after = frame.time if frame.time is not None else after
            if not frame.sample_rate or not abs(after) < LATEST_US * 1e-6:
                continue
            time_s, after = after, after + frame.samples / frame.sample_rate
            try:
                for made in resampler.resample(frame):
                    yield time_s, made.to_ndarray().ravel().astype(np.float32)
            except (av.error.FFmpegError, ValueError):
                continue


def _frames(container: Any, stream: Any) -> Iterator[Any]:
    demuxed = container.demux(stream)
    while True:
        try:
            packet = next(demuxed)
        except (StopIteration, av.error.FFmpegError, OSError):
            return
        try:
            yield from packet.decode()
        except (av.error.FFmpegError, OSError):
            continue
