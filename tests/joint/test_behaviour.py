"""Effect of the joint terms on fits of a small scene: a body, a box, a floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.floor import FloorPlane
from intercap_core.joint.minimise import minimise
from intercap_core.joint.problem import JointProblem
from intercap_core.joint.skin import contact_patches
from intercap_core.joint.state import ALL, BODY, OBJECT, State
from intercap_core.joint.terms.object_data import NoObject
from intercap_core.joint.terms.plant import sole_parts
from intercap_core.joint.terms.stick import local_points
from intercap_core.schemas import CONTACT_REGIONS
from tests.joint.scenes import (
    BOX,
    FPS,
    FRAMES,
    LEFT_HAND,
    Scene,
    bodies,
    floor_under_soles,
    object_mesh,
    with_object_at,
)

SEAT = CONTACT_REGIONS.index("seat")


def _slip(scene: Scene, state: State) -> float:
    """RMS motion of the hand's nearest skin over the object between frames, metres."""
    geometry = scene.geometry
    hand = geometry.skin.patch[geometry.patches.region == LEFT_HAND]
    near = hand[np.argsort(scene.distance(state)[0, hand])[:6]]
    points = geometry.at(state).skin[:, near]
    local = local_points(points, state.rotation, state.translation)
    return float(np.sqrt((np.diff(local, axis=0) ** 2).sum(2).mean()))


def _jitter(sigma: float) -> np.ndarray:
    """Motion (T, 3) along x that changes its direction from frame to frame."""
    way = np.zeros((FRAMES, 3))
    way[:, 0] = sigma * np.array([1, -1] * FRAMES)[:FRAMES]
    return way


@pytest.mark.parametrize("side", [0, 1, -1])
def test_contact_draws_to_the_object_or_its_annotated_part(model, side):
    """A hand above the box closes the gap to it, or to an annotated top, and comes nearer to an
    annotated bottom."""
    state = bodies(model, 0.012)
    part = np.flatnonzero(side * BOX.vertices[:, 1] > 0) if side else None
    scene = Scene(model, state, hold=0.02, track=0.02, touching=(LEFT_HAND,), part=part)
    hand = scene.geometry.skin.patch[scene.geometry.patches.region == LEFT_HAND]
    # contact is detected by the distance to any point
    assert scene.distance(state, LEFT_HAND).min() == pytest.approx(0.012, abs=1e-3)
    expected = 0.112 if side < 0 else 0.012
    touching = scene.geometry.at(state).touching.distance[:, hand]
    assert touching.min() == pytest.approx(expected, abs=1e-3)
    after = scene.geometry.at(scene.minimise().state).touching.distance[:, hand].min(axis=1)
    assert (after < (expected - 0.005 if side < 0 else 0.004)).all()
    assert side or (after > -0.004).all()


def test_brief_contact_does_not_shake_a_steady_track(model):
    """One frame of contact moves its neighbours along instead of kicking its own frame."""
    state = bodies(model, 0.010)
    scene = Scene(model, state, hold=0.001, track=0.01)
    scene.probability[2, LEFT_HAND] = 1
    scene.take_contact()
    moved = scene.minimise().state.translation - state.translation
    assert np.abs(np.diff(moved, axis=0)).max() < 0.002


def test_penetration_is_pushed_out(model):
    state = bodies(model, -0.012)
    scene = Scene(model, state, hold=0.02, track=0.02)
    assert (scene.distance(scene.minimise().state).min(axis=1) > -0.006).all()


def _depth_of_blade(model, state: State) -> np.ndarray:
    """Depth (T,) of a blade's edge in the body, by the body's whole surface."""
    vertices = model(state.parameters(model)).vertices.double().numpy()
    edge = np.column_stack([np.linspace(-0.03, 0.03, 200), np.full(200, 0.05), np.zeros(200)])
    return np.array(
        [
            -DistanceField(skin, model.faces.numpy()).signed_distance(edge @ r.T + t).min()
            for skin, r, t in zip(vertices, state.rotation, state.translation, strict=True)
        ]
    )


def test_rim_between_the_vertices_of_the_skin_is_pushed_out(model):
    """A sheet of a millimetre stands in a finger none of whose vertices is inside it."""
    blade = object_mesh(trimesh.creation.box((0.06, 0.1, 0.001)).subdivide_to_size(0.02))
    state = bodies(model, -0.006)
    scene = Scene(model, state, mesh=blade, hold=0.02, track=0.02)
    both = scene.problem
    one = JointProblem(tuple(term for term in both.terms if term.name != "object_in_body"))
    assert len(one.terms) == len(both.terms) - 1
    depth = {}
    for name, problem in (("both", both), ("one", one)):
        at = state
        for _ in range(3):
            problem.refresh(at)
            at = minimise(problem, at, max_steps=5).state
        depth[name] = _depth_of_blade(model, at)
    start = _depth_of_blade(model, state)
    assert (start > 0.003).all()
    assert depth["one"] == pytest.approx(start, abs=1e-4)  # no vertex is inside
    assert (depth["both"] < 0.8 * start).all()


def test_floor_carries_the_object(model):
    state = bodies(model, 0.5)
    top = state.translation[0, 1] - 0.05 + 0.03  # the box starts 3 cm deep in the floor
    floor = FloorPlane(np.array([0, top, 0]), np.array([0, 1.0, 0]))
    scene = Scene(model, state, hold=0.001, track=0.05, floor=floor)
    rise = scene.minimise().state.translation[:, 1] - state.translation[:, 1]
    assert (rise > 0.02).all()


