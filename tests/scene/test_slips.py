"""Silent slips and time offsets from the keypoints of a walking stick person."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import reproject
from intercap_core.scene.keypoint_timing import WINDOW_SETS, find_offsets
from intercap_core.scene.slips import find_slips, interval_gains, longest_slip
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import walker

FPS = 15.0
RIG, UP = ring()
TIMES = np.arange(40) / FPS


def seen(exposures: np.ndarray, seed: int = 0, moving: bool = True) -> np.ndarray:
    """Keypoints (T, C, 135, 3) at ``exposures`` (T, C) s, scattered by 2 px."""
    rng = np.random.default_rng(seed)
    keypoints = np.full((*exposures.shape, 135, 3), 0.9)
    for c in range(exposures.shape[1]):
        points = walker(exposures[:, c] if moving else 0 * exposures[:, c])
        in_master = apply(invert(UP), points.reshape(-1, 3))
        pixels = reproject(in_master, RIG)[:, c].reshape(len(points), 135, 2)
        keypoints[:, c, :, :2] = pixels + rng.normal(0, 2, pixels.shape)
    return keypoints


def exposures(slip: np.ndarray, offset: np.ndarray | float = 0.0, fps: float = FPS) -> np.ndarray:
    return np.arange(len(slip))[:, None] / fps - slip / fps + offset


def test_no_slips_in_synchronised_images():
    for seed in range(2):
        assert not find_slips(seen(exposures(np.zeros((40, 6))), seed), RIG, TIMES, FPS).intervals


def test_two_cameras_may_slip_at_once():
    slip = np.zeros((40, 6), np.int32)
    slip[12:24, 2], slip[18:30, 4] = 3, 1
    found = find_slips(seen(exposures(slip)), RIG, TIMES, FPS)
    np.testing.assert_array_equal(found.slip, slip)


def test_a_slip_may_lie_over_the_edge_of_a_window():
    slip = np.zeros((WINDOW_SETS + 14, 6), np.int32)
    slip[45:70, 2], slip[80:, 5] = 2, 1
    times = np.arange(len(slip)) / FPS
    np.testing.assert_array_equal(find_slips(seen(exposures(slip)), RIG, times, FPS).slip, slip)


def test_whole_frames_of_delay_count_from_the_master():
    slip = np.zeros((40, 6), np.int32)
    slip[:, 3] = 2
    found = find_slips(seen(exposures(slip)), RIG, TIMES, FPS)
    np.testing.assert_array_equal(found.slip, slip)
    slip[:, 3], slip[:, 0] = 0, 2
    found = find_slips(seen(exposures(slip)), RIG, TIMES, FPS)
    np.testing.assert_array_equal(found.slip, slip - slip[:, :1])


@pytest.mark.parametrize(("fps", "frames"), [(5, 4), (15, 4), (30, 4), (60, 8), (120, 16)])
def test_longest_slip_by_frame_rate(fps, frames):
    assert longest_slip(fps) == frames


def test_at_sixty_a_second_a_slip_lasts_more_frames():
    slip = np.zeros((90, 6), np.int32)
    slip[20:60, 2], slip[50:, 5] = 7, 5
    times = np.arange(len(slip)) / 60
    found = find_slips(seen(exposures(slip, fps=60.0)), RIG, times, 60.0)
    assert sorted((i.camera, i.slip) for i in found.intervals) == [(2, 7), (5, 5)]
    assert np.abs(found.slip - slip).mean() < 0.1


def test_slip_without_motion_is_not_reported():
    slip = np.zeros((40, 6), np.int32)
    slip[10:20, 1] = 2
    assert not find_slips(seen(exposures(slip), moving=False), RIG, TIMES, FPS).intervals
    found = find_offsets(seen(exposures(slip), moving=False), slip, RIG, TIMES)
    assert np.isnan(found.sigma[1:]).all() and not found.offset.any()


def test_offsets_are_seconds_after_the_master():
    true = np.array([0.003, -0.004, 0.008, 0.0, -0.002, 0.006])
    found = find_offsets(seen(exposures(np.zeros((40, 6)), true)), np.zeros((40, 6), int),
                             RIG, TIMES, master=1)  # fmt: skip
    np.testing.assert_allclose(found.offset, true - true[1], atol=0.0015)
    free = np.delete(np.arange(6), 1)
    alone = np.linalg.solve(found.information[np.ix_(free, free)], found.vector[free])
    np.testing.assert_allclose(alone, found.offset[free], atol=2e-4)


def test_three_cameras_with_unequal_frame_counts_suffice():
    rig = replace(RIG, cameras=RIG.cameras[:3])
    slip = np.zeros((40, 3), np.int32)
    slip[15:28, 1] = 3
    keypoints = seen(exposures(slip))
    keypoints[36:, 1] = 0
    keypoints[:3, 0] = 0
    np.testing.assert_array_equal(find_slips(keypoints, rig, TIMES, FPS).slip, slip)
    offsets = find_offsets(keypoints, slip, rig, TIMES)
    assert np.abs(offsets.offset).max() < 0.004


def test_interval_gains_are_sums_over_intervals():
    rng = np.random.default_rng(0)
    linear, quadratic = rng.normal(size=7), rng.normal(size=(7, 7))
    gains = interval_gains(linear, quadratic)
    assert gains[2, 5] == pytest.approx(linear[2:5].sum() - quadratic[2:5, 2:5].sum() / 2)
    assert np.isneginf(gains[4, 4])
