"""The floor: fitted among furniture, annotated, stated, or under the feet; the z-up frame."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.scene.ground import (
    FOOT_HEIGHT_M,
    NO_GROUND,
    GroundPlane,
    annotated_ground,
    describe_raised_feet,
    fit_ground,
    fit_ground_to_feet,
    standing_on_floor,
    stated_ground,
    zup_from_master,
)
from intercap_core.scene.up import (
    CAMERA_ROLL_DEG,
    FOOT_PLACE_M,
    LevelDirections,
    UpDirection,
    balance_levels,
    camera_levels,
    check_stated_up,
    compare_with_stated,
    degrees_between,
    estimate_up,
    floor_levels,
    rough_up,
    trunk_direction,
)
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import walking

RIG, UP = ring()
SOUTH, EAST, MASTER_UP = UP[:3, :3]  # axes of the room in the master's frame
ORIGIN = invert(UP)[:3, 3]
UNKNOWN = np.full(3, np.nan)
NO_GRAVITY = np.full((6, 3), np.nan)
OPPOSITE = Rig(RIG.cameras[::3])  # two cameras that look at each other
GRAVITY = np.einsum("cji,j->ci", RIG.master_from_colour[:, :3, :3], -MASTER_UP)
BY_GRAVITY, BY_CAMERAS = rough_up(RIG, GRAVITY), rough_up(RIG, NO_GRAVITY)
HINTS = pytest.mark.parametrize("up", [BY_GRAVITY, BY_CAMERAS], ids=["gravity", "cameras"])


def tilted(axis: np.ndarray, degrees: float) -> Rotation:
    return Rotation.from_rotvec(np.radians(degrees) * axis)


def errors(ground: GroundPlane) -> tuple[float, float]:
    """Tilt, degrees, and height, metres, of a plane over the room's floor."""
    return degrees_between(ground.normal, MASTER_UP), float(apply(UP, ground.point[None])[0, 2])


# --- fitted to depth -----------------------------------------------------------------------------

Cloud = tuple[np.ndarray, np.ndarray]
"""Points and normals (N, 3)."""