def test_neighbours_carry_a_lost_frame(model):
    state = bodies(model, 0.5)
    line = state.translation + np.arange(FRAMES)[:, None] * [0.02, 0, 0]
    wrong = line.copy()
    wrong[2] += [0.1, 0.1, 0]
    start, seen = (with_object_at(state, place) for place in (wrong, line))
    scene = Scene(model, start, hold=0.01, track=0.005, lost=np.arange(FRAMES) == 2, seen=seen)
    moved = scene.minimise(max_steps=10).state
    np.testing.assert_allclose(moved.translation[2], line[2], atol=0.004)


def test_object_at_rest_moves_as_one(model):
    """A hand that comes down onto it frame by frame moves it once, in all frames."""
    state = bodies(model, 0.012)
    scene = Scene(model, state, hold=0.02, track=0.02, resting=True)
    scene.probability[FRAMES // 2 :, LEFT_HAND] = 1
    scene.take_contact()
    moved = scene.minimise().state
    assert np.linalg.norm(moved.translation[0] - state.translation[0]) > 0.001
    assert np.linalg.norm(np.diff(moved.translation, axis=0), axis=1).max() < 2e-4
    turn = moved.rotation[1:] @ moved.rotation[:-1].transpose(0, 2, 1)
    assert np.abs(turn - np.eye(3)).max() < np.radians(0.1)


@pytest.mark.parametrize("part", [LEFT_HAND, SEAT])
def test_held_object_does_not_slide_in_the_hand(model, part):
    """If another part touches, the seat, nothing holds it."""
    state = bodies(model, 0.001)
    shaken = with_object_at(state, state.translation + _jitter(0.0015))
    scene = Scene(model, shaken, hold=0.002, track=0.005, touching=(part,))
    after = scene.minimise().state
    assert (_slip(scene, after) < _slip(scene, shaken) / 2) == (part == LEFT_HAND)


def test_object_that_glides_through_a_hand_glides_on(model):
    """The images show 0.6 m/s along the palm in every frame."""
    state = bodies(model, 0.001)
    way = np.outer(0.04 * (np.arange(FRAMES) - 2), [0, 0, 1.0])
    gliding = with_object_at(state, state.translation + way)
    scene = Scene(model, gliding, hold=0.002, track=0.003, touching=(LEFT_HAND,))
    speed = np.diff(scene.minimise().state.translation[:, 2]) * FPS
    np.testing.assert_allclose(speed, 0.6, rtol=0.1)


def test_standing_foot_stays_and_swinging_foot_swings(model):
    """The whole body shakes, or walks at 1 m/s; the floor is under its soles."""
    start = bodies(model, 0.5)
    soles = sole_parts(contact_patches(model), 6)
    assert len(soles) == 4  # heel and ball of both feet
    floor = floor_under_soles(model, start)
    walk = np.outer(np.arange(FRAMES) / FPS, [0, 0, 1.0])
    for way, stands in ((_jitter(0.002), True), (walk, False)):
        body = start.body.copy()
        body[:, -3:] += way
        state = replace(start, body=body)
        scene = Scene(model, state, hold=0.01, track=0.1, floor=floor)
        geometry = scene.geometry
        before, after = (
            np.diff(geometry.at(s).skin[:, geometry.skin.patch[soles[0]]], axis=0)
            for s in (state, scene.minimise().state)
        )
        before, after = (np.linalg.norm(x, axis=2).mean() for x in (before, after))
        assert after < before / 3 if stands else after > 0.9 * before


def test_fit_at_a_minimum_converges_at_once(model):
    state = bodies(model, 0.001)
    scene = Scene(model, state, hold=0.01, track=0.01, touching=(LEFT_HAND,))
    there = scene.minimise(max_steps=40).state
    again = minimise(scene.problem, there, max_steps=40)
    assert again.converged and again.steps <= 2
    assert np.abs(again.state.body - again.previous.body).max() < 1e-3 and again.decrease < 0.01


def test_body_steps_as_if_no_object_were_unknown():
    """A quadratic in the body is at its minimum after one step; poses of the object stay NaN."""
    rng = np.random.default_rng(6)
    state = State(
        rng.normal(0, 0.1, (FRAMES, BODY.stop)), np.zeros(10), np.zeros((FRAMES, 10)),
        np.tile(np.eye(3), (FRAMES, 1, 1)), np.zeros((FRAMES, 3)),
    ).without_object()  # fmt: skip
    target, equations = state.body + 0.05, BandedEquations(FRAMES)
    weight = rng.uniform(1, 3, (FRAMES, BODY.stop))
    residual = state.body - target
    hessian = weight[..., None] * np.eye(BODY.stop)
    energy = 0.5 * (weight * residual**2).sum(1)
    equations.add_blocks("quadratic", BODY, hessian, weight * residual, energy)
    assert equations.copy().step(np.zeros(FRAMES)) is None  # nothing determines the object
    NoObject().add(state, equations)
    assert set(equations.energy) == {"quadratic"}
    step = equations.step(np.zeros(FRAMES))
    assert step is not None and step.shape == (FRAMES, ALL.stop) and (step[:, OBJECT] == 0).all()
    moved = state.moved(step)
    np.testing.assert_allclose(moved.body, target, atol=1e-12)
    assert np.isnan(moved.rotation).all() and np.isnan(moved.translation).all()
