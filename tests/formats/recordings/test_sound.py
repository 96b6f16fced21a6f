"""The sound of videos, and when cameras started by it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import signal

from intercap_core import artefacts
from intercap_core.config import FramesSettings
from intercap_core.formats.recordings.containers import read_sound
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.sound_delays import (
    SOUND_SIGMA_S,
    estimate_delay,
    sound_starts,
)
from intercap_core.formats.recordings.source import SOUND_RATE, Sound
from intercap_core.schemas import FRAMES
from intercap_core.stages import frames
from tests.helpers.plain_capture import plain_entry, write_rig
from tests.helpers.videos import SOUND_HZ, write_video

FPS, SIZE = 10, (96, 64)


def noise(seed: int, seconds: float) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 0.2, round(seconds * SOUND_RATE))


def track(samples: np.ndarray, first_s: float = 0.0) -> Sound:
    return Sound(samples.astype(np.float32), first_s)


def room(seed: int, samples: np.ndarray) -> np.ndarray:
    """With as much reverberation over 0.4 s as there is direct sound, and noise half as loud."""
    rng = np.random.default_rng(seed)
    times = np.arange(round(0.4 * SOUND_RATE)) / SOUND_RATE
    tail = rng.normal(size=len(times)) * 10 ** (-3 * times / 0.4)
    tail[:20] = 0
    tail /= np.sqrt((tail**2).sum())
    tail[0] = 1
    heard = signal.fftconvolve(samples, tail)[: len(samples)]
    return heard + rng.normal(0, 0.5 * heard.std() + 1e-6, len(samples))


def steps(seed: int, seconds: float, every_s: float = 0.55) -> np.ndarray:
    """Short bursts, each of its own noise, at uneven times."""
    rng = np.random.default_rng(seed)
    sound = np.zeros(round(seconds * SOUND_RATE))
    for time_s in np.arange(0.1, seconds - 0.2, every_s):
        burst = rng.normal(size=400) * np.exp(-np.arange(400) / 80)
        at = round((time_s + rng.uniform(0, 0.1)) * SOUND_RATE)
        sound[at : at + 400] += burst
    return sound


@pytest.mark.parametrize("late", [0, 1, 1234, -1234, 8000])
def test_a_track_that_is_shifted_by_whole_samples(late):
    """Worked by hand: the second track is the first one, so many samples later."""
    sound = noise(1, 6.0)
    first = track(sound[10_000:40_000])
    second = track(sound[10_000 - late : 40_000 - late], 0.25)  # and began 0.25 s after its images
    found = estimate_delay(first, second)
    assert found is not None and found.windows >= 3 and found.spread < 1e-4
    assert found.seconds == pytest.approx(late / SOUND_RATE + 0.25, abs=0.0003)
    back = estimate_delay(second, first)
    assert back is not None and back.seconds == pytest.approx(-found.seconds, abs=0.0003)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("seconds", [3.0, 8.0])
def test_steps_in_a_room_with_noise(seed, seconds):
    late = np.random.default_rng(seed).uniform(-1, 1)
    sound = steps(seed, seconds + 2.5)
    begin = round(1.2 * SOUND_RATE)
    count, shift = round(seconds * SOUND_RATE), round(late * SOUND_RATE)
    first = track(room(10 + seed, sound)[begin : begin + count])
    second = track(-room(20 + seed, sound)[begin - shift : begin - shift + count])  # other polarity
    found = estimate_delay(first, second)
    assert found is not None
    assert found.seconds == pytest.approx(shift / SOUND_RATE, abs=0.002)


def hum(seconds: float) -> np.ndarray:
    times = np.arange(round(seconds * SOUND_RATE)) / SOUND_RATE
    return np.array([np.sin(2 * np.pi * 50 * k * times + k) / k for k in range(1, 20)]).sum(0)


def beat(seconds: float) -> np.ndarray:
    """The same click twice a second."""
    click = np.random.default_rng(3).normal(size=200) * np.exp(-np.arange(200) / 40)
    sound = np.zeros(round(seconds * SOUND_RATE))
    for at in range(500, len(sound) - 200, SOUND_RATE // 2):
        sound[at : at + 200] += click
    return sound


@pytest.mark.parametrize(
    "pair",
    [
        lambda: (np.zeros(40_000), np.zeros(40_000)),
        lambda: (np.zeros(40_000), noise(1, 5)),
        lambda: (noise(1, 5), noise(2, 5)),
        lambda: (room(1, steps(1, 8)), room(2, steps(2, 8))),
        lambda: (room(1, hum(5)), room(2, hum(5))),
        lambda: (room(1, beat(8)), room(2, beat(8))),
        lambda: (noise(1, 5)[:10_000], noise(1, 5)),
        lambda: (np.zeros(0), noise(1, 5)),
    ],
    ids=["silence", "one silent", "unrelated", "other steps", "hum", "beat", "short", "empty"],
)
def test_no_delay_without_a_clear_common_sound(pair: Callable[[], tuple[np.ndarray, np.ndarray]]):
    first, second = pair()
    assert estimate_delay(track(first), track(second)) is None


def test_starts_of_several_cameras():
    """Camera 1 starts 0.5 s after camera 0, camera 3 0.7 s before; 2 has no sound, 4 another's."""
    sound, started = steps(4, 9.0), [0.0, 0.5, 0.0, -0.7, 0.0]
    tracks: list[Sound | None] = []
    for c, start in enumerate(started):
        own = room(c, steps(99, 9.0) if c == 4 else sound)
        begin = round((1.0 + start) * SOUND_RATE)
        tracks.append(None if c == 2 else track(own[begin : begin + 6 * SOUND_RATE]))
    start, sigma = sound_starts(tracks)
    np.testing.assert_allclose(start, [0, 0.5, np.nan, -0.7, np.nan], atol=0.002)
    np.testing.assert_allclose(sigma[[0, 1, 3]], SOUND_SIGMA_S, rtol=0.05)
    assert np.isnan(sigma[[2, 4]]).all()
    assert np.isnan(sound_starts([None, None])[0]).all()
    assert np.isnan(sound_starts([tracks[0], tracks[4]])[0]).all()


