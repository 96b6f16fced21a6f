"""What is held does not slide over the hand, what stands stays, and what truly moves may."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.floor import Ground
from intercap_core.joint.minimise import minimise
from intercap_core.joint.state import State
from intercap_core.joint.terms.object_data import ObjectData
from intercap_core.joint.terms.plant import sole_parts, standing_probability
from intercap_core.joint.terms.stick import (
    STICK_VERTICES,
    _representatives,
    local_by_object,
    local_points,
)
from intercap_core.schemas import CONTACT_REGIONS
from tests.joint.test_problem import _Hold, _Scene, _state, _tracked, box  # noqa: F401

LEFT_HAND = CONTACT_REGIONS.index("left_hand")
SEAT = CONTACT_REGIONS.index("seat")
FPS = 15.0


def moving(state: State, way: np.ndarray) -> State:
    """The state with the object moved by ``way`` (T, 3)."""
    there = state.translation + way
    return State(state.body, state.betas, state.expression, state.rotation, there)


def slip(scene: _Scene, state: State) -> float:
    """RMS motion of the hand's nearest skin over the object, from frame to frame, metres."""
    geometry = scene.geometry
    hand = geometry.skin.patch[geometry.patches.region == LEFT_HAND]
    near = hand[np.argsort(scene.distance(state)[0, hand])[:6]]
    points = geometry.at(state).skin[:, near]
    local = local_points(points, state.rotation, state.translation)
    return float(np.sqrt((np.diff(local, axis=0) ** 2).sum(2).mean()))


def test_points_in_the_object_s_frame_and_their_derivative() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2, 3, 3))
    rotation = Rotation.random(2, rng).as_matrix()
    translation = rng.normal(size=(2, 3))
    local = local_points(points, rotation, translation)
    back = local @ rotation.transpose(0, 2, 1) + translation[:, None]
    np.testing.assert_allclose(back, points)
    found = local_by_object(points, rotation, translation)
    for k, step in enumerate(1e-6 * np.eye(6)):
        turned = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        there = local_points(points, turned, translation + step[3:])
        np.testing.assert_allclose((there - local) / 1e-6, found[..., k], atol=1e-5)


def jitter(frames: int, sigma: float) -> np.ndarray:
    """Motion (T, 3) along the palm that changes its direction from frame to frame."""
    way = np.zeros((frames, 3))
    way[:, 0] = sigma * np.array([1, -1] * frames)[:frames]
    return way


@pytest.mark.parametrize("part", [LEFT_HAND, SEAT])
def test_what_a_hand_holds_does_not_slide_in_it(model, box, part) -> None:  # noqa: F811
    state = _state(model, 0.001)
    shaken = moving(state, jitter(len(state), 0.0015))
    tracked = _tracked(shaken, 0.005, np.zeros(len(state), bool))
    data = (_Hold(state, 0.002), ObjectData(tracked))
    scene = _Scene(model, box, shaken, data=data, touching=[part])
    found = minimise(scene.equations, shaken, max_steps=8).state
    # most of the shaking is gone; where another part touches, the seat, nothing holds it
    assert (slip(scene, found) < slip(scene, shaken) / 2) == (part == LEFT_HAND)


def test_what_glides_through_a_hand_glides_on(model, box) -> None:  # noqa: F811
    """At 0.6 m/s along the palm: the evidence says so in every frame."""
    state = _state(model, 0.001)
    way = np.zeros((len(state), 3))
    way[:, 2] = 0.04 * (np.arange(len(state)) - 2)
    gliding = moving(state, way)
    data = (_Hold(state, 0.002), ObjectData(_tracked(gliding, 0.003, np.zeros(len(state), bool))))
    scene = _Scene(model, box, gliding, data=data, touching=[LEFT_HAND])
    found = minimise(scene.equations, gliding, max_steps=8).state
    speed = np.diff(found.translation[:, 2]) * FPS
    np.testing.assert_allclose(speed, 0.6, rtol=0.1)


