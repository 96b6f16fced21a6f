"""Late images and time offsets from the keypoints of a walking stick person."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import reproject
from intercap_core.scene.keypoint_timing import find_offsets
from intercap_core.scene.slips import Slips, find_slips, interval_gains, longest_slip
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import walker

FPS, SETS = 15.0, 40
RIG, UP = ring()
TIMES = np.arange(SETS) / FPS


def slip_of(intervals: dict[int, tuple[slice, int]], sets: int = SETS, views: int = 6):
    """(T, C) frames by which images are late, from (sets, frames) by camera."""
    slip = np.zeros((sets, views), np.int32)
    for camera, (when, frames) in intervals.items():
        slip[when, camera] = frames
    return slip


def seen(slip: np.ndarray, offset=0.0, fps: float = FPS, seed: int = 0, moving: bool = True):
    """Keypoints (T, C, 135, 3), scattered by 2 px, of images that are late by ``slip`` (T, C)
    frames and exposed ``offset`` seconds after their sets."""
    rng = np.random.default_rng(seed)
    exposures = (np.arange(len(slip))[:, None] / fps - slip / fps + offset) * moving
    keypoints = np.full((*exposures.shape, 135, 3), 0.9)
    for c, times in enumerate(exposures.T):
        points = apply(invert(UP), walker(times).reshape(-1, 3))
        pixels = reproject(points, RIG)[:, c].reshape(len(times), 135, 2)
        keypoints[:, c, :, :2] = pixels + rng.normal(0, 2, pixels.shape)
    return keypoints


def slips_of(keypoints: np.ndarray, fps: float = FPS) -> Slips:
    return find_slips(keypoints, RIG, np.arange(len(keypoints)) / fps, fps)


@pytest.mark.parametrize("seed", range(2))
def test_synchronised_images_have_no_slips(seed):
    assert not slips_of(seen(slip_of({}), seed=seed)).intervals


@pytest.mark.parametrize(
    "slip",
    [
        slip_of({2: (slice(12, 24), 3), 4: (slice(18, 30), 1)}),
        slip_of({2: (slice(45, 70), 2), 5: (slice(80, None), 1)}, sets=110),
        slip_of({3: (slice(None), 2)}),
    ],
    ids=["two cameras at once", "over the edge of a window", "a constant delay"],
)
def test_slips_are_found_exactly(slip):
    np.testing.assert_array_equal(slips_of(seen(slip)).slip, slip)


def test_constant_delays_are_relative_to_the_master():
    slip = slip_of({0: (slice(None), 2)})
    np.testing.assert_array_equal(slips_of(seen(slip)).slip, slip - slip[:, :1])


@pytest.mark.parametrize(("fps", "frames"), [(5, 4), (15, 4), (30, 4), (60, 8), (120, 16)])
def test_longest_slip_by_frame_rate(fps, frames):
    assert longest_slip(fps) == frames


def test_slip_lasts_more_frames_at_sixty_per_second():
    slip = slip_of({2: (slice(20, 60), 7), 5: (slice(50, None), 5)}, sets=90)
    slips = slips_of(seen(slip, fps=60.0), 60.0)
    assert sorted((i.camera, i.slip) for i in slips.intervals) == [(2, 7), (5, 5)]
    assert np.abs(slips.slip - slip).mean() < 0.1


def test_neither_slip_nor_offset_is_reported_without_motion():
    slip = slip_of({1: (slice(10, 20), 2)})
    keypoints = seen(slip, moving=False)
    assert not slips_of(keypoints).intervals
    offsets = find_offsets(keypoints, slip, RIG, TIMES)
    assert np.isnan(offsets.sigma[1:]).all() and not offsets.offset.any()


def test_offsets_are_seconds_after_the_master():
    true = np.array([0.003, -0.004, 0.008, 0.0, -0.002, 0.006])
    slip = slip_of({})
    offsets = find_offsets(seen(slip, true), slip, RIG, TIMES, master=1)
    np.testing.assert_allclose(offsets.offset, true - true[1], atol=0.0015)
    free = np.delete(np.arange(6), 1)
    alone = np.linalg.solve(offsets.information[np.ix_(free, free)], offsets.vector[free])
    np.testing.assert_allclose(alone, offsets.offset[free], atol=2e-4)


def test_three_cameras_with_unequal_frame_counts_suffice():
    rig = replace(RIG, cameras=RIG.cameras[:3])
    slip = slip_of({1: (slice(15, 28), 3)}, views=3)
    keypoints = seen(slip)
    keypoints[36:, 1] = keypoints[:3, 0] = 0
    np.testing.assert_array_equal(find_slips(keypoints, rig, TIMES, FPS).slip, slip)
    assert np.abs(find_offsets(keypoints, slip, rig, TIMES).offset).max() < 0.004


def test_interval_gains_are_sums_over_intervals():
    rng = np.random.default_rng(0)
    linear, quadratic = rng.normal(size=7), rng.normal(size=(7, 7))
    gains = interval_gains(linear, quadratic)
    assert gains[2, 5] == pytest.approx(linear[2:5].sum() - quadratic[2:5, 2:5].sum() / 2)
    assert np.isneginf(gains[4, 4])
