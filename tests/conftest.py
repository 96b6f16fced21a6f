"""Fixtures that several parts of the tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

PROJECT_ROOT = Path(__file__).resolve().parents[1]


def _sample(name: str) -> Path:
    """A file of the sample data that lies beside the project; skips the test where it does not."""
    folder = Path(os.environ.get("INTERCAP_SAMPLE_DATA", PROJECT_ROOT.parent / "shared" / "data"))
    path = folder / name
    if not path.is_file():
        pytest.skip(f"{path} is not here; set INTERCAP_SAMPLE_DATA to the folder that holds {name}")
    return path


@pytest.fixture
def real_recording() -> Path:
    """A real Azure Kinect recording: 720P MJPG, NFOV_UNBINNED depth and IR, IMU."""
    return _sample("k4a-720p-nfov-imu.mkv")


@pytest.fixture
def real_calibration() -> bytes:
    """A real Azure Kinect calibration JSON."""
    return _sample("k4a-calibration.json").read_bytes()
