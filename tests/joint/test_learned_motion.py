"""E_S by LEMO's encoder, with random weights and few channels: the mathematics of the energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.body import lemo
from intercap_core.body.parameters import TRANSL
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.state import ALL, BODY, State
from intercap_core.joint.terms.motion import (
    BODY_ACCELERATION,
    BodyMotion,
    LearnedMotion,
)
from intercap_core.joint.terms.term import JointTerm, TermContext
from tests.helpers.lemo_release import random_encoder
from tests.joint.scenes import Scene, bodies, check_gradient

FRAMES = 11
UP = np.array([0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def context(body64) -> TermContext:
    context = Scene(body64, bodies(body64, 1.0)).context
    return replace(context, encoder=random_encoder(), up=UP, fps=lemo.FRAMES_PER_SECOND)


@pytest.fixture(scope="module")
def term(context) -> LearnedMotion:
    return LearnedMotion(context)


@pytest.fixture(scope="module")
def unbiased(context) -> LearnedMotion:
    """The term of an encoder without biases, which show at the image's ends."""
    return LearnedMotion(replace(context, encoder=random_encoder(bias=0.0)))


def _moving(frames: int = FRAMES) -> State:
    """A body that walks and bends with jitter."""
    rng = np.random.default_rng(0)
    body = rng.normal(scale=0.01, size=(frames, BODY.stop)) + rng.normal(scale=0.2, size=BODY.stop)
    body[:, TRANSL] += np.arange(frames)[:, None] * [0.03, 0.0, 0.01]
    rotation = np.tile(np.eye(3), (frames, 1, 1))
    return State(body, np.zeros(10), np.zeros((frames, 10)), rotation, np.zeros((frames, 3)))


def _equations(term: JointTerm, state: State) -> BandedEquations:
    sums = BandedEquations(len(state))
    term.add(state, sums)
    return sums


def test_gradient_is_the_derivative_of_the_energy(term):
    state = _moving()
    term.refresh(state)
    check_gradient(term, state, step=1e-5, rel=1e-3)


def test_curvature_bounds_the_energy_and_steps_lower_it(term):
    state = _moving()
    term.refresh(state)
    here = _equations(term, state)
    here.bands[0][:, range(ALL.stop), range(ALL.stop)] += 1e-3 * here.damped.max()
    bands = here.bands.copy()  # a step consumes them
    step = here.step(np.zeros(FRAMES))
    assert step is not None
    promised = float((here.gradient * step).sum())
    actual = _equations(term, state.moved(step)).total - here.total
    curvature = sum(
        (2 if d else 1) * float(
            np.einsum("ti,tij,tj->", step[d:], bands[d, : FRAMES - d], step[: FRAMES - d])
        )
        for d in range(3)
    )  # fmt: skip
    assert promised < actual < 0
    assert actual <= promised + 0.5 * curvature


def test_no_energy_and_no_gradient_at_rest(unbiased):
    state = _moving()
    still = replace(state, body=np.tile(state.body[:1], (FRAMES, 1)))
    unbiased.refresh(still)
    here = _equations(unbiased, still)
    assert here.total == 0 and not here.gradient.any()
    unbiased.refresh(state)
    assert _equations(unbiased, state).total > 1


def test_energy_does_not_depend_on_place_and_heading(context, term):
    state = _moving()
    term.refresh(state)
    energy = _equations(term, state).total
    turn = Rotation.from_rotvec(1.2 * UP)
    body, pelvis = state.body.copy(), context.geometry.at(state).joints[:, 0]
    body[:, :3] = (turn * Rotation.from_rotvec(state.body[:, :3])).as_rotvec()
    fixed = pelvis - state.body[:, TRANSL]  # turns about the pelvis leave it where it is
    body[:, TRANSL] = turn.apply(pelvis) - fixed + [3.0, 0.0, -2.0]
    turned = replace(state, body=body)
    term.refresh(turned)
    assert _equations(term, turned).total == pytest.approx(energy, rel=1e-6)


def test_everyday_motion_costs_as_much_as_in_the_joints_term(context, unbiased):
    """A translating body with small accelerations, for which the joints' term is quadratic."""
    rng, frames = np.random.default_rng(2), 17
    shift = np.cumsum(np.cumsum(rng.normal(size=(frames, 3)), 0), 0) / lemo.FRAMES_PER_SECOND**2
    state = _moving(frames=frames)
    body = np.tile(state.body[:1], (frames, 1))
    body[:, TRANSL] = 0.1 * BODY_ACCELERATION * shift
    moved = replace(state, body=body)
    unbiased.refresh(moved)
    joints = BodyMotion(context)
    ratio = _equations(unbiased, moved).total / _equations(joints, moved).total
    assert 0.5 < ratio < 2
