"""Keypoints of a real detector on the studio's images."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.errors import UserError
from intercap_core.studio.capture import make_capture
from intercap_core.studio.mediapipe import VARIABLE, detect_keypoints, mediapipe_python
from intercap_core.studio.recording import Kinect
from intercap_core.studio.stage import StudioStage
from tests.helpers.fitted_capture import object_entry

CAPTURE = StudioCapture(
    interaction="stool_sit", subject="s02", seed=77, frames=3, keypoints="mediapipe"
)
SETTINGS = StudioSettings(captures={}, cameras=2, colour_mode="1080P")


def test_mediapipe_finds_the_true_shoulders(tmp_path: Path) -> None:
    if mediapipe_python() is None:
        pytest.skip("MediaPipe is not installed (make mediapipe)")
    stool = object_entry("stool")
    make_capture(CAPTURE, SETTINGS, sequence="tiny", objects=stool, output=tmp_path / "tiny")
    found = json.loads((tmp_path / "tiny/keypoints/k1.json").read_text())
    assert [image["id"] for image in found["images"]] == [0, 1, 2]
    assert len(found["annotations"]) == 3
    stage = StudioStage(CAPTURE, SETTINGS, stool)
    kinect = Kinect(stage, 0, SETTINGS.colour_mode)
    points = stage.to_master(stage.keypoints(stage.at(kinect.exposures)))
    pose = kinect.true.colour_from_master
    pixels = kinect.true.colour.project(points @ pose[:3, :3].T + pose[:3, 3])
    for entry in found["annotations"]:
        body = np.array(entry["keypoints"]).reshape(-1, 3)
        for place, name in ((5, "left_shoulder"), (6, "right_shoulder")):
            expected = pixels[entry["image_id"], KEYPOINT_INDEX[name]]
            assert np.linalg.norm(body[place, :2] - expected) < 40  # px, 10 cm


def test_a_missing_mediapipe_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "python"))
    with pytest.raises(UserError, match="run 'make mediapipe'"):
        detect_keypoints(tmp_path, tmp_path / "k1.json")


def test_a_failure_of_mediapipe_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failing = tmp_path / "python"
    failing.write_text("#!/bin/sh\necho first >&2; echo no module named mediapipe >&2; exit 1\n")
    failing.chmod(0o755)
    monkeypatch.setenv(VARIABLE, str(failing))
    with pytest.raises(UserError, match="no module named mediapipe"):
        detect_keypoints(tmp_path, tmp_path / "k1.json")


def test_other_layouts_keep_simulated_keypoints() -> None:
    capture = CAPTURE.model_copy(update={"layout": "behave"})
    with pytest.raises(UserError, match="simulated"):
        StudioStage(capture, SETTINGS, object_entry("stool"))
