"""The floor among furniture, clutter and outliers; annotated floors; the z-up frame."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.scene.ground import (
    FOOT_HEIGHT_M,
    NO_GROUND,
    annotated_ground,
    fit_ground,
    fit_ground_to_feet,
    zup_from_master,
)
from intercap_core.scene.up import rough_up
from tests.helpers.synthetic_capture import ring

RIG, UP = ring()
NO_GRAVITY = np.full((6, 3), np.nan)
GRAVITY = np.einsum("cji,j->ci", RIG.master_from_colour[:, :3, :3], -UP[2, :3])
BY_GRAVITY, BY_CAMERAS = rough_up(RIG, GRAVITY), rough_up(RIG, NO_GRAVITY)
CELL_M = 0.03


def room(seed: int, table: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Noisy points and normals, master frame: a floor, a larger table, a wall, outliers."""
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(-1.5, 1.5, (6000, 2)), np.zeros(6000)])
    parts, normals = [floor], [np.tile([0, 0, 1.0], (6000, 1))]
    if table:
        top = np.column_stack([rng.uniform(-1.5, 1.5, (9000, 2)), np.full(9000, 0.7)])
        parts.append(top)
        normals.append(np.tile([0, 0, 1.0], (9000, 1)))
    wall = np.column_stack(
        [np.full(5000, 1.8), rng.uniform(-2, 2, 5000), rng.uniform(0, 2.5, 5000)]
    )
    parts.append(wall)
    normals.append(np.tile([-1.0, 0, 0], (5000, 1)))
    clutter = rng.uniform(-1.5, 1.5, (3000, 3)) * (1, 1, 0.8) + (0, 0, 1.15)
    parts.append(clutter)
    directions = rng.normal(size=(3000, 3))
    normals.append(directions)
    points = np.concatenate(parts) + rng.normal(0, 0.003, (sum(map(len, parts)), 3))
    facing = np.concatenate(normals) + rng.normal(0, 0.03, points.shape)
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    to_master = invert(UP)
    return apply(to_master, points), facing @ to_master[:3, :3].T


def errors(ground) -> tuple[float, float]:
    angle = np.degrees(np.arccos(min(1.0, float(ground.normal @ UP[2, :3]))))
    return angle, abs(float(apply(UP, ground.point[None])[0, 2]))


@pytest.mark.parametrize("up", [BY_GRAVITY, BY_CAMERAS], ids=["gravity", "no gravity"])
@pytest.mark.parametrize("seed", range(3))
def test_the_floor_not_the_larger_table_is_found(seed, up):
    points, normals = room(seed)
    ground = fit_ground(points, normals, RIG, up, tolerance_m=0.015, cell_m=CELL_M)
    angle, offset = errors(ground)
    assert ground.found and angle < 0.05 and offset < 0.0005
    assert 5500 < ground.inliers < 6500 and 0.002 < ground.rms < 0.004


def test_a_room_without_a_floor_in_sight_has_none():
    points, normals = room(0)
    height = apply(UP, points)[:, 2]
    seen = (height > 0.2) & ((height < 0.6) | (height > 0.8))
    found = fit_ground(
        points[seen], normals[seen], RIG, BY_GRAVITY, tolerance_m=0.015, cell_m=CELL_M
    )
    assert not found.found
    empty = fit_ground(
        np.zeros((0, 3)), np.zeros((0, 3)), RIG, BY_GRAVITY, tolerance_m=0.015, cell_m=CELL_M
    )
    assert not empty.found and np.isnan(empty.normal).all()


def test_up_is_measured_or_guessed_from_the_ring():
    for gravity in (GRAVITY, NO_GRAVITY):
        np.testing.assert_allclose(rough_up(RIG, gravity).direction, UP[2, :3], atol=1e-6)
    one_wild = GRAVITY.copy()
    one_wild[2] = -one_wild[2]
    assert rough_up(RIG, one_wild).direction @ UP[2, :3] > 0.97


def test_annotated_points_override_and_must_span_a_plane():
    points, _ = room(0)
    floor = apply(invert(UP), np.array([[0.5, 0, 0.01], [-0.5, 0.5, 0.01], [0, -0.8, 0.01]]))
    ground = annotated_ground(floor, points, BY_CAMERAS, tolerance_m=0.015)
    angle, offset = errors(ground)
    assert ground.source == "annotated" and angle < 1e-3 and abs(offset - 0.01) < 1e-9
    assert ground.inliers > 5000
    line = apply(invert(UP), np.array([[0, 0, 0.0], [0.5, 0, 0], [1.0, 0.001, 0]]))
    with pytest.raises(UserError, match="lie on one line"):
        annotated_ground(line, points, BY_CAMERAS, tolerance_m=0.015)


