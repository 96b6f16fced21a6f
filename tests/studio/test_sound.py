"""Sound of the studio's videos."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.formats.recordings.sound_delays import sound_starts
from intercap_core.formats.recordings.source import SOUND_RATE, Sound
from intercap_core.studio.capture_folder import SOUND_RATE as STUDIO_RATE
from intercap_core.studio.sensors import MAX_LATENCY_S, heard
from intercap_core.studio.stage import StudioStage

SECONDS = 3.0
TRAVEL_S = 0.012  # between two places of the ring: 4 m


def stage_of(seed: int, apart: float = 0.9) -> StudioStage:
    capture = StudioCapture(
        interaction="walk_and_wave", subject="s03", seed=seed, frames=90, starts_apart=apart,
        layout="plain", depth=False, video=True, sound=True,
    )  # fmt: skip
    settings = StudioSettings.model_validate(
        {"captures": {}, "fps": 30, "colour_mode": "720P", "cameras": 4}
    )
    return StudioStage(capture, settings, None)


def listened(samples: np.ndarray) -> Sound:
    low = signal.resample_poly(samples, SOUND_RATE, STUDIO_RATE)
    return Sound(low.astype(np.float32), 0.0)


@pytest.mark.parametrize("seed", [7911, 7912])
def test_sound_yields_the_cameras_start_times(seed):
    """Within what devices' delays and the way of the sound explain."""
    stage = stage_of(seed)
    tracks = [heard(stage, c, -late, SECONDS) for c, late in enumerate(stage.rig.late_s)]
    assert all(track.dtype == np.float32 and np.abs(track).max() <= 0.5 for track in tracks)
    start, sigma = sound_starts([listened(track) for track in tracks])
    errors = (start - start[0]) + stage.rig.late_s
    assert np.isfinite(start).all() and (sigma < 0.035).all()
    assert np.abs(errors).max() < 2 * MAX_LATENCY_S + TRAVEL_S
    assert np.abs(errors[1:]).max() > 0.001  # microphones are no clocks