def test_a_foot_that_stands_stays_and_one_that_swings_swings(model, box) -> None:  # noqa: F811
    """The whole body shakes; then it goes forward at 1 m/s. The floor is under the soles."""
    start = _state(model, 0.5)
    soles = sole_parts(scene_patches(model, box, start), 6)
    assert len(soles) == 4  # heel and ball of both feet
    lowest = model(start.parameters(model)).vertices[0][:, 1].min().item()
    floor = Ground(np.array([0, lowest, 0]), np.array([0, 1.0, 0]))
    for way, still in ((jitter(len(start), 0.002), True), (walk(len(start)), False)):
        body = start.body.copy()
        body[:, -3:] += way
        state = State(body, start.betas, start.expression, start.rotation, start.translation)
        data = (_Hold(state, 0.01), ObjectData(_tracked(state, 0.1, np.zeros(len(state), bool))))
        scene = _Scene(model, box, state, data=data, floor=floor)
        found = minimise(scene.equations, state, max_steps=8).state
        skin = (scene.geometry.at(s).skin[:, scene.geometry.skin.patch[soles[0]]]
                for s in (state, found))  # fmt: skip
        before, after = (np.linalg.norm(np.diff(x, axis=0), axis=2).mean() for x in skin)
        assert after < before / 3 if still else after > 0.9 * before


def scene_patches(model, box, state):  # noqa: F811
    return _Scene(model, box, state).geometry.patches


def walk(frames: int) -> np.ndarray:
    """Forward at 1 m/s (T, 3)."""
    way = np.zeros((frames, 3))
    way[:, 2] = np.arange(frames) / FPS
    return way


def test_low_and_still_stands_high_or_fast_swings() -> None:
    rng = np.random.default_rng(1)
    frames = 30
    sole = np.tile(rng.normal(scale=0.03, size=(1, 6, 3)), (frames, 1, 1))
    sole += rng.normal(scale=0.001, size=(frames, 1, 3))
    height = np.full((frames, 6), 0.004)
    assert standing_probability(sole, height, FPS).min() > 0.95
    # on a beam or a stool's bar it has to be stiller to be believed
    assert standing_probability(sole, height + 0.25, FPS).min() > 0.8
    sways = sole + np.linspace(0, 0.08 * frames / FPS, frames)[:, None, None] * [1.0, 0, 0]
    assert standing_probability(sways, height, FPS).min() > 0.8
    assert standing_probability(sways, height + 0.25, FPS).max() < 0.1
    assert standing_probability(sole, None, FPS).min() > 0.9  # no floor known
    step = sole.copy()
    step[10:15, :, 0] += np.linspace(0.1, 0.5, 5)[:, None]
    step[15:, :, 0] += 0.5
    found = standing_probability(step, height, FPS)
    assert found[10:14].max() < 0.05 and found[:8].min() > 0.9 and found[17:].min() > 0.9
    assert len(standing_probability(sole[:1], height[:1], FPS)) == 0


def test_one_frame_has_nothing_to_slide(model, box) -> None:  # noqa: F811
    state = _state(model, 0.001)
    one = State(
        state.body[:1],
        state.betas,
        state.expression[:1],
        state.rotation[:1],
        state.translation[:1],
    )
    data = (_Hold(one, 0.01), ObjectData(_tracked(one, 0.01, np.zeros(1, bool))))
    scene = _Scene(model, box, one, data=data, touching=[LEFT_HAND])
    equations: NormalEquations = scene.equations(one)
    assert "stick" not in equations.energy and "plant" not in equations.energy
    assert minimise(scene.equations, one, max_steps=4).equations.total <= equations.total


def test_a_sole_that_holds_a_board_has_all_of_its_weight(model, box) -> None:  # noqa: F811
    """A patch of many vertices that share alike is thinned, at any probability."""
    for probability in (1.0, 0.3):
        holds = np.full((4, 240), probability / 240)
        some, weight = _representatives(holds)
        assert len(some) == STICK_VERTICES and len(np.unique(some)) == len(some)
        np.testing.assert_allclose(weight.sum(1), probability)
    holds[2] = 0.0
    assert _representatives(holds)[1][2].sum() == 0


def test_at_a_minimum_a_refused_step_is_the_end(model, box) -> None:  # noqa: F811
    state = _state(model, 0.001)
    data = (_Hold(state, 0.01), ObjectData(_tracked(state, 0.01, np.zeros(len(state), bool))))
    scene = _Scene(model, box, state, data=data, touching=[LEFT_HAND])
    there = minimise(scene.equations, state, max_steps=40).state
    again = minimise(scene.equations, there, max_steps=40)
    assert again.converged and again.steps <= 2
