"""Residuals and derivatives of each joint term, against closed forms and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.config import JointSettings
from intercap_core.geometry.rigid.distance import DistanceField, SurfacePart
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.joint.floor import FloorPlane
from intercap_core.joint.geometry import moment_points, points_by_object
from intercap_core.joint.problem import TERMS, JointProblem
from intercap_core.joint.proximity import along_by_object, proximity
from intercap_core.joint.sequential import TrackedPoses, TrackMarks
from intercap_core.joint.state import ALL
from intercap_core.joint.terms.contact import (
    ANNOTATED_CONTACT_WEIGHT,
    CONTACT_TOLERANCE,
    Contact,
    evaluate_contact,
    spread_contact,
)
from intercap_core.joint.terms.drift import jitter
from intercap_core.joint.terms.motion import LearnedMotion, accelerations
from intercap_core.joint.terms.penetration import (
    DEEPEST_IN_BODY,
    PENETRATION_TOLERANCE,
    WATCHED_OUTSIDE,
    excess_depth,
    find_embedded,
)
from intercap_core.joint.terms.plant import standing_probability
from intercap_core.joint.terms.stick import (
    STICK_VERTICES,
    _representatives,
    local_by_object,
    local_points,
)
from intercap_core.joint.terms.term import Data
from tests.joint.scenes import (
    BOX,
    FPS,
    FRAMES,
    LEFT_HAND,
    Scene,
    bodies,
    check_gradient,
    with_object_at,
)

RNG = np.random.default_rng(3)


@pytest.mark.parametrize("kind", [kind for kind in TERMS if kind is not LearnedMotion])
def test_gradient_of_each_term_matches_differences(model, kind):
    """Hand and box overlap; both reach below the floor; without a floor still feet stand. Contact
    is with the whole box, and with its upper side."""
    state = bodies(model, -0.01)
    floor = FloorPlane(state.translation[0], np.array([0, 1.0, 0]))
    moved = np.random.default_rng(4).normal(scale=0.002, size=(FRAMES, ALL.stop))
    upper = np.flatnonzero(BOX.vertices[:, 1] > 0)
    for part in (None, upper) if kind is Contact else (None,):
        scene = Scene(
            model, state, touching=(LEFT_HAND,), part=part,
            floor=floor if Data.FLOOR in kind.needs else None,
        )  # fmt: skip
        check_gradient(scene.term(kind), state.moved(moved))


def test_gradient_of_data_terms_matches_differences(model):
    state = bodies(model, 0.5)
    scene = Scene(model, state, hold=0.1, track=1.0)
    moved = state.moved(np.random.default_rng(0).normal(scale=0.01, size=(FRAMES, ALL.stop)))
    for term in scene.problem.terms[:2]:
        check_gradient(term, moved, step=1e-4, rel=1e-4)


def test_rows_of_several_threads_are_those_of_one(model):
    state = bodies(model, -0.004, 20)
    state = state.moved(np.random.default_rng(4).normal(0, 0.01, (20, ALL.stop)))
    scene = Scene(model, state, touching=(LEFT_HAND,))
    alone = scene.problem.equations(state)
    shared = JointProblem(scene.problem.terms, ThreadPool(3)).equations(state)
    assert (shared.bands == alone.bands).all() and (shared.gradient == alone.gradient).all()
    assert np.abs(alone.bands[2]).max() > 0


# --- distances to the object


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


def test_distance_far_from_an_object_is_that_to_its_box(sphere):
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
def test_derivatives_of_distances_match_differences(annotated):
    """Distances to the whole surface, and to its upper side."""
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

    def distance(twist: np.ndarray, offset: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(twist[:3]).as_matrix()
        moved = turn @ rotation, translation + twist[3:]
        return proximity(field, points + offset, *moved).distance

    analytic = np.concatenate([by_object, near.normals], axis=2)
    for axis, move in enumerate(step * np.eye(9)):
        up, down = (distance(s * move[:6], s * move[6:]) for s in (1, -1))
        # points that change their nearest face within the step have no derivative
        agree = np.abs((up - down) / (2 * step) - analytic[..., axis]) < 2e-3
        assert agree.mean() > 0.9


def test_derivative_of_points_that_move_with_the_object():
    points, along = RNG.normal(size=(2, 2, 5, 3))
    rotation, translation = _poses(2)
    rows = along_by_object(points, along, translation)
    local = local_points(points, rotation, translation)
    by_local = local_by_object(points, rotation, translation)
    own = RNG.normal(size=(4, 3))
    placed, by_placed = points_by_object(own, rotation, translation)
    step = 1e-6
    np.testing.assert_allclose(local @ rotation.transpose(0, 2, 1) + translation[:, None], points)
    for axis, twist in enumerate(step * np.eye(6)):
        turn = Rotation.from_rotvec(twist[:3]).as_matrix()
        moved = (points - translation[:, None]) @ turn.T + translation[:, None] + twist[3:]
        change = ((moved - points) * along).sum(axis=2) / step
        np.testing.assert_allclose(change, rows[..., axis], atol=1e-5)
        there = turn @ rotation, translation + twist[3:]
        change = (local_points(points, *there) - local) / step
        np.testing.assert_allclose(change, by_local[..., axis], atol=1e-5)
        change = (points_by_object(own, *there)[0] - placed) / step
        np.testing.assert_allclose(change, by_placed[..., axis], atol=1e-5)


def test_depth_of_an_object_in_the_body(model):
    state = bodies(model, 0.05, 1)
    scene = Scene(model, state)
    assert scene.geometry.at(state).object_depth(ThreadPool()) == 0
    chest = scene.geometry.at(state).joints[:, JOINT_INDEX["spine2"]]
    assert scene.geometry.at(with_object_at(state, chest)).object_depth(ThreadPool()) > 0.05


# --- contact


def _contact(distance, patch_of, region_of_patch, probability):
    distance, patch_of = np.array(distance), np.array(patch_of)
    shares = spread_contact(distance, patch_of, np.array(region_of_patch))
    return evaluate_contact(distance, patch_of, shares, np.array(probability))


def test_weights_of_a_touching_patch_sum_to_its_probability():
    _, weight, _ = _contact([[0.0, 0.001, 0.2, 0.0]], [0, 0, 0, 1], [0, 1], [[0.8, 0.3]])
    assert weight[0, :3].sum() == pytest.approx(0.8)
    assert weight[0, 3] == pytest.approx(0.3)
    assert weight[0, 2] < 1e-6


def test_a_far_patch_is_an_outlier_of_contact():
    _, near, _ = _contact([[0.005]], [0], [0], [[1.0]])
    _, far, _ = _contact([[0.2]], [0], [0], [[1.0]])
    assert near.sum() > 0.9 and far.sum() < 0.01
    # a finger off the handle while the palm holds it
    _, weight, _ = _contact([[0.001, 0.025]], [0, 1], [0, 0], [[1.0, 1.0]])
    assert weight[0, 0] == pytest.approx(1.0) and weight[0, 1] < 0.01


@pytest.mark.parametrize(
    ("gap", "times"), [(0.020, ANNOTATED_CONTACT_WEIGHT), (CONTACT_TOLERANCE - 0.0005, 1.0)]
)
def test_annotated_contact_weighs_more_while_apart(model, gap, times):
    state = bodies(model, gap)
    scene = Scene(model, state, touching=(LEFT_HAND,))
    detected = scene.problem.equations(state).energy["contact"]
    for annotated, factor in ((0, 1.0), (1, times)):
        scene.take_contact(annotated)
        energy = scene.problem.equations(state).energy["contact"]
        assert energy == pytest.approx(factor * detected) and energy > 0


# --- stick, plant, penetration, ground


@pytest.mark.parametrize("probability", [1.0, 0.3])
def test_representatives_have_the_weight_of_their_patch(probability):
    holds = np.full((4, 240), probability / 240)
    holds[2] = 0.0
    some, weight = _representatives(holds)
    assert len(some) == STICK_VERTICES and len(np.unique(some)) == len(some)
    np.testing.assert_allclose(weight.sum(1), [probability, probability, 0, probability])


def test_low_still_soles_stand_and_high_or_fast_ones_swing():
    rng = np.random.default_rng(1)
    frames = 30
    sole = np.tile(rng.normal(scale=0.03, size=(1, 6, 3)), (frames, 1, 1))
    sole += rng.normal(scale=0.001, size=(frames, 1, 3))
    height = np.full((frames, 6), 0.004)
    assert standing_probability(sole, height, FPS).min() > 0.95
    # on a beam or a bar a sole must be stiller
    assert standing_probability(sole, height + 0.25, FPS).min() > 0.8
    sways = sole + np.linspace(0, 0.08 * frames / FPS, frames)[:, None, None] * [1.0, 0, 0]
    assert standing_probability(sways, height, FPS).min() > 0.8
    assert standing_probability(sways, height + 0.25, FPS).max() < 0.1
    assert standing_probability(sole, None, FPS).min() > 0.9  # no floor known
    step = sole.copy()
    step[10:15, :, 0] += np.linspace(0.1, 0.5, 5)[:, None]
    step[15:, :, 0] += 0.5
    stands = standing_probability(step, height, FPS)
    assert stands[10:14].max() < 0.05 and stands[:8].min() > 0.9 and stands[17:].min() > 0.9
    assert len(standing_probability(sole[:1], height[:1], FPS)) == 0


def test_depths_count_beyond_the_tolerance_and_below_the_floor():
    depth = excess_depth(np.array([0.01, -0.5 * PENETRATION_TOLERANCE, -0.006]))
    np.testing.assert_allclose(depth, [0, 0, -0.006 + PENETRATION_TOLERANCE])
    points = np.array([[[0, 0, 0.1], [0, 0, -0.02]]])
    below = FloorPlane(np.zeros(3), np.array([0, 0, 1.0])).depths(points)
    np.testing.assert_allclose(below, [[0, -0.02]])


def test_points_in_a_ball_have_its_depth_and_direction():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    rng = np.random.default_rng(0)
    way = rng.normal(size=(300, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    distance = rng.uniform(-0.03, 0.02, 300)
    points = way * (0.1 + distance)[:, None]
    inside = find_embedded(points, np.asarray(ball.vertices), np.asarray(ball.faces))
    # facets of 6 mm lie up to 0.1 mm inside the ball
    sure = np.minimum(np.abs(distance + DEEPEST_IN_BODY), np.abs(distance - WATCHED_OUTSIDE)) > 2e-4
    near = (distance > -DEEPEST_IN_BODY) & (distance < WATCHED_OUTSIDE)
    assert np.array_equal(np.isin(np.arange(300), inside.point)[sure], near[sure])
    np.testing.assert_allclose(inside.distance, distance[inside.point], atol=2e-4)
    off = np.abs(distance[inside.point]) > 5e-4
    assert ((inside.normal * way[inside.point]).sum(axis=1)[off] > 0.98).all()
    gap = np.linalg.norm(ball.vertices[inside.vertex] - points[inside.point], axis=1)
    assert (gap < np.abs(inside.distance) + 0.008).all()


# --- motion and drift


def test_six_points_carry_the_energy_of_all_vertices():
    vertices = RNG.normal(size=(200, 3)) * (0.1, 0.2, 0.4) + (0.3, 0.0, -0.1)
    matrix, shift = RNG.normal(size=(3, 3)), RNG.normal(size=3)
    six = moment_points(vertices)
    energy = np.square(vertices @ matrix.T + shift).sum() / len(vertices)
    assert np.square(six @ matrix.T + shift).sum() / 6 == pytest.approx(energy)


def test_constant_velocity_has_no_acceleration():
    points = np.arange(6)[:, None, None] * np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(accelerations(points, 30.0), 0, atol=1e-10)


def test_jitter_is_the_noise_of_a_smooth_motion():
    rng = np.random.default_rng(5)
    t = np.arange(200)[:, None, None] / 30
    smooth = np.concatenate([np.sin(t), np.cos(1.3 * t), t], axis=2)
    noisy = smooth + rng.normal(scale=0.003, size=smooth.shape)
    assert jitter(noisy, np.ones(200, bool)) == pytest.approx(0.003, rel=0.2)
    assert jitter(smooth, np.ones(200, bool)) < 1e-5


def test_drift_weight_scales_all_but_an_object_at_rest(model):
    state = bodies(model, 0.5)
    rng = np.random.default_rng(4)
    moved = state.moved(rng.normal(scale=0.002, size=(FRAMES, ALL.stop)))
    for resting in (False, True):
        zero, once, twice = (
            Scene(
                model, moved, start=state, resting=resting,
                settings=JointSettings(drift_weight=weight),
            ).problem.equations(moved).energy
            for weight in (0.0, 1.0, 2.0)
        )  # fmt: skip
        assert zero["body_drift"] == 0 and twice["body_drift"] == 2 * once["body_drift"] > 0
        assert zero["object_drift"] == (once["object_drift"] if resting else 0)
        assert once["object_drift"] > 0


# --- the object's track


def test_carried_poses_keep_their_own_deviations():
    """They are neither widened as lost or ambiguous ones, nor compared with images."""
    sigma = np.diag(np.repeat([0.1, 0.02], 3) ** 2)
    lost, carried, ambiguous = (np.arange(4) == t for t in (1, 2, 3))
    marks = TrackMarks(lost, ambiguous | carried, carried, np.zeros(4, bool))
    track = TrackedPoses.from_track(
        np.repeat(np.eye(4)[None], 4, 0), np.repeat(sigma[None], 4, 0), marks,
        visible=np.ones((4, 1), bool), times=np.arange(4.0),
    )  # fmt: skip
    turn, shift = np.linalg.inv(track.information)[:, [0, 3], [0, 3]].T ** 0.5
    assert turn[[0, 2]] == pytest.approx(0.1, rel=0.01)
    assert shift[[0, 2]] == pytest.approx(0.02, rel=0.01)
    assert shift[1] > 0.1 and turn[3] > 0.15
    assert track.seen.tolist() == [True, False, False, True]
