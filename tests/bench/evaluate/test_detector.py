"""The part ``detector`` of the evaluation: slip of grips, and a machine without MediaPipe."""

from __future__ import annotations

import numpy as np
import pytest

from bench.evaluate.detector import camera_errors, grip_slips


def test_a_grip_slips_by_what_its_error_changes() -> None:
    true = np.zeros((20, 2, 3))
    true[:, 0, 0] = np.linspace(0, 0.05, 20)  # a true slip is no error
    fitted = true + np.array([0.02, 0, 0])  # neither is a constant error
    holding = np.zeros((20, 2), bool)
    holding[2:18, 0] = True
    assert grip_slips(fitted, true, holding, 15.0) == [pytest.approx(0.0, abs=1e-12)]
    fitted[10:18, 0, 1] = 0.03  # half of the grip is 30 mm off: 15 mm from the mean
    assert grip_slips(fitted, true, holding, 15.0) == [pytest.approx(0.015)]


def test_short_touches_are_no_grips() -> None:
    wrists = np.random.default_rng(0).normal(size=(20, 2, 3))
    holding = np.zeros((20, 2), bool)
    holding[3:7, 1] = True  # 0.27 s
    assert grip_slips(wrists, np.zeros_like(wrists), holding, 15.0) == []


def test_cameras_are_compared_by_name_and_relative_to_the_master() -> None:
    """Truth has the master k1 first; the fit lists k2 first. k2 is 4 mm off, 3 ms late."""
    poses = np.stack([np.eye(4)] * 2)
    poses[1, :3, 3] = (0.0, 0.0, 2.0)
    true = {
        "camera_names": np.array(["k1", "k2"]), "master_from_colour": poses,
        "time_offset": np.array([0.001, 0.002]), "depth_bias": np.array([0.005, np.nan]),
    }  # fmt: skip
    moved = poses[::-1].copy()
    moved[0, 0, 3] += 0.004
    covariance = np.zeros((2, 7, 2, 7))
    covariance[0, 3:6, 0, 3:6] = 0.002**2 * np.eye(3)
    covariance[1, 6, 1, 6] = 0.003**2
    fitted = {
        "camera_names": np.array(["k2", "k1"]), "master_from_colour": moved,
        "time_offset": np.array([0.006, 0.002]), "time_offset_sigma": np.array([0.001, 0.0]),
        "depth_bias": np.array([np.nan, 0.003]), "camera_covariance": covariance,
    }  # fmt: skip
    found = camera_errors(fitted, true)
    assert found.pose_mm.rms() == pytest.approx((4.0, 2.0 * np.sqrt(3)))
    assert found.offset_ms.rms() == pytest.approx((3.0, 1.0))
    assert found.depth_bias_mm.rms() == pytest.approx((2.0, 3.0))
