"""Exchanged lenses, told by the reprojection of a body that walks about."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from intercap_core.geometry.camera.rig import Rig
from intercap_core.scene.lens_exchange import choose_pairs, lens_gains
from tests.helpers.synthetic_capture import perturbed, ring
from tests.helpers.synthetic_people import seen_by, walking

RIG, UP = ring()
TIMES = np.arange(40) / 15
SIGMA = (np.radians(0.1), 0.003)


def unlike(rng: np.random.Generator) -> Rig:
    """The ring with lenses as different as one maker's are; those of k4 and k5 differ by 10 px
    in the principal point and 6 px in focal length."""
    change = rng.normal(0, 3, (6, 3))
    change[3], change[4] = (3, -4, 3), (-3, 4, -3)
    cameras = []
    for camera, (focal, cx, cy) in zip(RIG, change * RIG[0].colour.width / 1920, strict=True):
        lens = camera.colour
        lens = replace(
            lens, fx=lens.fx + focal, fy=lens.fy + focal, cx=lens.cx + cx, cy=lens.cy + cy
        )
        cameras.append(replace(camera, colour=lens))
    return Rig(tuple(cameras))


def exchanged(rig: Rig, a: int, b: int) -> Rig:
    cameras = list(rig.cameras)
    cameras[a] = replace(cameras[a], colour=rig[b].colour)
    cameras[b] = replace(cameras[b], colour=rig[a].colour)
    return Rig(tuple(cameras))


def observed(rig: Rig, rng: np.random.Generator) -> np.ndarray:
    """Keypoints of a walker with a constant error for each joint and view, and scatter."""
    keypoints = seen_by(walking(40, np.array([-0.5, -0.3]), np.array([0.025, 0.02]), 0.1), rig, UP)
    scale = rig[0].colour.width / 1920
    keypoints[..., :2] += rng.normal(0, 2 * scale, keypoints[..., :2].shape[1:])
    keypoints[..., :2] += rng.normal(0, 2 * scale, keypoints[..., :2].shape)
    return keypoints


def test_exchanged_lenses_are_found_and_only_they():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        rig = unlike(rng)
        keypoints = observed(rig, rng)
        claimed = perturbed(rig, rng, 0.003, 0.1)
        assert choose_pairs(lens_gains(keypoints, claimed, TIMES, SIGMA)) == []
        found = choose_pairs(lens_gains(keypoints, exchanged(claimed, 3, 4), TIMES, SIGMA))
        assert [pair.cameras for pair in found] == [(3, 4)]


def test_poses_that_are_uncertain_hide_the_exchange():
    rng = np.random.default_rng(5)
    rig = unlike(rng)
    keypoints = observed(rig, rng)
    wrong = exchanged(rig, 3, 4)
    sure = {p.cameras: p.gain for p in lens_gains(keypoints, wrong, TIMES, SIGMA)}
    loose = lens_gains(keypoints, wrong, TIMES, (0.02, 0.03))
    unsure = {p.cameras: p.gain for p in loose}
    assert max(sure, key=lambda pair: sure[pair]) == (3, 4)
    assert unsure[3, 4] < sure[3, 4] / 2


def test_like_lenses_cannot_be_exchanged():
    keypoints = observed(RIG, np.random.default_rng(0))
    assert lens_gains(keypoints, RIG, TIMES, SIGMA) == []
