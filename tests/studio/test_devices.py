"""Rigs, clocks and faults; truth states every fault of a capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.errors import UserError
from intercap_core.formats.recordings.k4a import KinectFile
from intercap_core.schemas import TRUTH
from intercap_core.studio.capture import make_capture
from intercap_core.studio.recording import Kinect
from intercap_core.studio.rig import StudioRig, build_rig, started_apart
from intercap_core.studio.stage import check_capture
from tests.helpers.fitted_capture import object_entry

FRAMES, FPS = 8, 5


def capture_of(frames: int = 45, **options: object) -> StudioCapture:
    values = dict(interaction="stool_sit", subject="s02", seed=78, frames=frames) | options
    return StudioCapture.model_validate(values)


def rig_of(seed: int, **options: object) -> StudioRig:
    settings = StudioSettings.model_validate(dict(captures={}, colour_mode="720P") | options)
    return build_rig(np.random.default_rng(seed), capture_of(), settings)


@pytest.mark.parametrize("seed", range(6))
def test_two_cameras_slip_by_one_to_four_frames(seed: int) -> None:
    silent = rig_of(seed, slips="silent").slip
    slipping = np.flatnonzero(silent.any(0))
    assert len(slipping) == 2 and 0 not in slipping
    for camera in slipping:
        slipped = np.flatnonzero(silent[:, camera])
        assert 1 <= silent[slipped[0], camera] <= 4
        assert len(set(silent[slipped, camera])) == 1
        assert slipped[0] >= silent[slipped[0], camera]
        assert len(slipped) >= 3 and (np.diff(slipped) == 1).all()
    lost = rig_of(seed).missing
    inside = [sorted(m - set(range(3)) - set(range(42, 45))) for m in lost]
    assert sum(len(sets) > 0 for sets in inside) <= 2
    assert 2 <= sum(len(m) >= 1 for m in lost) <= 4 and lost[0] == frozenset()
    rig = rig_of(seed)
    assert not rig.slip.any() and np.abs(rig.offset_s).max() <= 0.008 and rig.offset_s[0] == 0


@pytest.mark.parametrize("fps", [15, 30, 60])
def test_late_starts_are_whole_sets_plus_a_fraction(fps: int) -> None:
    rig = rig_of(5)
    apart = started_apart(rig, np.random.default_rng(8), 0.5, fps)
    late = (apart.slip - rig.slip) / fps - (apart.offset_s - rig.offset_s)
    assert (late == late[0]).all()  # all along
    np.testing.assert_allclose(apart.late_s, late[0], atol=1e-12)
    assert not rig.late_s.any()
    assert late[0, 0] == 0 and 0.45 <= np.abs(late[0]).max() <= 0.5
    assert np.abs(apart.offset_s - rig.offset_s).max() <= 0.5 / fps + 1e-12
    assert len(np.unique(late[0])) == len(late[0])


@pytest.fixture(scope="module")
def broken_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five frames a second, three cameras: one stops, one clock jumps back."""
    folder = tmp_path_factory.mktemp("studio") / "broken"
    make_capture(
        capture_of(FRAMES, room="bare", faults=("backwards_clock", "dead_half")),
        StudioSettings(
            captures={}, cameras=3, colour_mode="720P", depth_mode="WFOV_2X2BINNED", fps=FPS
        ),
        sequence="broken", objects=object_entry("stool"), output=folder,
    )  # fmt: skip
    return folder


def test_faults_are_in_the_recordings_and_in_the_truth(broken_capture: Path) -> None:
    with artefacts.read(broken_capture / "truth.h5", TRUTH) as truth:
        faults = dict(entry.split() for entry in truth.attributes["faults"].split(", "))
        assert truth.attributes["room"] == "bare"
        recorded, names = truth["recorded"], list(truth["camera_names"])
    for index, name in enumerate(names):
        with KinectFile(broken_capture / f"{name}.mkv") as recording:
            assert recording.info.depth_mode == "WFOV_2X2BINNED"
            assert recording.info.fps == FPS
            packets = list(recording.packets())
        colour = [p.device_time_us for p in packets if p.kind == "colour"]
        depth = [recording.depth_image(p.content) for p in packets if p.kind == "depth"]
        assert depth[0].shape == (512, 512)
        assert not depth[0][:20, :20].any() and depth[0][200:300, 200:300].any()
        gravity = [p for p in packets if p.kind == "imu"]
        assert len(gravity) >= len(colour)
        sets = np.rint((np.array(colour) - Kinect.start_us) * FPS / 1e6).astype(int)
        if faults["dead_half"] == name:
            assert sets.max() < FRAMES // 2 and not recorded[FRAMES // 2 :, index].any()
        elif faults["backwards_clock"] == name:
            assert (np.diff(colour) < 0).sum() == 1 and sets.max() < FRAMES // 2
            assert not recorded[FRAMES // 2 :, index].any()
        else:
            assert set(sets) == set(np.flatnonzero(recorded[:, index]))


@pytest.mark.parametrize(
    ("capture", "says"),
    [
        ({"subject": "nobody"}, "no subject 'nobody'"),
        ({"interaction": "dance"}, "no interaction 'dance'"),
        ({"interaction": "cup_drink"}, "needs object 'cup'"),
        ({"faults": ("dead_half",), "frames": 2}, "need 4 frames"),
        ({"every": {"k9": 2}}, "names camera 'k9'"),
        ({"every": {"k2": 2}}, "'k2' would have 7.5 frames a second"),
        ({"sound": True, "layout": "plain"}, "only videos carry sound"),
        ({"every": {"k2": 3}, "layout": "behave"}, "'behave' all have one rate"),
        ({"shoes": "heavy", "interaction": "skateboard_ride"}, "bare soles meet the object"),
        ({"faults": ("dead_half",), "cameras": 1}, "need a second camera"),
        ({"camera": "hand_held"}, "a hand-held camera is alone"),
    ],
)
def test_impossible_captures_are_refused(capture: dict[str, object], says: str) -> None:
    values = {"interaction": "stool_sit", "subject": "s02", "seed": 1} | capture
    settings = StudioSettings(captures={}, cameras=values.pop("cameras", 6))  # type: ignore[arg-type]
    name = "skateboard" if "shoes" in capture else "stool"
    with pytest.raises(UserError, match=says):
        check_capture(StudioCapture(**values), settings, name)  # type: ignore[arg-type]
