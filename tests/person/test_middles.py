"""Neck and middle of the hips from shoulders and hips."""

from __future__ import annotations

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.person.subject_joints import fill_middles
from tests.helpers.synthetic_people import stick_person

NECK, MID_HIP = KEYPOINT_NAMES.index("neck"), KEYPOINT_NAMES.index("mid_hip")


def test_unknown_keypoints_are_interpolated():
    true = stick_person()
    points = np.stack([true, true, true])
    points[0, [NECK, MID_HIP]] = np.nan
    points[1, [NECK, KEYPOINT_NAMES.index("left_shoulder")]] = np.nan
    before = points.copy()
    fill_middles(points)
    shoulders = [KEYPOINT_NAMES.index(f"{side}_shoulder") for side in ("left", "right")]
    np.testing.assert_allclose(points[0, NECK], true[shoulders].mean(0))
    np.testing.assert_allclose(points[0, MID_HIP], [0, 0, 0.93])
    assert np.isnan(points[1, NECK]).all(), "one shoulder is not known"
    np.testing.assert_array_equal(points[2], before[2])
