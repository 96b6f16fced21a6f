"""Where bodies start of which too little is known to place them."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body_fit.observations import TRUNK_KEYPOINTS, Observations
from intercap_core.body_fit.start import between, place_trunk
from tests.helpers.body_capture import ring

TIMES = np.arange(12) / 15
TURN = Rotation.from_rotvec(np.outer(TIMES, [0, 1.0, 0.5]))


def _walk() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rest keypoints (135,3), its pelvis (3,), and keypoints (12,135,3) of somebody turning."""
    rest = np.random.default_rng(0).normal(0, 0.3, (135, 3))
    pelvis = np.array([0.0, -0.3, 0.0])
    turned = np.stack([turn.apply(rest - pelvis) for turn in TURN])
    return rest, pelvis, turned + pelvis + TIMES[:, None, None] * [1.0, 0, 0]


def test_frames_without_a_trunk_start_between_the_others():
    rest, pelvis, joints = _walk()
    joints[4:7, TRUNK_KEYPOINTS[:4]] = np.nan
    placed = place_trunk(rest, joints, pelvis)
    assert np.isnan(placed[4:7]).all()
    found = between(placed, TIMES)
    apart = Rotation.from_rotvec(found[:, :3]).inv() * TURN
    assert apart.magnitude().max() < 1e-6
    np.testing.assert_allclose(found[:, 3:], TIMES[:, None] * [1.0, 0, 0], atol=1e-9)


def test_such_frames_are_usable_near_placed_ones_with_enough_of_the_body():
    _, _, joints = _walk()
    rig, frames, times = ring(2), len(TIMES), TIMES.copy()
    joints[4, TRUNK_KEYPOINTS[:4]] = np.nan  # seen from the side
    joints[5, 5:] = np.nan  # nothing but head and one arm
    joints[11, TRUNK_KEYPOINTS[:4]] = np.nan
    times[11] += 2.0  # nobody near
    seen = Observations(
        "test", rig, np.zeros((frames, 2, 135, 2)), np.zeros((frames, 2, 135)), joints,
        np.ones((frames, 135), int), [b""] * 2 * frames, np.zeros((frames, 2)), [b""] * 2 * frames,
        [None, None], np.zeros(2), np.zeros((frames, 2), int), np.zeros(2), times,
    )  # fmt: skip
    assert np.flatnonzero(~seen.placed).tolist() == [4, 5, 11]
    assert np.flatnonzero(~seen.usable).tolist() == [5, 11]
    nobody = dataclasses.replace(seen, joints=np.full_like(joints, np.nan))
    assert not nobody.usable.any()
