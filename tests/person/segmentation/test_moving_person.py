"""The person's volume at a camera's exposure, with the uncertainty of keypoints and times."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.formats.recordings.synchronise import in_step_sigma
from intercap_core.geometry.camera.triangulation import reproject, spread, triangulate
from intercap_core.person.segmentation.person_volume import (
    MovingPerson,
    build_bones,
    distance_outside,
)
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import stick_person

FPS, SPEED = 30.0, 4.0  # of a wrist, m/s
WRIST = KEYPOINT_INDEX["left_wrist"]
HAND = np.array([WRIST, *range(25, 46)])


def swinging(sets: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints (T, 135, 3) of somebody whose left hand moves ahead, and times."""
    times = np.arange(sets) / FPS
    joints = np.tile(stick_person(), (sets, 1, 1))
    joints[:, HAND, 0] += SPEED * times[:, None]
    return joints, times


def person(sigma_m: float, offset_sigma: float) -> MovingPerson:
    joints, times = swinging()
    scene = {
        "times": times,
        "time_offset": np.array([0.0, 0.012]),
        "time_offset_sigma": np.array([0.0, offset_sigma]),
    }
    return MovingPerson(joints, np.full(joints.shape[:2], sigma_m), scene)  # type: ignore[arg-type]


def test_a_fast_hand_is_where_a_late_camera_sees_it() -> None:
    joints, _ = swinging()
    late = joints[4].copy()
    late[HAND, 0] += 0.012 * SPEED
    tip = late[[WRIST]].astype(np.float32)
    moving = person(0.0, 0.0)
    np.testing.assert_allclose(moving.bones(4, 1), build_bones(late), atol=1e-5)
    np.testing.assert_allclose(moving.bones(4, 0), build_bones(joints[4]), atol=1e-6)
    assert distance_outside(tip, moving.bones(4, 0)) > distance_outside(tip, moving.bones(4, 1)) + 1


def test_margins_include_uncertainty_of_keypoints_and_times() -> None:
    joints, _ = swinging()
    usual = build_bones(joints[4])[:, 8]
    np.testing.assert_allclose(
        person(0.03, 0.0).bones_at(4)[:, 8], np.hypot(usual, 0.03), rtol=1e-5
    )
    # of the hand alone, which moves; a forearm's margin by that of its middle
    fast = person(0.0, in_step_sigma(1 / FPS)).bones(4, 1)[:, 8]
    still = np.isclose(fast, usual, rtol=1e-4)
    assert still.sum() > 10 and (fast[~still] > 0.026).sum() >= 20
    forearm = fast[~still].min()
    assert forearm == pytest.approx(np.hypot(0.018, 0.5 * in_step_sigma(1 / FPS) * SPEED), rel=0.01)
    unknown = person(0.0, np.nan).bones(4, 1)[:, 8]
    np.testing.assert_allclose(unknown, fast, rtol=1e-5)


def test_points_scatter_by_their_stated_deviation() -> None:
    """Triangulated from noisy pixels of four and of two cameras."""
    rig, _ = ring()
    rng = np.random.default_rng(4)
    points = np.array([0.0, 0.0, 2.6]) + rng.uniform(-0.4, 0.4, (4000, 3))
    exact = reproject(points, rig)
    for views in ([0, 1, 3, 4], [0, 2]):
        seen = np.zeros(exact.shape[:2])
        seen[:, views] = 1
        noisy = exact + rng.normal(0, 4, exact.shape)
        found = triangulate(noisy, seen, rig, max_error_px=60)
        off = np.linalg.norm(found.points - points, axis=1) / np.sqrt(3)
        good = np.isfinite(off)
        ratio = np.sqrt(np.mean(off[good] ** 2) / np.mean(spread(found, rig)[good] ** 2))
        assert good.mean() > 0.9 and 0.6 < ratio < 1.6