def room(seed: int, table: bool = True, extra: np.ndarray | None = None) -> Cloud:
    """Noisy points and normals, master frame: a floor, a larger table, a wall, outliers.

    ``extra``: (N, 3) level points, z up.
    """
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(-1.5, 1.5, (6000, 2)), np.zeros(6000)])
    top = np.column_stack([rng.uniform(-1.5, 1.5, (9000, 2)), np.full(9000, 0.7)])
    level = np.concatenate([floor, top]) if table else floor
    wall = np.column_stack(
        [np.full(5000, 1.8), rng.uniform(-2, 2, 5000), rng.uniform(0, 2.5, 5000)]
    )
    clutter = rng.uniform(-1.5, 1.5, (3000, 3)) * (1, 1, 0.8) + (0, 0, 1.15)
    extra = np.zeros((0, 3)) if extra is None else extra
    points = np.concatenate([level, wall, clutter, extra])
    normals = np.concatenate(
        [
            np.tile([0, 0, 1.0], (len(level), 1)),
            np.tile([-1.0, 0, 0], (5000, 1)),
            rng.normal(size=(3000, 3)),
            np.tile([0, 0, 1.0], (len(extra), 1)),
        ]
    )
    points = points + rng.normal(0, 0.003, points.shape)
    normals += rng.normal(0, 0.03, points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    to_master = invert(UP)
    return apply(to_master, points), normals @ to_master[:3, :3].T


def platform(height_m: float, half_m: float) -> Cloud:
    """A room whose level platform hides most of a floor of 3 by 3 m; master frame."""
    rng = np.random.default_rng(1)
    flat = rng.uniform(-1.5, 1.5, (10000, 2))
    points = np.column_stack([flat, np.where((np.abs(flat) < half_m).all(1), height_m, 0.0)])
    points += rng.normal(0, 0.003, points.shape)
    return apply(invert(UP), points), np.tile(MASTER_UP, (len(points), 1))


def fitted(cloud: Cloud, up=BY_GRAVITY) -> GroundPlane:
    return fit_ground(*cloud, RIG, up, tolerance_m=0.015, cell_m=0.03)


@HINTS
@pytest.mark.parametrize("seed", range(3))
def test_floor_is_fitted_below_a_larger_table(seed, up):
    ground = fitted(room(seed), up)
    angle, height = errors(ground)
    assert ground.found and angle < 0.05 and abs(height) < 0.0005
    assert 5500 < ground.inliers < 6500 and 0.002 < ground.rms < 0.004


def test_room_without_a_visible_floor_has_none():
    points, normals = room(0)
    height = apply(UP, points)[:, 2]
    seen = (height > 0.2) & ((height < 0.6) | (height > 0.8))
    assert not fitted((points[seen], normals[seen])).found
    empty = fitted((np.zeros((0, 3)), np.zeros((0, 3))))
    assert not empty.found and np.isnan(empty.normal).all()


@pytest.mark.parametrize("height_m", [0.15, 0.17, 0.5])
def test_floor_is_below_a_larger_platform(height_m):
    ground = fitted(platform(height_m, 1.35))  # 7.3 of 9 square metres
    angle, height = errors(ground)
    assert angle < 0.1 and abs(height) < 0.002
    assert f"{height_m:.2f} m above the floor" in ground.note


def test_small_surface_far_below_is_no_floor():
    ground = fitted(platform(0.3, 1.49))  # a rim of 0.12 square metres
    assert abs(errors(ground)[1] - 0.3) < 0.002 and ground.note == ""


@pytest.mark.parametrize("height_m", [0.04, 0.1])
def test_beam_does_not_tilt_the_floor(height_m):
    low, high = (-1.5, 0.6, height_m), (1.5, 0.75, height_m)
    beam = np.random.default_rng(2).uniform(low, high, (500, 3))
    angle, height = errors(fitted(room(0, False, beam), BY_CAMERAS))
    assert angle < 0.05 and abs(height) < 0.0005


def test_misplaced_camera_adds_no_lower_floor():
    rng = np.random.default_rng(4)
    again = np.column_stack([rng.uniform(-1.2, 1.2, (1200, 2)), np.full(1200, -0.2)])
    ground = fitted(room(0, False, again))
    assert abs(errors(ground)[1]) < 0.001 and ground.note == ""


# --- annotated and stated ------------------------------------------------------------------------


def test_annotated_points_override_and_must_span_a_plane():
    points, _ = room(0)
    floor = apply(invert(UP), np.array([[0.5, 0, 0.01], [-0.5, 0.5, 0.01], [0, -0.8, 0.01]]))
    ground = annotated_ground(floor, points, BY_CAMERAS, tolerance_m=0.015)
    angle, height = errors(ground)
    assert ground.source == "annotated" and angle < 1e-3 and abs(height - 0.01) < 1e-9
    assert ground.inliers > 5000
    line = apply(invert(UP), np.array([[0, 0, 0.0], [0.5, 0, 0], [1.0, 0.001, 0]]))
    with pytest.raises(UserError, match="lie on one line"):
        annotated_ground(line, points, BY_CAMERAS, tolerance_m=0.015)


def test_up_is_measured_else_stated_else_by_cameras():
    leaning = tilted(SOUTH, 8).apply(MASTER_UP)
    hint = rough_up(RIG, NO_GRAVITY, leaning)
    assert hint.source == "stated" and np.array_equal(hint.direction, leaning)
    for gravity, stated, source in (
        (GRAVITY, leaning, "gravity"),
        (NO_GRAVITY, UNKNOWN, "cameras"),
    ):
        hint = rough_up(RIG, gravity, stated)
        assert hint.source == source
        np.testing.assert_allclose(hint.direction, MASTER_UP, atol=1e-6)
    one_wild = GRAVITY.copy()
    one_wild[2] = -one_wild[2]
    assert rough_up(RIG, one_wild).direction @ MASTER_UP > 0.97


def trunk(lean_deg: float = 0.0) -> np.ndarray:
    """Direction (3,) of a trunk that leans by an angle."""
    joints = np.full((10, 25, 3), np.nan)
    joints[:, 8] = ORIGIN
    joints[:, 1] = ORIGIN + 0.5 * tilted(SOUTH, lean_deg).apply(MASTER_UP)
    return trunk_direction(joints)


def test_wrong_axis_is_rejected_by_cameras_and_person():
    for stated, person in ((MASTER_UP, trunk()), (MASTER_UP, UNKNOWN), (UNKNOWN, trunk())):
        assert check_stated_up(stated, RIG, NO_GRAVITY, person) == []
    for wrong in (SOUTH, -MASTER_UP):
        with pytest.raises(UserError, match=r"calibration_up is .* from the person's trunk"):
            check_stated_up(wrong, RIG, NO_GRAVITY, trunk())
    # one of the two agrees: cameras on their side, or a person who lies
    assert "trunk" in check_stated_up(MASTER_UP, RIG, NO_GRAVITY, trunk(90))[0]
    assert "cameras" in check_stated_up(EAST, RIG, NO_GRAVITY, EAST)[0]
    assert "gravity sensors" in check_stated_up(SOUTH, RIG, GRAVITY, trunk())[0]


def test_measured_floor_is_compared_with_the_stated_one():
    def notes(point, normal, up=MASTER_UP, floor=ORIGIN):
        return compare_with_stated(point, normal, up, floor, ORIGIN)

    assert notes(ORIGIN, MASTER_UP) == notes(ORIGIN, MASTER_UP, UNKNOWN, UNKNOWN) == []
    leaning = tilted(SOUTH, 7).apply(MASTER_UP)
    assert notes(ORIGIN, leaning) == ["the floor is tilted by 7.0 degrees from the stated up"]
    raised = ORIGIN + 0.2 * MASTER_UP
    assert notes(raised, MASTER_UP) == ["the floor is 0.20 m above the stated one"]


def test_z_up_frame_has_the_floor_at_zero_under_the_middle():
    transform = zup_from_master(fitted(room(0)), RIG, BY_GRAVITY)
    np.testing.assert_allclose(transform[:3, :3] @ transform[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(transform[:3, :3]) > 0
    world = apply(invert(UP), np.array([[0, 0, 0.0], [0, 0, 1]]))
    np.testing.assert_allclose(apply(transform, world), [[0, 0, 0], [0, 0, 1]], atol=0.002)
    ahead = transform[:3, :3] @ [0, 0, 1]
    assert abs(ahead[0]) < 1e-9 and ahead[1] > 0
    without = zup_from_master(NO_GROUND, RIG, BY_CAMERAS)
    np.testing.assert_allclose(without[:3, 3], 0, atol=1e-12)
    assert without[2, :3] @ MASTER_UP > 0.999


# --- under the feet ------------------------------------------------------------------------------


def feet_at(places: np.ndarray) -> np.ndarray:
    """(T, 6, 3), master frame: one foot stands at each place (T, 3) of the z-up world."""
    rng = np.random.default_rng(0)
    feet = places[:, None] + (0, 0, FOOT_HEIGHT_M) + rng.normal(0, 0.004, (len(places), 6, 3))
    feet[:, 3:, 2] += 0.12
    return apply(invert(UP), feet.reshape(-1, 3)).reshape(feet.shape)


def walk(height: np.ndarray | int, bend: float = 0.8) -> np.ndarray:
    """Feet (T, 6, 3) along a curve, at the heights (T,), or at 0 for a number of sets."""
    height = np.zeros(height) if isinstance(height, int) else height
    along = np.linspace(-1.5, 1.5, len(height))
    return feet_at(np.column_stack([along, bend * np.sin(2 * along), height]))


@HINTS
@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
@pytest.mark.parametrize("beam_m", [0.12, 0.3])
def test_floor_is_the_lowest_level_below_a_beam(up, share, beam_m):
    ground = fit_ground_to_feet(walk(np.where(np.arange(80) % 20 < 20 * share, beam_m, 0.0)), up)
    angle, height = errors(ground)
    assert ground.source == "feet" and abs(height) < 0.02 and angle < 1
    assert "do not stand on one plane" in ground.note and f"{beam_m:.2f} m above" in ground.note


@HINTS
def test_stairs_do_not_tilt_the_floor(up):
    step = np.arange(90) // 15  # 6 treads of 0.3 m by 0.17 m, and the floor before them
    rng = np.random.default_rng(1)
    places = np.column_stack(
        [0.3 * step + rng.uniform(-0.12, 0.12, 90), rng.uniform(-0.4, 0.4, 90), 0.17 * step]
    )
    ground = fit_ground_to_feet(feet_at(places), up)
    angle, height = errors(ground)
    assert abs(height) < 0.03 and angle < 6 and "one plane" in ground.note


@HINTS
def test_unmeasured_floor_is_under_the_feet(up):
    feet = walk(80)
    feet[::7] = np.nan
    ground = fit_ground_to_feet(feet, up)
    angle, height = errors(ground)
    assert ground.source == "feet" and ground.note == "" and ground.inliers > 60
    assert angle < 0.5 and abs(height) < 0.01
    assert fit_ground_to_feet(np.repeat(feet[1:2], 40, 0), up).found
    assert not fit_ground_to_feet(np.full_like(feet, np.nan), up).found


def test_tilted_hint_is_no_staircase():
    feet = tilted(EAST, 6).apply(walk(80).reshape(-1, 3)).reshape(80, 6, 3)
    ground = fit_ground_to_feet(feet, BY_CAMERAS)
    assert ground.found and ground.note == ""


def up_of(rig: Rig, evidence: list[LevelDirections]) -> UpDirection:
    """Up direction by the cameras and further evidence."""
    return estimate_up(BY_CAMERAS, [*camera_levels(rig, NO_GRAVITY[: len(rig)]), *evidence])


@pytest.mark.parametrize(
    ("axis", "limit_deg"), [(SOUTH, 2.5), (EAST, 0.5)], ids=["along", "across"]
)
def test_walk_along_a_line_shows_the_tilt_along_it(axis, limit_deg):
    """The cameras are 2 degrees off. About the line they decide, across it the feet."""
    turn = tilted(axis, 2)
    feet = turn.apply(walk(80, bend=0).reshape(-1, 3)).reshape(80, 6, 3)
    standing, _ = standing_on_floor(feet, BY_CAMERAS.direction)
    up = up_of(RIG, floor_levels(standing, FOOT_PLACE_M))
    assert up.source == "cameras, feet"
    assert degrees_between(up.direction, turn.apply(MASTER_UP)) < limit_deg


def rolled(rig: Rig, degrees: np.ndarray) -> Rig:
    """Each camera turned about its optical axis."""
    turns = np.tile(np.eye(4), (len(rig), 1, 1))
    turns[:, :3, :3] = Rotation.from_euler("z", degrees[:, None], degrees=True).as_matrix()
    return rig.moved(rig.master_from_colour @ turns)


def test_stated_deviation_of_up_covers_rolls_and_odd_mounts():
    """Cameras roll by 3 degrees; one stands on its side; two opposite ones leave an axis open."""
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(50):
        up = up_of(rolled(RIG, rng.normal(0, CAMERA_ROLL_DEG, 6)), [])
        ratios.append(degrees_between(up.direction, MASTER_UP) / up.deviation_deg)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.2
    on_its_side = up_of(rolled(RIG, np.array([0, 0, 90.0, 0, 0, 0])), [])
    assert degrees_between(on_its_side.direction, MASTER_UP) < 1
    assert up_of(OPPOSITE, []).deviation_deg > 10 > 3 > up_of(RIG, []).deviation_deg


def test_standing_person_shows_up_and_a_sitting_one_does_not():
    person = apply(invert(UP), walking(40, np.zeros(2), np.array([0.02, 0])))
    levels = balance_levels(person)
    assert levels[0].source == "balance" and np.abs(levels[0].directions @ MASTER_UP).max() < 0.15
    two = up_of(OPPOSITE, levels)
    assert degrees_between(two.direction, MASTER_UP) < 8 and two.deviation_deg < 8
    legs = [KEYPOINT_NAMES.index(f"{s}_{p}") for s in ("left", "right") for p in ("knee", "ankle")]
    above_knees = np.setdiff1d(np.arange(19), legs)
    person[:, above_knees] += 0.43 * (SOUTH - MASTER_UP)  # length of the thigh
    assert balance_levels(person) == []


def test_gravity_sensors_outweigh_tilted_cameras():
    """All cameras were calibrated with a tilt of 6 degrees against their own sensors' down."""
    turn = tilted(SOUTH, 6)
    evidence = camera_levels(RIG, np.einsum("cji,j->ci", RIG.master_from_colour[:, :3, :3],
                                            turn.apply(-MASTER_UP)))  # fmt: skip
    up = estimate_up(BY_CAMERAS, evidence)
    assert up.source == "gravity, cameras"
    assert degrees_between(up.direction, turn.apply(MASTER_UP)) < 2


def test_stated_up_is_the_normal_and_compared_with_the_feet():
    still = np.repeat(walk(1), 30, 0)
    ground = fit_ground_to_feet(still, rough_up(RIG, NO_GRAVITY, MASTER_UP))
    assert ground.found and np.array_equal(ground.normal, MASTER_UP)
    leaning = rough_up(RIG, NO_GRAVITY, tilted(SOUTH, 8).apply(MASTER_UP))
    assert "8 degrees from the stated up" in fit_ground_to_feet(walk(80), leaning).note


def test_noise_about_one_level_does_not_lower_the_floor():
    ground = fit_ground_to_feet(walk(np.random.default_rng(5).normal(0, 0.06, 120)), BY_GRAVITY)
    assert abs(errors(ground)[1]) < 0.02


def test_feet_off_a_measured_floor_are_reported():
    floor = stated_ground(MASTER_UP, ORIGIN)
    assert describe_raised_feet(walk(60), floor) == ""
    note = describe_raised_feet(walk(np.where(np.arange(60) < 20, 0.3, 0.0)), floor)
    assert "33 % of the sets" in note and "0.30 m above" in note
    assert "0.50 m below" in describe_raised_feet(walk(np.full(60, -0.5)), floor)
    assert describe_raised_feet(np.full((60, 6, 3), np.nan), floor) == ""
