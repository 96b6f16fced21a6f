"""Feet on a beam, on stairs, on a slope; the floor that is stated, and what denies it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.scene.ground import (
    FOOT_HEIGHT_M,
    describe_raised_feet,
    fit_ground_to_feet,
    stated_ground,
)
from intercap_core.scene.up import check_stated_up, compare_with_stated, rough_up, trunk_direction
from tests.helpers.synthetic_capture import ring

RIG, UP = ring()
MASTER_UP = UP[2, :3]
ORIGIN = apply(invert(UP), np.zeros((1, 3)))[0]
NO_GRAVITY = np.full((6, 3), np.nan)
GRAVITY = np.einsum("cji,j->ci", RIG.master_from_colour[:, :3, :3], -MASTER_UP)
BY_CAMERAS, BY_GRAVITY = rough_up(RIG, NO_GRAVITY), rough_up(RIG, GRAVITY)


def feet_at(places: np.ndarray) -> np.ndarray:
    """(T, 6, 3), master frame: one foot stands at each place (T, 3) of the z-up world."""
    rng = np.random.default_rng(0)
    feet = places[:, None] + (0, 0, FOOT_HEIGHT_M) + rng.normal(0, 0.004, (len(places), 6, 3))
    feet[:, 3:, 2] += 0.12
    return apply(invert(UP), feet.reshape(-1, 3)).reshape(feet.shape)


def ground_height(ground) -> float:
    return float(apply(UP, ground.point[None])[0, 2])


def walk(height: np.ndarray) -> np.ndarray:
    """Places (T, 3) along a curve, at the heights (T,)."""
    way = np.linspace(-1.5, 1.5, len(height))
    return np.column_stack([way, 0.8 * np.sin(2 * way), height])


@pytest.mark.parametrize("up", [BY_CAMERAS, BY_GRAVITY], ids=["cameras", "gravity"])
@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
@pytest.mark.parametrize("beam_m", [0.12, 0.3])
def test_floor_is_the_lowest_level_below_a_beam(up, share, beam_m):
    height = np.where(np.arange(80) % 20 < 20 * share, beam_m, 0.0)
    ground = fit_ground_to_feet(feet_at(walk(height)), up)
    assert ground.source == "feet" and abs(ground_height(ground)) < 0.02
    assert np.degrees(np.arccos(min(1, ground.normal @ MASTER_UP))) < 1
    assert "do not stand on one plane" in ground.note and f"{beam_m:.2f} m above" in ground.note


@pytest.mark.parametrize("up", [BY_CAMERAS, BY_GRAVITY], ids=["cameras", "gravity"])
def test_stairs_do_not_tilt_the_floor(up):
    step = np.arange(90) // 15  # 6 treads of 0.3 m by 0.17 m, and the floor before them
    rng = np.random.default_rng(1)
    places = np.column_stack(
        [0.3 * step + rng.uniform(-0.12, 0.12, 90), rng.uniform(-0.4, 0.4, 90), 0.17 * step]
    )
    ground = fit_ground_to_feet(feet_at(places), up)
    assert abs(ground_height(ground)) < 0.03 and "one plane" in ground.note
    assert np.degrees(np.arccos(min(1, ground.normal @ MASTER_UP))) < 6


def test_a_hint_that_is_tilted_is_no_staircase():
    feet = feet_at(walk(np.zeros(80)))
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(np.radians(6) * UP[1, :3]).as_matrix()
    ground = fit_ground_to_feet(apply(turn, feet.reshape(-1, 3)).reshape(feet.shape), BY_CAMERAS)
    assert ground.found and ground.note == ""


def test_noise_about_one_level_does_not_lower_the_floor():
    height = np.random.default_rng(5).normal(0, 0.06, 120)
    ground = fit_ground_to_feet(feet_at(walk(height)), BY_GRAVITY)
    assert abs(ground_height(ground)) < 0.02


def test_feet_off_a_measured_floor_are_reported():
    floor = stated_ground(MASTER_UP, ORIGIN)
    assert describe_raised_feet(feet_at(walk(np.zeros(60))), floor) == ""
    on_beam = np.where(np.arange(60) < 20, 0.3, 0.0)
    said = describe_raised_feet(feet_at(walk(on_beam)), floor)
    assert "33 % of the sets" in said and "0.30 m above" in said
    assert "0.50 m below" in describe_raised_feet(feet_at(walk(np.full(60, -0.5))), floor)
    assert describe_raised_feet(np.full((60, 6, 3), np.nan), floor) == ""


def test_a_stated_up_is_the_hint_where_no_sensor_measured_it():
    leaning = Rotation.from_rotvec(np.radians(8) * UP[0, :3]).apply(MASTER_UP)
    hint = rough_up(RIG, NO_GRAVITY, leaning)
    assert hint.source == "stated" and np.array_equal(hint.direction, leaning)
    assert rough_up(RIG, GRAVITY, leaning).source == "gravity"
    assert rough_up(RIG, NO_GRAVITY, np.full(3, np.nan)).source == "cameras"
    still = np.repeat(feet_at(np.zeros((1, 3))), 30, 0)  # feet in one place tell no tilt
    assert not fit_ground_to_feet(still, BY_CAMERAS).found
    ground = fit_ground_to_feet(still, rough_up(RIG, NO_GRAVITY, MASTER_UP))
    assert ground.found and np.array_equal(ground.normal, MASTER_UP)
    tilted = fit_ground_to_feet(feet_at(walk(np.zeros(80))), hint)
    assert "8 degrees from the stated up" in tilted.note


def upright(angle_deg: float = 0.0) -> np.ndarray:
    """Joints (10, 25, 3) of someone whose trunk leans by an angle."""
    joints = np.full((10, 25, 3), np.nan)
    joints[:, 8] = ORIGIN
    lean = Rotation.from_rotvec(np.radians(angle_deg) * UP[0, :3])
    joints[:, 1] = ORIGIN + 0.5 * lean.apply(MASTER_UP)
    return joints


def test_wrong_axis_is_rejected_by_cameras_and_person():
    trunk = trunk_direction(upright())
    assert check_stated_up(MASTER_UP, RIG, NO_GRAVITY, trunk) == []
    assert check_stated_up(MASTER_UP, RIG, NO_GRAVITY, np.full(3, np.nan)) == []
    assert check_stated_up(np.full(3, np.nan), RIG, NO_GRAVITY, trunk) == []
    for wrong in (UP[0, :3], -MASTER_UP):
        with pytest.raises(UserError, match=r"calibration_up is .* from the person's trunk"):
            check_stated_up(wrong, RIG, NO_GRAVITY, trunk)
    # Cameras that hang on their side see a person who stands upright, and the other way about.
    lying = trunk_direction(upright(90))
    assert "trunk" in check_stated_up(MASTER_UP, RIG, NO_GRAVITY, lying)[0]
    assert "cameras" in check_stated_up(UP[1, :3], RIG, NO_GRAVITY, UP[1, :3])[0]
    assert "gravity sensors" in check_stated_up(UP[0, :3], RIG, GRAVITY, trunk)[0]


def test_a_measured_floor_is_compared_with_the_stated_one():
    tilted = Rotation.from_rotvec(np.radians(7) * UP[0, :3]).apply(MASTER_UP)
    raised = ORIGIN + 0.2 * MASTER_UP
    nothing = np.full(3, np.nan)
    assert compare_with_stated(ORIGIN, MASTER_UP, MASTER_UP, ORIGIN, ORIGIN) == []
    assert compare_with_stated(ORIGIN, MASTER_UP, nothing, nothing, ORIGIN) == []
    assert compare_with_stated(ORIGIN, tilted, MASTER_UP, ORIGIN, ORIGIN) == [
        "the floor is tilted by 7.0 degrees from the stated up"
    ]
    assert compare_with_stated(raised, MASTER_UP, MASTER_UP, ORIGIN, ORIGIN) == [
        "the floor is 0.20 m above the stated one"
    ]
