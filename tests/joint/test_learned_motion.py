"""E_S by LEMO's encoder, with random weights: the energy's mathematics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.body import lemo
from intercap_core.body.lemo import MotionEncoder
from intercap_core.body.model import BodyModel
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.minimise import minimise
from intercap_core.joint.problem import Problem
from intercap_core.joint.skin import contact_patches
from intercap_core.joint.state import ALL, BODY, BODY_SHIFT, State
from intercap_core.joint.terms.motion import (
    BODY_ACCELERATION,
    PROBE_STEPS,
    BodyMotion,
    LearnedMotion,
)
from intercap_core.joint.terms.term import Term
from tests.helpers.lemo_release import random_state, write_release

FRAMES = 11
UP = np.array([0.0, 1.0, 0.0])


@pytest.fixture(scope="module")
def geometry(body64: BodyModel) -> Geometry:
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    mesh = ObjectMesh(
        "box", np.asarray(box.vertices), np.asarray(box.faces, np.int32), np.arange(8),
        SymmetryGroup.none(), np.zeros((8, 3), np.uint8),
    )  # fmt: skip
    field = DistanceField(mesh.vertices, mesh.faces)
    return Geometry(body64, mesh, field, contact_patches(body64))


@pytest.fixture(scope="module")
def term(geometry: Geometry, tmp_path_factory: pytest.TempPathFactory) -> LearnedMotion:
    return _term(geometry, tmp_path_factory.mktemp("lemo"))


@pytest.fixture(scope="module")
def unbiased(geometry: Geometry, tmp_path_factory: pytest.TempPathFactory) -> LearnedMotion:
    """Of an encoder without biases, which show at the image's ends."""
    return _term(geometry, tmp_path_factory.mktemp("lemo"), bias=0.0, dtype=torch.float32)


def _term(
    geometry: Geometry, folder: Path, *, bias: float = 0.1, dtype: torch.dtype = torch.float64
) -> LearnedMotion:
    files = write_release(folder, random_state(bias=bias)).lemo_files
    assert files is not None
    encoder = MotionEncoder.load(*files, dtype=dtype)
    return LearnedMotion(geometry, encoder, UP, 1.0)


def _moving(seed: int = 0, frames: int = FRAMES) -> State:
    """A body that walks and bends with jitter."""
    rng = np.random.default_rng(seed)
    body = rng.normal(scale=0.01, size=(frames, BODY.stop)) + rng.normal(scale=0.2, size=BODY.stop)
    body[:, BODY_SHIFT] += np.arange(frames)[:, None] * [0.03, 0.0, 0.01]
    return State(
        body, np.zeros(10), np.zeros((frames, 10)), np.tile(np.eye(3), (frames, 1, 1)),
        np.zeros((frames, 3)),
    )  # fmt: skip


def _equations(term: Term, state: State) -> NormalEquations:
    found = NormalEquations(len(state))
    term.add(state, found)
    return found


def test_gradient_is_the_derivative_of_the_energy(term: LearnedMotion) -> None:
    state = _moving()
    term.refresh(state)
    here = _equations(term, state)
    assert list(here.energy) == ["body_motion"] and here.total > 0
    rng = np.random.default_rng(1)
    for _ in range(2):
        direction = rng.normal(size=(FRAMES, ALL.stop))
        direction /= np.linalg.norm(direction)
        up, down = (_equations(term, state.moved(s * direction)).total for s in (1e-5, -1e-5))
        slope = float((here.gradient * direction).sum())
        assert (up - down) / 2e-5 == pytest.approx(slope, rel=1e-3, abs=1e-3 * abs(slope) + 1e-6)


def test_curvature_bounds_the_energy_and_steps_lower_it(term: LearnedMotion) -> None:
    state = _moving()
    term.refresh(state)
    here = _equations(term, state)
    here.bands[0][:, range(ALL.stop), range(ALL.stop)] += 1e-3 * here.damped.max()
    bands = here.bands.copy()  # a step spends them
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


def test_at_rest_there_is_no_energy_and_nothing_to_gain(unbiased: LearnedMotion) -> None:
    state = _moving()
    still = State(
        np.tile(state.body[:1], (FRAMES, 1)), state.betas, state.expression, state.rotation,
        state.translation,
    )  # fmt: skip
    unbiased.refresh(still)
    here = _equations(unbiased, still)
    assert here.total == 0 and not here.gradient.any()
    unbiased.refresh(state)
    assert _equations(unbiased, state).total > 1


def test_the_energy_is_the_same_wherever_one_stands_and_looks(
    geometry: Geometry, term: LearnedMotion
) -> None:
    state = _moving()
    term.refresh(state)
    energy = _equations(term, state).total
    turn = Rotation.from_rotvec(1.2 * UP)
    body, pelvis = state.body.copy(), geometry.at(state).joints[0][:, 0]
    body[:, :3] = (turn * Rotation.from_rotvec(state.body[:, :3])).as_rotvec()
    fixed = pelvis - state.body[:, BODY_SHIFT]  # turns about the pelvis leave it where it is
    body[:, BODY_SHIFT] = turn.apply(pelvis) - fixed + [3.0, 0.0, -2.0]
    turned = State(body, state.betas, state.expression, state.rotation, state.translation)
    term.refresh(turned)
    assert _equations(term, turned).total == pytest.approx(energy, rel=1e-6)


def test_everyday_motion_costs_as_much_as_in_the_joints_term(
    geometry: Geometry, unbiased: LearnedMotion
) -> None:
    """A body that moves as one; with small accelerations, where the joints' term is quadratic."""
    rng, frames = np.random.default_rng(2), PROBE_STEPS + 1
    shift = np.cumsum(np.cumsum(rng.normal(size=(frames, 3)), 0), 0) / lemo.FRAMES_PER_SECOND**2
    state = _moving(frames=frames)
    body = np.tile(state.body[:1], (frames, 1))
    body[:, BODY_SHIFT] = 0.1 * BODY_ACCELERATION * shift
    moved = State(body, state.betas, state.expression, state.rotation, state.translation)
    joints = BodyMotion(geometry, lemo.FRAMES_PER_SECOND, 1.0)
    unbiased.refresh(moved)
    ratio = _equations(unbiased, moved).total / _equations(joints, moved).total
    assert 0.5 < ratio < 2


class _Hold(Term):
    """Holds the body where it was seen."""

    name = "body_data"

    def __init__(self, seen: State) -> None:
        self._seen = seen

    def add(self, state: State, equations: NormalEquations) -> None:
        off = (state.body - self._seen.body) / 0.01
        hessian = np.repeat(np.eye(BODY.stop)[None] / 0.01**2, len(state), axis=0)
        energy = 0.5 * np.square(off).sum(axis=1)
        equations.add_blocks(self.name, BODY, hessian, off / 0.01, energy)
        equations.bands[0][:, range(BODY.stop, ALL.stop), range(BODY.stop, ALL.stop)] += 1.0


def test_a_fit_lowers_it(term: LearnedMotion) -> None:
    seen = _moving()
    problem = Problem((_Hold(seen), term))
    problem.refresh(seen)
    found = minimise(problem.equations, seen, max_steps=3)
    assert found.steps == 3 and found.refused == 0
    assert found.equations.energy["body_motion"] < 0.9 * found.energy_before["body_motion"]
