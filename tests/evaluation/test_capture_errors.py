"""Errors of the capture, each on a case small enough to work out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.evaluate import capture_errors
from bench.evaluate.capture_errors import CaptureErrors, Slip, SlipCounts
from intercap_core.errors import UserError
from intercap_core.evaluation.truth import match_times
from intercap_core.geometry.solve.robust import SIGMA_PER_MAD
from tests.helpers import fitted_capture as fitted

UP = np.array([0, 0, 1.0])


def test_offsets_are_relative_to_the_master_which_is_left_out() -> None:
    found, true = np.array([0.010, 0.003, 0.0]), np.array([0.008, 0.0, 0.002])
    assert capture_errors.offset_errors(found, true, 1) == pytest.approx([-0.001, -0.005])


def test_slips_are_runs_of_equal_delay() -> None:
    slip = np.array([[0, 2, 2, 0, 2, 3, 3, 1]]).T
    images = np.array([[1, 1, 1, 0, 1, 1, 1, 0]], bool).T
    assert capture_errors.slip_events(slip, images) == [Slip(0, 1, 4, 2), Slip(0, 5, 6, 3)]
    assert capture_errors.slip_events(slip[:0], images[:0]) == []
    assert capture_errors.slip_events(np.full((3, 1), 4), np.ones((3, 1), bool)) == [
        Slip(0, 0, 2, 4)
    ]


def test_slips_match_by_camera_and_lag() -> None:
    true = np.zeros((10, 3), int)
    true[2:6, 1] = 2
    true[3:5, 2] = 4
    images = np.ones((10, 3), bool)
    late = np.zeros_like(true)
    late[4:8, 1] = 2  # begins two sets late, ends two late: found, with four wrong images
    late[3:5, 2] = 3  # not the right amount: missed, and a false one beside
    late[0, 0] = 1  # nothing slipped here
    assert capture_errors.compare_slips(late, true, images) == SlipCounts(
        found=1, missed=1, false=2, images_wrong=7, images=30
    )
    assert capture_errors.compare_slips(true, true, images) == SlipCounts(2, 0, 0, 0, 30)
    images[:, 2] = False  # what no image shows cannot be missed
    assert capture_errors.compare_slips(0 * true, true, images).missed == 1


def test_ground_error_of_a_raised_and_of_a_tilted_floor() -> None:
    centre = np.array([3.0, -2.0, 1.1])
    raised = capture_errors.ground_error(np.array([9.0, 9, 0.105]), UP, UP, -0.1, centre)
    assert raised == pytest.approx((0.005, 0))
    tilt = np.radians(0.5)
    normal = np.array([np.sin(tilt), 0, np.cos(tilt)])
    foot = np.array([3.0, -2.0, 0.1])
    tilted = capture_errors.ground_error(foot, normal, UP, -0.1, centre)
    # the mean of |x| over a disc of radius r is 4 r / (3 pi)
    expected = np.tan(tilt) * 4 * capture_errors.CAPTURE_RADIUS_M / (3 * np.pi)
    assert tilted == pytest.approx((expected, 0.5), rel=1e-3)
    none = capture_errors.ground_error(np.full(3, np.nan), np.full(3, np.nan), UP, 0.0, centre)
    assert np.isnan(none).all()


def test_times_are_matched_to_the_nearest() -> None:
    path, true = Path("truth.h5"), np.arange(4) / 10
    assert match_times(path, true, np.array([0.0, 0.11, 0.29]), 10).tolist() == [0, 1, 3]
    assert match_times(path, true[:1], np.array([0.01]), 10).tolist() == [0]
    with pytest.raises(UserError, match=r"0\.400 s is 0\.100 s from the nearest true frame"):
        match_times(path, true, np.arange(1, 5) / 10, 10)


def _errors(room: str = "furnished", **values: object) -> CaptureErrors:
    three = np.array([0.010, 0.020, 0.030])
    known = {
        "before": three, "after": three / 10, "offset": np.array([0.001, -0.003, 0.002]),
        "offset_normalised": np.array([1, -1, np.nan]) / SIGMA_PER_MAD,
        "slips": SlipCounts(found=2, missed=0, false=0, images_wrong=1, images=100),
        "ground_m": 0.002, "ground_deg": 0.1, "depth_bias": np.array([0.001, -0.001, np.nan]),
    }  # fmt: skip
    return CaptureErrors(room, **(known | values))


def test_figures_of_several_captures() -> None:
    worse = np.array([0.020, 0.020, 0.030])
    three = [
        _errors(),
        _errors("bare", after=worse, slips=SlipCounts(1, 1, 2, 3, 100), ground_m=0.006),
        _errors(ground_m=np.nan, ground_deg=np.nan),
    ]
    found = capture_errors.figures(three)
    assert found["extrinsics_before_mm"] == pytest.approx(20)
    assert found["extrinsics_after_mm"] == pytest.approx(2)
    assert found["extrinsics_worst_camera_mm"] == pytest.approx(3)
    assert found["extrinsics_floor_only_mm"] == pytest.approx(70 / 3)
    assert found["extrinsics_improved_share"] == pytest.approx(2 / 3)
    assert found["extrinsics_worse_share"] == pytest.approx(1 / 3)
    assert found["offset_error_ms"] == pytest.approx(2)
    assert found["offset_estimated_share"] == pytest.approx(2 / 3)
    assert found["offset_normalised_median"] == pytest.approx(1)
    assert (found["slips_true"], found["slips_missed"], found["slips_false"]) == (6, 1, 2)
    assert found["slips_images_wrong_share"] == pytest.approx(5 / 300)
    assert found["ground_missing_share"] == pytest.approx(1 / 3)
    assert found["ground_error_mm"] == pytest.approx(4)
    assert found["depth_bias_error_mm"] == pytest.approx(1)
    assert capture_errors.figures([]) == {}


def test_a_single_camera_has_no_poses_and_offsets_to_judge() -> None:
    none = np.zeros(0)
    found = capture_errors.figures(
        [_errors(before=none, after=none, offset=none, offset_normalised=none)]
    )
    assert not any(key.startswith(("extrinsics", "offset")) for key in found)
    assert found["ground_error_mm"] == pytest.approx(2)


def test_artefacts_are_compared_by_camera_and_moment(
    capture: fitted.Capture, tmp_path: Path
) -> None:
    made = capture.copied(tmp_path, "scene", "truth")
    with made.edit("scene") as scene, made.edit("truth") as truth:
        truth["time_offset"][...] = [0, 0.002, -0.004]
        truth["slip"][3:, 1] = 1
        scene["slip"][4:, 1] = 1
        # n . x + d = 0 with n = (0, -1, 0): d is the floor's y
        truth.attrs["ground_offset"] = scene["ground_point"][1] + 0.003
    found = capture_errors.measure(*(made.paths[name] for name in ("frames", "scene", "truth")))
    assert found.before == pytest.approx([0.012, 0], abs=1e-6)
    assert found.after == pytest.approx([0, 0], abs=1e-6)
    assert found.offset == pytest.approx([-0.002, 0.004])
    assert found.slips == SlipCounts(found=1, missed=0, false=0, images_wrong=1, images=15)
    assert (found.ground_m, found.ground_deg) == pytest.approx((0.003, 0), abs=1e-9)