def write_grey(path: Path, samples: np.ndarray | None, **options: Any) -> None:
    """Two seconds and more of grey images, with the sound ``samples`` if they are given."""
    begins = options.get("sound_from_s", 0.0)
    seconds = 2.0 if samples is None else max(2.0, len(samples) / SOUND_HZ + begins)
    shades = range(9 * len(path.stem), 9 * len(path.stem) + round(seconds * FPS))
    images = (np.full((SIZE[1], SIZE[0], 3), shade, np.uint8) for shade in shades)
    write_video(path, images, fps=FPS, sound=samples, **options)


@pytest.mark.parametrize(
    ("name", "codec"), [("a.mp4", "aac"), ("a.mov", "pcm_s16le"), ("a.mkv", "flac")]
)
@pytest.mark.parametrize("begins", [0.0, 0.6])
def test_sound_and_images_share_a_clock(tmp_path, name, codec, begins):
    """A click 1 s into the sound."""
    samples = np.random.default_rng(1).normal(0, 1e-4, 48_000)
    samples[16_000:16_080] = 0.8 * np.sin(np.arange(80))
    write_grey(tmp_path / name, samples, sound_codec=codec, sound_from_s=begins)
    sound = read_sound(tmp_path / name, 0.0)
    assert sound is not None and sound.samples.dtype == np.float32
    assert len(sound.samples) == pytest.approx(3 * SOUND_RATE, abs=1100)
    click = sound.first_s + np.abs(sound.samples).argmax() / SOUND_RATE
    assert click == pytest.approx(begins + 1.0, abs=0.01)
    later = read_sound(tmp_path / name, 0.25)
    assert later is not None and later.first_s == pytest.approx(sound.first_s - 0.25)


def test_files_without_sound(tmp_path):
    write_grey(tmp_path / "quiet.mp4", None)
    assert read_sound(tmp_path / "quiet.mp4", 0.0) is None
    (tmp_path / "none.mp4").write_bytes(b"no video")
    assert read_sound(tmp_path / "none.mp4", 0.0) is None
    assert read_sound(tmp_path / "missing.mp4", 0.0) is None


def test_frames_hold_the_starts_by_sound(tmp_path):
    """The right one was started 0.7 s after the left one."""
    write_rig(tmp_path, SIZE, 60.0)
    sound = signal.resample_poly(steps(4, 6.0), 2, 1)
    folder = tmp_path / "recordings"
    for name, start in (("left", 0.0), ("right", 0.7)):
        (folder / name).rmdir()
        begin = round((0.4 + start) * 16_000)
        write_grey(folder / f"{name}.mp4", 0.3 * sound[begin : begin + 64_000])
    row = plain_entry(tmp_path)
    frames.run(sequence=row, output=tmp_path / "frames.h5", settings=FramesSettings())
    with Frames.open(tmp_path / "frames.h5") as source:
        heard, first = source.sound_starts, source.first_image_s
    assert heard["left"] == (0.0, pytest.approx(SOUND_SIGMA_S, rel=0.05))
    assert heard["right"][0] == pytest.approx(0.7, abs=0.002)
    np.testing.assert_allclose(first, 0, atol=1e-6)
    before = (tmp_path / "frames.h5").read_bytes()
    frames.run(sequence=row, output=tmp_path / "frames.h5", settings=FramesSettings())
    assert (tmp_path / "frames.h5").read_bytes() == before


def test_first_images_are_on_the_clock_of_the_sets(tmp_path):
    """Silent videos with files of times; the right camera's first image is 0.3 s later."""
    write_rig(tmp_path, SIZE, 60.0)
    for name, first in (("left", 5.0), ("right", 5.3)):
        (tmp_path / "recordings" / name).rmdir()
        path = tmp_path / "recordings" / f"{name}.mp4"
        write_grey(path, None)
        times = [f"{first + n / FPS:.6f}\n" for n in range(20)]
        path.with_name(f"{name}_timestamps.csv").write_text("".join(times))
    frames.run(
        sequence=plain_entry(tmp_path), output=tmp_path / "frames.h5", settings=FramesSettings()
    )
    with Frames.open(tmp_path / "frames.h5") as source:
        np.testing.assert_allclose(source.first_image_s, [0.0, 0.3], atol=1e-6)
        assert source.sound_starts == {}
    with artefacts.read(tmp_path / "frames.h5", FRAMES) as artefact:
        assert "sound_start" not in artefact
