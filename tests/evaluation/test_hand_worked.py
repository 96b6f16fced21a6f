"""Every measure on a case small enough to work out by hand."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.entries import ContinuousSymmetry, Symmetry
from intercap_core.evaluation import body, contact, flags, motion, object_pose
from intercap_core.evaluation.proximity import (
    BodySurface,
    MeasuredCloud,
    PosedObject,
    seen_by_cameras,
)
from intercap_core.evaluation.scene_errors import displacement, rig_centre
from intercap_core.flags import OF_OBJECT, PARTS, Flags
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.surface_tree import SurfaceTree
from intercap_core.geometry.rigid.surfaces import face_normals, sample_surface
from intercap_core.geometry.rigid.symmetry import SymmetryGroup

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
NONE = SymmetryGroup.none()
ROUND = SymmetryGroup.from_settings(
    Symmetry(continuous=(ContinuousSymmetry(axis=(0.0, 0.0, 1.0)),))
)
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])


def _turn(axis: str, degrees: float) -> np.ndarray:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def _box(side: float) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.box((side, side, side))
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def test_vertex_and_joint_errors_are_mean_distances() -> None:
    vertices = np.array([[[0.0, 0, 0], [1, 0, 0]]])
    moved = vertices + np.array([[[0, 0.03, 0.04], [0, 0, 0.01]]])
    assert body.vertex_error(moved, vertices) == pytest.approx([0.03])
    joints = np.zeros((1, 55, 3))
    off = joints.copy()
    off[0, 21] = [0.022, 0, 0]  # the last of the 22 body joints
    off[0, 22] = [9, 9, 9]  # the jaw is not one
    assert body.joint_error(off, joints) == pytest.approx([0.001])


def test_hand_errors_of_fingers_and_tips_with_aligned_wrists() -> None:
    joints, tips = np.zeros((1, 55, 3)), np.zeros((1, 10, 3))
    moved, moved_tips = joints.copy(), tips.copy()
    moved[0, 20] = moved[0, 25:40] = [0.01, 0, 0]  # the whole left hand, with its wrist
    moved_tips[0, :5] = [0.01, 0, 0]
    moved_tips[0, 9] = [0, 0.04, 0]  # the right little finger's tip alone
    plain = body.hand_error(moved, moved_tips, joints, tips)
    assert plain == pytest.approx(np.array([[0.01, 0.04 / 20]]))
    aligned = body.hand_error(moved, moved_tips, joints, tips, align_wrists=True)
    assert aligned == pytest.approx(np.array([[0.0, 0.04 / 20]]))


def test_corresponding_vertices_interpolate_the_true_faces() -> None:
    found = body.corresponding_vertices(
        SQUARE[None], SQUARE_FACES, np.array([0, 1]), np.array([[0.5, 0.5, 0], [0, 0, 1.0]])
    )
    assert found == pytest.approx(np.array([[[0.5, 0, 0], [0, 1, 0]]]))


def test_honest_uncertainty_has_a_normalised_error_of_one() -> None:
    random = np.random.default_rng(0)
    true = np.zeros((400, 55, 3))
    fitted = random.normal(0, 0.01, true.shape)
    sigma = np.full((400, 55), 0.01)
    assert np.median(body.normalised_joint_error(fitted, true, sigma)) == pytest.approx(1, abs=0.03)
    covariance = np.repeat(np.diag([1, 1, 1, 1e-4, 4e-4, 9e-4])[None], 5000, 0)
    error = random.normal(0, 1, (5000, 3)) * [0.01, 0.02, 0.03]
    length = object_pose.normalised_translation_error(error, np.zeros_like(error), covariance)
    assert np.median(length) == pytest.approx(1, abs=0.03)


def test_normalised_error_is_unknown_without_a_covariance() -> None:
    covariance = np.stack([np.full((6, 6), np.nan), np.zeros((6, 6)), np.eye(6)])
    length = object_pose.normalised_translation_error(np.ones((3, 3)), np.zeros((3, 3)), covariance)
    assert np.isnan(length[:2]).all()
    assert length[2] == pytest.approx(np.sqrt(3) / body.MEDIAN_CHI_3)


def test_object_error_at_the_centre_over_the_symmetry_group() -> None:
    centre = np.array([0.1, 0, 0])
    quarter = _turn("z", 90)
    at = object_pose.posed_point(quarter, np.zeros(3), centre)
    assert at == pytest.approx([0, 0.1, 0])
    true = object_pose.posed_point(np.eye(3), np.zeros(3), centre)
    assert np.linalg.norm(at - true) == pytest.approx(0.1 * np.sqrt(2))
    assert NONE.rotation_error_deg(quarter, np.eye(3)) == pytest.approx(90)
    assert ROUND.rotation_error_deg(quarter, np.eye(3)) == pytest.approx(0, abs=1e-6)


def test_lost_and_first_frame() -> None:
    translation = np.array([0.01, 0.051, 0.01])
    rotation = np.array([19.0, 0.0, 21.0])
    assert object_pose.lost(translation, rotation).tolist() == [False, True, True]
    views = np.array([0, 2, 2])
    assert object_pose.first_seen_found(translation, rotation, views) is False
    assert object_pose.first_seen_found(np.full(3, 0.019), np.full(3, 9.9), views) is True
    assert object_pose.first_seen_found(translation, rotation, np.zeros(3)) is None


def test_contact_counts_and_scores() -> None:
    distance = np.array([[-0.02, 0.0045, 0.0046, 0.1], [0.0, 0.1, 0.1, 0.0]])
    true = np.array([[True, False, True, False], [True, False, False, False]])
    found = contact.vertex_contact(distance)
    assert found.tolist() == [[True, True, False, False], [True, False, False, True]]
    counts = contact.confusion(found, true)
    assert counts.tolist() == [[1, 1, 1, 1], [1, 1, 0, 2]]
    assert contact.f1(counts.sum(0)) == pytest.approx(2 * 2 / (2 * 2 + 2 + 1))
    assert np.isnan(contact.f1(np.array([0, 0, 0, 9])))
    regions = {"a": np.array([0]), "b": np.array([2, 3])}
    by_region = contact.region_contact(found, regions, ("b", "a"))
    assert by_region.tolist() == [[False, True], [True, True]]
    assert contact.recall(np.array([1, 0, 1], bool), np.array([1, 1, 0], bool)) == 0.5
    assert contact.precision(np.array([1, 0, 1], bool), np.array([1, 1, 0], bool)) == 0.5
    assert np.isnan(contact.recall(np.array([True]), np.array([False])))


def test_penetration_of_one_frame_and_over_contact_frames() -> None:
    depth = contact.depths(np.array([0.1, -0.001, -0.002, -0.006]))
    assert depth == pytest.approx((0.003, 0.002, 0.006))
    assert contact.depths(np.array([0.1])) == (0, 0, 0)
    figures = contact.penetration_summary(
        np.array([0.002, 0.006, 0.030, 0.5]), np.array([True, True, True, False])
    )
    assert figures["mean_mm"] == pytest.approx(38 / 3)
    assert figures["median_mm"] == pytest.approx(6)
    assert figures["share_le_5mm"] == pytest.approx(1 / 3)
    assert figures["share_le_7mm"] == pytest.approx(2 / 3)
    assert figures["share_le_20mm"] == pytest.approx(2 / 3)
    assert figures["p98_mm"] == pytest.approx(6 + 0.96 * 24)
    nothing = contact.penetration_summary(np.array([0.1]), np.array([False]))
    assert all(np.isnan(value) for value in nothing.values())


def test_ground_penetration_is_the_deepest_vertex() -> None:
    vertices = np.array([[0, -1.0, 0], [0, 0.02, 0], [0, 0.005, 0]])
    up = np.array([0, -1.0, 0])
    assert contact.ground_penetration(vertices, np.zeros(3), up) == pytest.approx(0.02)
    assert contact.ground_penetration(vertices[:1], np.zeros(3), up) == 0
    assert np.isnan(contact.ground_penetration(vertices, np.full(3, np.nan), up))


@pytest.mark.parametrize("fps", [15.0, 30.0])
def test_acceleration_is_per_frame_squared_at_30_fps(fps: float) -> None:
    time = np.arange(6) / fps
    fall = np.zeros((6, 1, 3))
    fall[:, 0, 1] = 0.5 * 9.81 * time**2
    found = motion.acceleration(fall, fps)
    assert np.isnan(found[[0, -1]]).all()
    assert found[1:-1] == pytest.approx(9.81 / 30**2)
    drifting = fall + np.array([0.02, 0, 0]) * np.arange(6)[:, None, None]
    assert motion.acceleration_error(drifting, fall, fps)[1:-1] == pytest.approx(0, abs=1e-12)
    assert motion.acceleration_error(drifting * 0, fall, fps)[1:-1] == pytest.approx(9.81 / 30**2)
    assert np.isnan(motion.acceleration(fall[:2], fps)).all()


def test_moving_jitter_and_onset() -> None:
    fps = 30.0
    centre = np.zeros((30, 3))
    centre[15:, 0] = 0.02 * np.arange(1, 16)  # 0.6 m/s from frame 15 on
    rotation = np.repeat(np.eye(3)[None], 30, 0)
    moves = motion.moving(rotation, centre, fps)
    assert moves.tolist() == [False] * 14 + [True] * 16
    turning = np.stack([_turn("z", angle) for angle in [0, 0, 0, 3, 6]])
    turns = motion.moving(turning, np.zeros((5, 3)), fps)
    assert turns.tolist() == [False, False, True, True, True]
    late = np.roll(centre, 3, axis=0)
    late[:3] = 0
    assert motion.motion_onset_lags(late, centre, moves, fps) == [3.0]
    assert motion.motion_onset_lags(centre, centre, moves, fps) == [0.0]
    frozen = np.zeros_like(centre)
    assert motion.motion_onset_lags(frozen, centre, moves, fps) == [15.0]

    shaking = centre.copy()
    shaking[:, 1] += 0.001 * (-1.0) ** np.arange(30)
    assert motion.steps(shaking, centre) == pytest.approx(0.002)
    assert motion.steps(centre, centre) == pytest.approx(0)
    assert motion.resting_steps(moves).tolist() == [True] * 13 + [False] * 16


def test_turn_errors_are_relative_and_over_the_symmetry_group() -> None:
    found = np.stack([_turn("z", angle) for angle in (0, 2, 2)])
    true = np.stack([_turn("z", angle) for angle in (40, 40, 43)])
    assert motion.turns(found, true, NONE) == pytest.approx([2, 3], abs=1e-5)
    still = np.repeat(np.eye(3)[None], 3, 0)
    assert motion.turns(found, still, ROUND) == pytest.approx([0, 0], abs=1e-5)


def test_cloud_distances_count_all_or_only_visible_points() -> None:
    cloud = MeasuredCloud(np.array([[0.0, 0, 0.1], [1, 0, 0.3]]))
    assert cloud.mean_distance(SQUARE[:2]) == pytest.approx(0.2)
    visible = np.array([True, False])
    assert cloud.mean_distance(SQUARE[:2][visible]) == pytest.approx(0.1)
    assert np.isnan(cloud.mean_distance(SQUARE[:0]))
    assert np.isnan(MeasuredCloud(np.empty((0, 3))).mean_distance(SQUARE))


def test_samples_cover_area_not_vertices() -> None:
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [3, 1, 0], [0, 1, 0], [4, 0, 0], [4, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]])  # 3 by 1 beside 1 by 1
    samples = sample_surface(vertices, faces, 4000)
    points = samples.of(vertices, faces)
    assert (points[:, 0] < 3).mean() == pytest.approx(0.75, abs=0.002)
    assert points.mean(0) == pytest.approx([2, 0.5, 0], abs=0.01)
    counts = np.histogram2d(points[:, 0], points[:, 1], bins=(16, 4))[0]
    assert counts.min() > 40  # of 62.5 on average: even, not random
    assert np.array_equal(sample_surface(vertices, faces, 4000).barycentric, samples.barycentric)


def test_distance_to_a_posed_box_both_ways() -> None:
    vertices, faces = _box(0.2)
    surface = PosedObject(vertices, faces)
    rotation, translation = _turn("z", 90), np.array([1.0, 2, 3])
    points = translation + np.array([[0.0, 0, 0], [0.13, 0, 0], [0.05, 0, 0], [3, 0, 0]])
    expected = [-0.1, 0.03, -0.05, 0.10]
    assert surface.signed_distance(points, rotation, translation) == pytest.approx(
        expected, abs=1e-6
    )
    posed = vertices @ rotation.T + translation
    body = BodySurface(posed, faces, SurfaceTree(vertices, faces))
    assert body.signed_distance(points) == pytest.approx(expected, abs=1e-6)
    assert body.distance(points) == pytest.approx([0.1, 0.03, 0.05, 0.25], abs=1e-6)


def test_depths_have_a_larger_cap_than_distances() -> None:
    vertices, faces = _box(0.6)  # half a metre and more: deeper than REACH_M and DEEPEST_M
    points = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.25, 0, 0], [0.37, 0, 0], [0.45, 0, 0]])
    found = PosedObject(vertices, faces).signed_distance(points, np.eye(3), np.zeros(3))
    assert found == pytest.approx([-0.25, -0.2, -0.05, 0.07, 0.10], abs=1e-6)


def test_sight_knows_occlusion_facing_and_image() -> None:
    lens = Intrinsics(100, 100, 100.0, 100.0, 49.5, 49.5)
    camera = Camera("k1", lens, None, None, np.eye(4))
    vertices, faces = _box(0.2)
    right = np.array([1.0, 0, 0])
    ahead = np.array([0, 0, 1.0])
    far, near = vertices + 2 * ahead, vertices * 0.2 + ahead
    normals = face_normals(far, faces)
    middles = far[faces].mean(1)
    tree = SurfaceTree(vertices, faces)

    def seen(points: np.ndarray, *placed: np.ndarray) -> np.ndarray:
        return seen_by_cameras(points, normals, [camera], [tree.shaped(one) for one in placed])

    assert np.array_equal(seen(middles, far), normals[:, 2] < -0.5)
    assert not seen(middles, far, vertices * 0.6 + ahead).any()
    assert seen(middles, far, near + right).any()
    assert not seen(middles + 5 * right, far).any()


def test_extrinsics_displacement_of_a_shift_and_a_turn() -> None:
    true = np.repeat(np.eye(4)[None], 3, 0)
    true[1, :3, :3], true[2, :3, :3] = _turn("y", 120), _turn("y", 240)
    for pose in true:
        pose[:3, 3] = -2.0 * pose[:3, 2]  # all look at the origin from 2 m
    assert rig_centre(true) == pytest.approx(np.zeros(3), abs=1e-4)
    estimated = true.copy()
    estimated[1, 0, 3] += 0.01
    turn = _turn("y", 1.0)
    estimated[2, :3] = turn @ true[2, :3]
    found = displacement(estimated, true, 0)
    # a turn by a about an axis through the cube's centre moves a point at distance r by 2 r sin a/2
    # and the mean of r^2 = x^2 + z^2 over the cube is 2 * side^2 / 12
    expected = 2 * np.sin(np.radians(0.5)) * np.sqrt(2 * 4 / 12)
    assert found == pytest.approx([0, 0.01, expected], abs=1e-5)
    moved = rigid(_turn("y", 30), np.array([1.0, 2, 3]))
    assert displacement(moved @ estimated, true, 0) == pytest.approx(found, abs=1e-9)


def test_flags_join_reasons_and_runs() -> None:
    first, second = np.array([1, 1, 0, 0, 1], bool), np.array([0, 1, 1, 0, 0], bool)
    found = Flags.of(5, [(first, "a", ["hands"]), (second, "b", OF_OBJECT), (first, "a", ["body"])])
    a, b = "body, hands: a", "object, contact: b"
    assert found.reasons == [a, f"{a}; {b}", b, "", a]
    assert found.summary() == "flagged: body 3, hands 3, object 2, contact 2 of 5 frames"
    both = found | Flags.of(5, [(~first, "c", PARTS)])
    assert both.reasons[1:3] == [f"{a}; {b}", f"{b}; {', '.join(PARTS)}: c"]
    assert both.flagged[2:4].all()
    assert flags.ranges(["a", "a", "", "b", "a", "a"]) == [(0, 1, "a"), (3, 3, "b"), (4, 5, "a")]
