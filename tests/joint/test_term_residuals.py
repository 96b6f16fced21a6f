"""Terms that tie the body to the object and both to the floor."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.geometry.rigid.distance import DistanceField, SurfacePart
from intercap_core.joint.floor import Ground
from intercap_core.joint.geometry import moment_points, points_by_object
from intercap_core.joint.proximity import along_by_object, proximity
from intercap_core.joint.terms.contact import evaluate_contact, spread_contact
from intercap_core.joint.terms.ground import depth_below
from intercap_core.joint.terms.motion import accelerations
from intercap_core.joint.terms.penetration import PENETRATION_TOLERANCE, weigh_depths

RNG = np.random.default_rng(3)


@pytest.fixture(scope="module")
def sphere() -> DistanceField:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    return DistanceField(mesh.vertices, mesh.faces)


def _poses(frames: int) -> tuple[np.ndarray, np.ndarray]:
    return Rotation.random(frames, rng=RNG).as_matrix(), RNG.normal(size=(frames, 3))


def test_distance_to_a_moved_sphere_is_its_closed_form(sphere):
    rotation, translation = _poses(4)
    points = translation[:, None] + RNG.uniform(-0.19, 0.19, size=(4, 50, 3))
    near = proximity(sphere, points, rotation, translation)
    expected = np.linalg.norm(points - translation[:, None], axis=2) - 0.1
    np.testing.assert_allclose(near.distance, expected, atol=5e-4)  # facets of the icosphere


def test_far_from_an_object_its_box_stands_for_it(sphere):
    rotation, translation = _poses(4)
    away = RNG.normal(size=(4, 50, 3))
    away *= RNG.uniform(0.5, 3.0, (4, 50, 1)) / np.linalg.norm(away, axis=2, keepdims=True)
    near = proximity(sphere, translation[:, None] + away, rotation, translation)
    gap = np.linalg.norm(away, axis=2) - 0.1
    assert ((near.distance <= gap + 5e-4) & (near.distance > gap - 0.1)).all()
    assert (near.distance > 0.2).all()
    along = away / np.linalg.norm(away, axis=2, keepdims=True)
    assert ((near.normals * along).sum(axis=2) > 0.9).all()


@pytest.mark.parametrize("annotated", [False, True])
def test_distance_derivatives_match_finite_differences(annotated):
    """Of the whole surface, and of its upper side."""
    box = trimesh.creation.box((0.2, 0.3, 0.1))
    field = DistanceField(box.vertices, box.faces)
    if annotated:
        upper = np.flatnonzero(box.vertices[:, 2] > 0)
        field = SurfacePart(field, box.vertices, box.faces, upper)
    rotation, translation = _poses(3)
    points = translation[:, None] + RNG.normal(scale=0.15, size=(3, 40, 3))
    near = proximity(field, points, rotation, translation)
    by_object = -along_by_object(points, near.normals, translation)
    step = 2e-3

    def moved(twist: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(twist[:3]).as_matrix()
        return proximity(field, points, turn @ rotation, translation + twist[3:]).distance

    for axis in range(6):
        twist = np.eye(6)[axis] * step
        numeric = (moved(twist) - moved(-twist)) / (2 * step)
        # points that change their nearest face within the step have no derivative
        agree = np.abs(numeric - by_object[..., axis]) < 2e-3
        assert agree.mean() > 0.9
    for axis in range(3):
        offset = np.eye(3)[axis] * step
        numeric = (
            proximity(field, points + offset, rotation, translation).distance
            - proximity(field, points - offset, rotation, translation).distance
        ) / (2 * step)
        assert (np.abs(numeric - near.normals[..., axis]) < 2e-3).mean() > 0.9


def _contact(distance, patch_of, region_of_patch, probability):
    distance, patch_of = np.array(distance), np.array(patch_of)
    spread = spread_contact(distance, patch_of, np.array(region_of_patch))
    return evaluate_contact(distance, patch_of, spread, np.array(probability))


def test_contact_weights_of_a_touching_patch_sum_to_its_probability():
    _, weight, _ = _contact([[0.0, 0.001, 0.2, 0.0]], [0, 0, 0, 1], [0, 1], [[0.8, 0.3]])
    assert weight[0, :3].sum() == pytest.approx(0.8)
    assert weight[0, 3] == pytest.approx(0.3)
    assert weight[0, 2] < 1e-6


def test_a_far_patch_is_an_outlier():
    _, near, _ = _contact([[0.005]], [0], [0], [[1.0]])
    _, far, _ = _contact([[0.2]], [0], [0], [[1.0]])
    assert near.sum() > 0.9 and far.sum() < 0.01


def test_a_finger_off_the_handle_is_left_alone_while_the_palm_holds_it():
    _, weight, _ = _contact([[0.001, 0.025]], [0, 1], [0, 0], [[1.0, 1.0]])
    assert weight[0, 0] == pytest.approx(1.0) and weight[0, 1] < 0.01


def test_contact_weights_are_the_derivative_of_its_energy():
    distance = RNG.uniform(-0.005, 0.03, size=(3, 12))
    patch_of = np.repeat([0, 1, 2], 4)
    spread = spread_contact(distance, patch_of, np.array([0, 0, 1]))
    probability = RNG.uniform(size=(3, 3))
    residual, weight, _ = evaluate_contact(distance, patch_of, spread, probability)
    for t, n in ((0, 1), (1, 5), (2, 11)):
        step = np.zeros_like(distance)
        step[t, n] = 1e-7
        up = evaluate_contact(distance + step, patch_of, spread, probability)[2].sum()
        down = evaluate_contact(distance - step, patch_of, spread, probability)[2].sum()
        numeric = (up - down) / 2e-7
        assert (weight * residual)[t, n] == pytest.approx(numeric, rel=1e-4, abs=1e-10)


def test_only_depth_beyond_the_tolerance_costs():
    distance = np.array([[0.01, -0.5 * PENETRATION_TOLERANCE, -0.006]])
    residual, weight = weigh_depths(distance, np.full(3, 2.0))
    np.testing.assert_allclose(residual[0], [0, 0, -0.006 + PENETRATION_TOLERANCE])
    np.testing.assert_allclose(weight[0], [0, 0, 2])


def test_ground_counts_what_is_below_alone():
    points = np.array([[[0, 0, 0.1], [0, 0, -0.02]]])
    height = depth_below(points, Ground(np.zeros(3), np.array([0, 0, 1.0])))
    np.testing.assert_allclose(height, [[0, -0.02]])


def test_what_moves_with_the_object_has_the_derivative_of_finite_differences():
    points, along = RNG.normal(size=(2, 2, 5, 3))
    translation = RNG.normal(size=(2, 3))
    rows = along_by_object(points, along, translation)
    step = 1e-6
    for axis in range(6):
        twist = np.eye(6)[axis] * step
        turn = Rotation.from_rotvec(twist[:3]).as_matrix()
        moved = (points - translation[:, None]) @ turn.T + translation[:, None] + twist[3:]
        change = ((moved - points) * along).sum(axis=2) / step
        np.testing.assert_allclose(change, rows[..., axis], atol=1e-5)


def test_six_points_carry_the_energy_of_all_vertices():
    vertices = RNG.normal(size=(200, 3)) * (0.1, 0.2, 0.4) + (0.3, 0.0, -0.1)
    matrix, shift = RNG.normal(size=(3, 3)), RNG.normal(size=3)
    six = moment_points(vertices)
    energy = np.square(vertices @ matrix.T + shift).sum() / len(vertices)
    assert np.square(six @ matrix.T + shift).sum() / 6 == pytest.approx(energy)


def test_object_points_derivative_matches_finite_differences():
    rotation, translation = _poses(2)
    points = RNG.normal(size=(4, 3))
    moved, jacobian = points_by_object(points, rotation, translation)
    step = 1e-6
    for axis in range(6):
        twist = np.eye(6)[axis] * step
        turn = Rotation.from_rotvec(twist[:3]).as_matrix()
        there, _ = points_by_object(points, turn @ rotation, translation + twist[3:])
        np.testing.assert_allclose((there - moved) / step, jacobian[..., axis], atol=1e-5)


def test_constant_velocity_has_no_acceleration():
    points = np.arange(6)[:, None, None] * np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(accelerations(points, 30.0), 0, atol=1e-10)