def test_z_up_puts_the_floor_at_zero_under_the_middle():
    points, normals = room(0)
    ground = fit_ground(points, normals, RIG, BY_GRAVITY, tolerance_m=0.015, cell_m=CELL_M)
    transform = zup_from_master(ground, RIG, BY_GRAVITY)
    np.testing.assert_allclose(transform[:3, :3] @ transform[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(transform[:3, :3]) > 0
    world = apply(invert(UP), np.array([[0, 0, 0.0], [0, 0, 1]]))
    np.testing.assert_allclose(apply(transform, world), [[0, 0, 0], [0, 0, 1]], atol=0.002)
    ahead = transform[:3, :3] @ [0, 0, 1]
    assert abs(ahead[0]) < 1e-9 and ahead[1] > 0
    without = zup_from_master(NO_GROUND, RIG, BY_CAMERAS)
    np.testing.assert_allclose(without[:3, 3], 0, atol=1e-12)
    assert without[2, :3] @ UP[2, :3] > 0.999


def walking_feet(sets: int = 40) -> np.ndarray:
    """(T, 6, 3), master frame: one foot stands, the other swings; every seventh set is lost."""
    rng = np.random.default_rng(3)
    feet = np.zeros((sets, 6, 3))
    way = np.linspace(-1.5, 1.5, sets)
    feet[..., 0] = way[:, None] + np.tile([0.2, 0.17, -0.05], 2)
    feet[..., 1] = 0.8 * np.sin(2 * way)[:, None] + np.repeat([0.1, -0.1], 3)
    lifted = np.where((np.arange(sets) // 5 % 2)[:, None] == np.repeat([0, 1], 3), 0.12, 0.0)
    feet[..., 2] = FOOT_HEIGHT_M + lifted + np.tile([0, 0, 0.008], 2)
    feet += rng.normal(0, 0.003, feet.shape)
    feet[::7] = np.nan
    return apply(invert(UP), feet.reshape(-1, 3)).reshape(feet.shape)


def test_walk_along_a_line_shows_the_tilt_along_it():
    """The cameras' own up is 2 degrees off along the line and 2 across it."""
    feet = apply(UP, walking_feet().reshape(-1, 3)).reshape(40, 6, 3)
    feet[..., 1] = np.repeat([0.1, -0.1], 3)  # no farther than one foot beside the other
    feet = apply(invert(UP), feet.reshape(-1, 3)).reshape(feet.shape)
    for axis in (0, 1):
        turn = Rotation.from_rotvec(np.radians(2) * UP[axis, :3]).as_matrix()
        about = np.eye(4)
        about[:3, :3] = turn
        ground = fit_ground_to_feet(
            apply(about, feet.reshape(-1, 3)).reshape(feet.shape), BY_CAMERAS
        )
        off = np.degrees(np.arccos(min(1, ground.normal @ turn @ UP[2, :3])))
        assert ground.source == "feet"
        # turned about the line the hint stays; about what is across it, the feet tell
        assert off < (2.5 if axis == 0 else 0.5)


def test_unmeasured_floor_is_under_the_feet():
    feet = walking_feet()
    for up in (BY_GRAVITY, BY_CAMERAS):
        ground = fit_ground_to_feet(feet, up)
        assert ground.note == ""
        assert ground.source == "feet" and ground.found and ground.inliers > 25
        assert np.degrees(np.arccos(min(1, ground.normal @ UP[2, :3]))) < 0.5
        assert abs(apply(UP, ground.point[None])[0, 2]) < 0.01
    still = np.repeat(feet[1:2], 40, 0)  # without gravity one place shows no tilt
    assert fit_ground_to_feet(still, BY_GRAVITY).found
    assert not fit_ground_to_feet(still, BY_CAMERAS).found
    assert not fit_ground_to_feet(np.full_like(feet, np.nan), BY_GRAVITY).found


def platform(height_m: float, half_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A room whose level platform hides most of a floor of 3 by 3 m; master frame."""
    rng = np.random.default_rng(1)
    flat = rng.uniform(-1.5, 1.5, (10000, 2))
    on = (np.abs(flat) < half_m).all(1)
    points = np.column_stack([flat, np.where(on, height_m, 0.0)])
    points += rng.normal(0, 0.003, points.shape)
    normals = np.tile(UP[2, :3], (len(points), 1))
    return apply(invert(UP), points), normals


@pytest.mark.parametrize("height_m", [0.15, 0.17, 0.5])
def test_the_floor_is_below_a_platform_that_is_larger(height_m):
    points, normals = platform(height_m, 1.35)  # 7.3 of 9 square metres
    ground = fit_ground(points, normals, RIG, BY_GRAVITY, tolerance_m=0.015, cell_m=CELL_M)
    angle, offset = errors(ground)
    assert angle < 0.1 and offset < 0.002
    assert f"{height_m:.2f} m above the floor" in ground.note


def test_small_surface_far_below_is_no_floor():
    points, normals = platform(0.3, 1.49)  # a rim of 0.12 square metres
    ground = fit_ground(points, normals, RIG, BY_GRAVITY, tolerance_m=0.015, cell_m=CELL_M)
    assert abs(errors(ground)[1] - 0.3) < 0.002 and ground.note == ""


@pytest.mark.parametrize("height_m", [0.04, 0.1])
def test_a_beam_does_not_bend_the_floor(height_m):
    points, normals = room(0, table=False)
    beam = np.random.default_rng(2).uniform((-1.5, 0.6, 0), (1.5, 0.75, 0), (500, 3))
    beam[:, 2] = height_m
    points = np.concatenate([points, apply(invert(UP), beam)])
    normals = np.concatenate([normals, np.tile(UP[2, :3], (500, 1))])
    ground = fit_ground(points, normals, RIG, BY_CAMERAS, tolerance_m=0.015, cell_m=CELL_M)
    angle, offset = errors(ground)
    assert angle < 0.05 and offset < 0.0005


def test_misplaced_camera_adds_no_lower_floor():
    points, normals = room(0, table=False)
    rng = np.random.default_rng(4)
    again = np.column_stack([rng.uniform(-1.2, 1.2, (1200, 2)), np.full(1200, -0.2)])
    points = np.concatenate([points, apply(invert(UP), again)])
    normals = np.concatenate([normals, np.tile(UP[2, :3], (1200, 1))])
    ground = fit_ground(points, normals, RIG, BY_GRAVITY, tolerance_m=0.015, cell_m=CELL_M)
    assert errors(ground)[1] < 0.001 and ground.note == ""
