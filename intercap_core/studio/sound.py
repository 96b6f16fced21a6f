"""What a camera's microphone hears of a capture: steps and a voice, the room, its own noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from intercap_core.geometry.camera.transforms import invert
from intercap_core.studio.capture_folder import SOUND_RATE as RATE
from intercap_core.studio.stage import Stage

SPEED_M_S = 343.0
BEFORE_S = 3.0  # sounds begin before the first set, and last beyond the last
STEP_EVERY_S, STEP_S = (0.4, 0.8), 0.05
SYLLABLE_EVERY_S, SYLLABLE_S = (0.15, 0.6), (0.08, 0.25)
VOICE_HZ = (250.0, 3000.0)
MOUTH_M = 0.6  # above the pelvis
REVERBERATION_S = (0.25, 0.6)  # until it has fallen by 60 dB; of a room with furniture, or bare
ROOM_LEVEL = (0.5, 1.2)  # of the reverberation's energy beside the direct sound's
NOISE_DB = (5.0, 20.0)  # of the sound over the device's own noise
MAX_LATENCY_S = 0.04  # of a device's sound against its images, to either side
LOUDEST = 0.5


@dataclass(frozen=True)
class _Event:
    time_s: float
    samples: np.ndarray
    place: np.ndarray


def heard(stage: Stage, index: int, first_s: float, seconds: float) -> np.ndarray:
    """Samples (N,) float32 at :data:`.SOUND_RATE` of camera ``index``, ``seconds`` long from the
    true time ``first_s`` on, as the device lays them beside its images."""
    rng = stage.noise.rng("microphone", stage.rig.true.names[index])
    eye = (invert(stage.rig.master_from_stage) @ stage.rig.true[index].master_from_colour)[:3, 3]
    latency = rng.uniform(-MAX_LATENCY_S, MAX_LATENCY_S) * min(1.0, stage.noise.scale)
    count = round(seconds * RATE)
    lead = round(max(REVERBERATION_S) * RATE)  # what was said before still sounds
    direct = np.zeros(lead + count)
    for event in _events(stage):
        far = max(0.3, float(np.linalg.norm(event.place - eye)))
        start = lead + round((event.time_s + far / SPEED_M_S + latency - first_s) * RATE)
        there = slice(max(0, start), max(0, min(len(direct), start + len(event.samples))))
        if there.start < there.stop:
            direct[there] += event.samples[there.start - start : there.stop - start] / far
    sound = signal.fftconvolve(direct, _room(stage, rng))[lead : lead + count]
    power = float((sound**2).mean())
    noise = np.sqrt(power * 10 ** (-rng.uniform(*NOISE_DB) / 10)) if power > 0 else 1e-4
    sound += rng.normal(0, noise, count)
    return (LOUDEST * sound / max(np.abs(sound).max(initial=0.0), 1e-9)).astype(np.float32)


def _room(stage: Stage, rng: np.random.Generator) -> np.ndarray:
    """The room's answer to a click, between this device and somebody in the middle."""
    fall = stage.noise.rng("reverberation").uniform(*REVERBERATION_S)
    times = np.arange(round(fall * RATE)) / RATE
    tail = rng.normal(size=len(times)) * 10 ** (-3 * times / fall)
    tail[: round(0.002 * RATE)] = 0
    tail *= np.sqrt(rng.uniform(*ROOM_LEVEL) / (tail**2).sum())
    tail[0] = 1.0
    return tail


def _events(stage: Stage) -> list[_Event]:
    """The same for every camera: steps on the floor below the person, syllables at the mouth."""
    rng = stage.noise.rng("sound")
    played = stage.interaction.perform(
        stage.interaction.script_times(stage.set_times, stage.duration)
    )
    place = stage.stage_from_script
    pelvis = played.pelvis @ place[:3, :3].T + place[:3, 3]

    def person(time_s: float) -> np.ndarray:
        return np.array([np.interp(time_s, stage.set_times, axis) for axis in pelvis.T])

    events, end = [], stage.duration + BEFORE_S
    time_s = -BEFORE_S
    while (time_s := time_s + rng.uniform(*STEP_EVERY_S)) < end:
        count = round(STEP_S * RATE)
        burst = rng.normal(size=count) * np.exp(-np.arange(count) / (0.2 * count))
        events.append(
            _Event(time_s, rng.uniform(0.3, 1.0) * burst, person(time_s) * np.array([1, 1, 0]))
        )
    voice = signal.butter(2, VOICE_HZ, "bandpass", fs=RATE, output="sos")
    time_s = -BEFORE_S
    while (time_s := time_s + rng.uniform(*SYLLABLE_EVERY_S)) < end:
        count = round(rng.uniform(*SYLLABLE_S) * RATE)
        syllable = signal.sosfilt(voice, rng.normal(size=count)) * np.hanning(count)
        mouth = person(time_s) + np.array([0, 0, MOUTH_M])
        events.append(_Event(time_s, rng.uniform(0.3, 1.0) * syllable, mouth))
    return events
