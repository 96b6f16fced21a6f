"""The joint fit's equations where there is no object."""

from __future__ import annotations

import numpy as np

from intercap_core.joint.contact.estimate import ContactEstimate
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.skin import contact_patches
from intercap_core.joint.state import ALL, BODY, OBJECT, State
from intercap_core.joint.terms.object_data import NoObject
from intercap_core.schemas import CONTACT_REGIONS
from tests.helpers.bodies import open_body

FRAMES = 4


def _state() -> State:
    rng = np.random.default_rng(5)
    return State(
        rng.normal(0, 0.1, (FRAMES, BODY.stop)),
        np.zeros(10),
        np.zeros((FRAMES, 10)),
        np.tile(np.eye(3), (FRAMES, 1, 1)),
        np.zeros((FRAMES, 3)),
    )


def test_the_body_steps_as_if_the_object_were_not_among_the_unknowns() -> None:
    """A quadratic in the body alone is at its minimum after one step; the object's poses stay
    unknown."""
    alone, target = _state().without_object(), _state().body + 0.05
    equations = NormalEquations(FRAMES)
    NoObject().add(alone, equations)
    weight = np.random.default_rng(6).uniform(1, 3, (FRAMES, BODY.stop))
    residual = alone.body - target
    hessian = weight[..., None] * np.eye(BODY.stop)
    energy = 0.5 * (weight * residual**2).sum(1)
    equations.add_blocks("quadratic", BODY, hessian, weight * residual, energy)
    assert set(equations.energy) == {"quadratic"}
    step = equations.step(np.zeros(FRAMES))
    assert step is not None and step.shape == (FRAMES, ALL.stop)
    assert (step[:, OBJECT] == 0).all()
    moved = alone.moved(step)
    np.testing.assert_allclose(moved.body, target, atol=1e-12)
    assert np.isnan(moved.rotation).all() and np.isnan(moved.translation).all()


def test_without_the_term_nothing_can_be_solved() -> None:
    equations = NormalEquations(FRAMES)
    eye = np.tile(np.eye(BODY.stop), (FRAMES, 1, 1))
    equations.add_blocks("quadratic", BODY, eye, np.zeros((FRAMES, BODY.stop)), np.zeros(FRAMES))
    assert equations.step(np.zeros(FRAMES)) is None


def test_a_geometry_without_a_mesh_has_a_body() -> None:
    model = open_body()
    geometry = Geometry(model, None, None, contact_patches(model))
    alone = _state().without_object()
    assert not geometry.has_object
    assert np.isfinite(geometry.at(alone).skin).all()
    assert np.isfinite(geometry.at(alone).joints[0]).all()


def test_contact_that_is_not_known_does_not_change() -> None:
    shape = (FRAMES, len(CONTACT_REGIONS))
    labels = np.full(shape, -1, np.int8)
    unknown, half, none = (
        ContactEstimate(np.full(shape, value), labels) for value in (np.nan, 0.5, 0.0)
    )
    assert unknown.change(unknown) == 0
    assert half.change(none) == 0.5
