"""The subject's joints: keypoints moved to one moment, and middles of shoulders and hips."""

from __future__ import annotations

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.person.subject_joints import at_set_times, fill_middles, triangulate_people
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import seen_by, stick_person

RIG, UP = ring()
TIMES = np.arange(10) / 15
OFFSET = np.array([0.0, 8, -8, 5, -6, 7]) * 1e-3


def _walking(times: np.ndarray) -> np.ndarray:
    """(T, 135, 3), z up: along x at 1.2 m/s, the right hand swinging at up to 2 m/s."""
    points = np.repeat(stick_person()[None], len(times), 0)
    points[:, :, 0] += 1.2 * (times - 0.3)[:, None]
    points[:, 4, 2] += 0.3 * np.sin(2 * np.pi * times)
    return points


def _exposed() -> np.ndarray:
    """(T, C, 135, 3) as each camera sees them when it exposes."""
    views = [seen_by(_walking(TIMES + OFFSET[c]), RIG, UP)[:, c] for c in range(len(RIG))]
    return np.stack(views, 1)


def _error(keypoints: np.ndarray) -> np.ndarray:
    _, found = triangulate_people(keypoints, RIG, min_confidence=0.3, max_error_px=20)
    truth = apply(invert(UP), _walking(TIMES).reshape(-1, 3))
    return np.linalg.norm(found.points - truth, axis=1).reshape(len(TIMES), 135)


def test_rays_of_one_moment_meet():
    seen = _exposed()
    moved = at_set_times(seen, TIMES, OFFSET, RIG, min_confidence=0.3)
    assert np.array_equal(moved[:, 0], seen[:, 0]), "the master's are at the set's time already"
    assert np.array_equal(at_set_times(seen, TIMES, 0 * OFFSET, RIG, min_confidence=0.3), seen)
    assert np.median(_error(moved)) < 0.1 * np.median(_error(seen))
    assert _error(moved)[1:-1].max() < 1e-3


def test_a_swap_and_a_miss_move_no_neighbour():
    seen = _exposed()
    damaged = seen.copy()
    damaged[5, 1, [2, 5]] = seen[5, 1, [5, 2]]  # the shoulders exchanged in one image
    damaged[4, 2, 4, 2] = 0.1
    clean = at_set_times(seen, TIMES, OFFSET, RIG, min_confidence=0.3)
    moved = at_set_times(damaged, TIMES, OFFSET, RIG, min_confidence=0.3)
    away = np.linalg.norm((moved - clean)[..., :2], axis=-1)
    away[5, 1, [2, 5]] = 0
    assert away.max() < 12, "at most the shift of twice the right velocity"
    assert np.array_equal(moved[4, 2, 4], damaged[4, 2, 4])


def test_neck_and_mid_hip_are_filled_by_middles():
    neck, mid_hip, shoulder = (KEYPOINT_INDEX[n] for n in ("neck", "mid_hip", "left_shoulder"))
    true = stick_person()
    points = np.stack([true, true, true])
    points[0, [neck, mid_hip]] = np.nan
    points[1, [neck, shoulder]] = np.nan
    fill_middles(points)
    both = [shoulder, KEYPOINT_INDEX["right_shoulder"]]
    np.testing.assert_allclose(points[0, neck], true[both].mean(0))
    np.testing.assert_allclose(points[0, mid_hip], [0, 0, 0.93])
    assert np.isnan(points[1, neck]).all(), "one shoulder is unknown"
    np.testing.assert_array_equal(points[2], true)
