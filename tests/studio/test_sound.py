"""Sound of the studio's videos, and stated start times."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import signal

from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.entries import SequenceEntry
from intercap_core.formats.recordings.layouts import open_layout
from intercap_core.formats.recordings.sound_delays import estimate_delay, sound_starts
from intercap_core.formats.recordings.source import SOUND_RATE, Sound
from intercap_core.studio.capture import erring_starts
from intercap_core.studio.capture_folder import SOUND_RATE as STUDIO_RATE
from intercap_core.studio.capture_folder import Device, DeviceFrame
from intercap_core.studio.layouts import FOLDERS
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


def test_sound_delay_is_the_travel_time():
    """Without delays of devices: by the way to the person, to half a millisecond."""
    stage = stage_of(7915, apart=0.0)
    stage.noise = type(stage.noise)(7915, 0.0, "a", 30.0)
    tracks = [listened(heard(stage, c, 0.0, SECONDS)) for c in (0, 1)]
    found = estimate_delay(*tracks)
    moment = stage.at(stage.set_times)
    eyes = np.linalg.inv(stage.rig.master_from_stage) @ stage.rig.true.master_from_colour
    far = [np.linalg.norm(moment.joints[:, 0] - eye[:3, 3], axis=1) for eye in eyes[:2]]
    way = (far[1] - far[0]) / 343
    assert found is not None and way.min() - 0.0015 < found.seconds < way.max() + 0.0015


def test_videos_contain_the_recorded_sound(tmp_path):
    stage = stage_of(7911)
    samples = heard(stage, 0, 0.0, 2.0)
    place = FOLDERS["plain"](
        tmp_path, StudioCapture(interaction="walk_and_wave", subject="s03", seed=1, video=True,
                                layout="plain", depth=False, sound=True), {},
    )  # fmt: skip
    jpeg = cv2.imencode(".jpg", np.full((720, 1280, 3), 90, np.uint8))[1].tobytes()
    camera = stage.rig.claimed[0]
    device = Device(0, camera, "1", "720P", "NFOV_UNBINNED", False, 30, 1_000_000, samples)
    with place.open(device) as files:
        for t in range(60):
            files.write(DeviceFrame(t, 1_000_000 + round(t * 1e6 / 30), jpeg, None, []))
    place.write_calibration(stage.rig.claimed, 30)
    row = SequenceEntry(
        sequence="one", subject="p", recordings=tmp_path, layout="plain",
        calibration=tmp_path / "calibration.yaml",
    )  # fmt: skip
    with open_layout(row).open("k1") as recording:
        images = [image for image in recording.images() if image.kind == "colour"]
        sound = recording.sound()
    assert [image.content for image in images] == [jpeg] * 60  # sound between them harms nothing
    assert sound is not None and sound.first_s == pytest.approx(0, abs=0.001)
    expected = signal.resample_poly(samples, SOUND_RATE, STUDIO_RATE)
    count = min(len(expected), len(sound.samples))
    assert count > 1.9 * SOUND_RATE
    alike = np.corrcoef(expected[:count], sound.samples[:count])[0, 1]
    assert alike > 0.9


def test_stated_starts_err_by_their_sigma():
    stage = stage_of(7911)
    exact = erring_starts(stage, 0.0)
    assert exact["starts_sigma"] == 0.001
    first = [min(set(range(90)) - lost) / 30 for lost in stage.rig.missing]
    clock = np.array(list(exact["starts"].values())) - first + stage.rig.late_s
    np.testing.assert_allclose(clock, clock[0], atol=2e-4)
    off = [
        np.subtract(*(list(erring_starts(stage_of(s), e)["starts"].values()) for e in (0.05, 0.0)))
        for s in (1, 2, 3, 4)
    ]
    assert 0.025 < np.std(off) < 0.09
