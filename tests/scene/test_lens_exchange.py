"""Cameras with each other's lenses, detected by the background and by a walking body."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.scene.background import steady_background
from intercap_core.scene.lens_exchange import choose_pairs, exchange_lenses, lens_gains, swap_lenses
from intercap_core.scene.subject_views import triangulate_views
from tests.helpers.synthetic_capture import (
    DEPTH,
    FURNITURE,
    perturbed,
    ring,
    room_depth,
    to_millimetres,
)
from tests.helpers.synthetic_people import seen_by, walking

ONE_SET, TIMES = np.zeros(1), np.arange(40) / 15
RING, UP = ring(5)
PX = RING[0].colour.width / 1920
SIGMA = (np.radians(0.1), 0.003)  # of the poses, rad and metres


def with_lenses(rig: Rig, change: np.ndarray) -> Rig:
    """The rig with focal lengths and principal points changed by (C, 3) px."""
    cameras = []
    for camera, (focal, cx, cy) in zip(rig, change, strict=True):
        lens = camera.colour
        lens = replace(
            lens, fx=lens.fx + focal, fy=lens.fy + focal, cx=lens.cx + cx, cy=lens.cy + cy
        )
        cameras.append(replace(camera, colour=lens, depth=lens if camera.aligned else camera.depth))
    return Rig(tuple(cameras))


# --- by the background ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seen():
    """Five cameras with depth on the colour grid, and lenses of 151 px."""
    change = np.random.default_rng(1).normal(0, 1.5, (5, 3))
    change[2], change[3] = (3, 4, -3), (-3, -2, 4)
    aligned = [Camera(c.name, DEPTH, DEPTH, np.eye(4), c.master_from_colour) for c in RING]
    rig, rng = with_lenses(Rig(tuple(aligned)), change), np.random.default_rng(0)
    images = [to_millimetres(room_depth(c, UP, FURNITURE), rng, noise=0.3)[None] for c in rig]
    backgrounds = [steady_background(image, np.zeros(image.shape, bool)) for image in images]
    nobody = triangulate_views(np.zeros((1, 5, 135, 3)), rig)
    return perturbed(rig, rng, 0.005, 0.2), backgrounds, nobody


def test_right_lenses_are_unchanged(seen):
    rig, backgrounds, nobody = seen
    result, exchanges = exchange_lenses(rig, backgrounds, nobody, ONE_SET, 0)
    assert exchanges == [] and result is rig


@pytest.mark.parametrize("with_distortion", [True, pytest.param(False, marks=pytest.mark.full)])
def test_exchanged_lenses_are_corrected(seen, with_distortion):
    rig, backgrounds, nobody = seen
    given = swap_lenses(rig, 2, 3, with_distortion=with_distortion)
    result, exchanges = exchange_lenses(given, backgrounds, nobody, ONE_SET, 0)
    assert [exchange.cameras for exchange in exchanges] == [(2, 3)]
    assert exchanges[0].after < 0.5 * exchanges[0].before
    for c in (2, 3):
        np.testing.assert_array_equal(result[c].depth.parameters, rig[c].colour.parameters)
        assert result[c].aligned


def test_devices_with_their_own_lenses_are_not_tested(seen):
    rig, backgrounds, nobody = seen
    given = swap_lenses(rig, 2, 3, with_distortion=True)
    apart = Rig(tuple(replace(c, colour_from_depth=RING[0].colour_from_depth) for c in given))
    assert exchange_lenses(apart, backgrounds, nobody, ONE_SET, 0) == (apart, [])


# --- by the keypoints ----------------------------------------------------------------------------


def unequal(rng: np.random.Generator) -> Rig:
    """The ring with lenses as different as those of one maker; those of k4 and k5 differ by 10 px
    in the principal point and 6 px in focal length."""
    change = rng.normal(0, 3, (5, 3))
    change[3], change[4] = (3, -4, 3), (-3, 4, -3)
    return with_lenses(RING, PX * change)


def observed(rig: Rig, rng: np.random.Generator) -> np.ndarray:
    """Keypoints of a walker with a constant error for each joint and view, and scatter."""
    keypoints = seen_by(walking(40, np.array([-0.5, -0.3]), np.array([0.025, 0.02]), 0.1), rig, UP)
    keypoints[..., :2] += rng.normal(0, 2 * PX, keypoints[..., :2].shape[1:])
    keypoints[..., :2] += rng.normal(0, 2 * PX, keypoints[..., :2].shape)
    return keypoints


@pytest.mark.parametrize("seed", range(3))
def test_keypoints_reveal_only_exchanged_lenses(seed):
    rng = np.random.default_rng(seed)
    rig = unequal(rng)
    keypoints = observed(rig, rng)
    claimed = perturbed(rig, rng, 0.003, 0.1)
    assert choose_pairs(lens_gains(keypoints, claimed, TIMES, SIGMA)) == []
    wrong = swap_lenses(claimed, 3, 4, with_distortion=True)
    pairs = choose_pairs(lens_gains(keypoints, wrong, TIMES, SIGMA))
    assert [pair.cameras for pair in pairs] == [(3, 4)]


def test_uncertain_poses_hide_the_exchange():
    rng = np.random.default_rng(5)
    rig = unequal(rng)
    keypoints, wrong = observed(rig, rng), swap_lenses(rig, 3, 4, with_distortion=True)
    certain, uncertain = (
        {pair.cameras: pair.gain for pair in lens_gains(keypoints, wrong, TIMES, sigma)}
        for sigma in (SIGMA, (0.02, 0.03))
    )
    assert max(certain, key=lambda pair: certain[pair]) == (3, 4)
    assert uncertain[3, 4] < certain[3, 4] / 2


def test_equal_lenses_cannot_be_exchanged():
    keypoints = observed(RING, np.random.default_rng(0))
    assert lens_gains(keypoints, RING, TIMES, SIGMA) == []
