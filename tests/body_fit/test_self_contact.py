"""E_P_self: constructed contacts by winding numbers, and a fit that separates limbs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.body_fit import self_contact
from intercap_core.body_fit.problem import BodyProblem, columns_of
from intercap_core.body_fit.self_contact import SelfContact, find_contacts, join_frames
from intercap_core.body_fit.self_term import SELF_TOLERANCE_M
from intercap_core.body_fit.surface import COVERINGS, Samples, choose_samples
from intercap_core.body_fit.term_inputs import Pairs, Targets, keypoint_set
from intercap_core.geometry.solve.levenberg_marquardt import minimise
from tests.helpers.bodies import posed_normals


@pytest.fixture(scope="module")
def samples(body64: BodyModel) -> Samples:
    return choose_samples(body64)


@pytest.fixture(scope="module")
def contact(body64: BodyModel, samples: Samples) -> SelfContact:
    return SelfContact.of(body64, samples)


def _pose(model: BodyModel, **turns: tuple[float, float, float]) -> BodyParameters:
    """Arms hanging, then the named joints' rotation vectors, degrees."""
    vector = model.zeros().vector().clone()
    joints = {"left_shoulder": (0, 0, -78), "right_shoulder": (0, 0, 78)} | turns
    for name, degrees in joints.items():
        at = 3 * JOINT_INDEX[name]
        vector[0, at : at + 3] = torch.deg2rad(torch.tensor(degrees, dtype=vector.dtype))
    return model.parameters(vector)


# A hand in its thigh, sitting; an arm in the trunk's side; thighs, and two fingers, through
# each other.
CASES: dict[str, dict[str, tuple[float, float, float]]] = {
    "hand in thigh": {"left_hip": (-80, 0, 0), "left_knee": (85, 0, 0),
                      "left_shoulder": (0, 0, -90), "left_elbow": (0, -75, 0)},
    "arm at trunk": {"right_shoulder": (0, 0, 84)},
    "crossed legs": {"left_hip": (-85, 0, -14), "left_knee": (60, 0, 0), "right_hip": (-78, 0, 14),
                     "right_knee": (60, 0, 0)},
    "crossed fingers": {"left_index1": (0, 20, -40), "left_index2": (0, 0, -40),
                        "left_middle1": (0, -20, -40), "left_middle2": (0, 0, -40)},
}  # fmt: skip


def _find(model: BodyModel, contact: SelfContact, params: BodyParameters) -> Pairs | None:
    posed = zip(*posed_normals(model, params), strict=True)
    return join_frames([find_contacts(contact, *each) for each in posed])


def _depth(model: BodyModel, params: BodyParameters, pairs: Pairs | None) -> float:
    if pairs is None:
        return 0.0
    points = model.forward(params, vertex_ids=pairs.vertices).vertices
    gap = points[pairs.frame, pairs.inner] - points[pairs.frame, pairs.outer]
    return max(float(-(pairs.normal * gap).sum(1).min()), 0.0)


def _winding(points: Tensor, triangles: Tensor) -> Tensor:
    """Winding number of a closed mesh (F,3,3) at points (N,): van Oosterom, Strackee 1983."""
    a, b, c = (triangles[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = a.norm(dim=2), b.norm(dim=2), c.norm(dim=2)
    above = (a * torch.linalg.cross(b, c)).sum(2)
    below = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return torch.atan2(above, below).sum(1) / (2 * np.pi)


def test_nothing_touches_at_rest_or_with_hanging_arms(
    body64: BodyModel, contact: SelfContact
) -> None:
    for params in (body64.zeros(), _pose(body64), _pose(body64, left_elbow=(0, -90, 0))):
        assert _depth(body64, params, _find(body64, contact, params)) < SELF_TOLERANCE_M


@pytest.mark.parametrize("name", CASES)
def test_contacts_are_inside_by_winding_number_in_both_forms(
    name: str, body64: BodyModel, contact: SelfContact
) -> None:
    vertices, normals = (
        values[0] for values in posed_normals(body64, _pose(body64, **CASES[name]))
    )
    compiled = find_contacts(contact, vertices, normals)
    for ours, theirs in zip(
        compiled, self_contact.find_in_torch(contact, vertices, normals), strict=True
    ):
        assert torch.equal(ours, theirs)
    inner, outer, normal = compiled
    depth = -((vertices[inner] - vertices[outer]) * normal).sum(1)
    deep = inner[depth > SELF_TOLERANCE_M]
    assert len(deep) >= 3
    # just outside its own skin, the mesh is wound around a point only inside another part
    just_outside = vertices[deep] + 1e-3 * normals[deep]
    wound = _winding(just_outside, vertices[body64.faces])
    assert float((wound > 0.5).double().mean()) > 0.9


def test_geodesic_distances_are_right_up_to_their_limit(
    body64: BodyModel, samples: Samples
) -> None:
    template, faces = body64.template.numpy(), body64.faces.numpy()
    part, vertex = body64.skinning_weights.argmax(1).numpy(), samples.vertex[::9]
    count = len(vertex)
    limit = np.full((count, count), 10.0)
    every = self_contact._geodesic_distances(template, faces, part, vertex, limit)
    limit = np.random.default_rng(0).uniform(0, 0.4, (count, count))
    limit = limit + limit.T
    found = self_contact._geodesic_distances(template, faces, part, vertex, limit)
    within = every <= limit
    assert 0.05 < within.mean() < 0.95
    np.testing.assert_array_equal(found[within], every[within])
    assert (found[~within] > limit[~within]).all()


@pytest.mark.parametrize("name", CASES)
def test_a_fit_to_keypoints_of_penetrating_limbs_separates_them(
    name: str, body64: BodyModel, contact: SelfContact, samples: Samples
) -> None:
    """Keypoints with 20 mm of noise put parts inside each other; with the term, they touch."""
    params = _pose(body64, **CASES[name])
    truth = body64.keypoints_of(params)[:, :67]
    problem = BodyProblem(
        model=body64, keypoints=keypoint_set(body64, range(67)), samples=samples,
        base=params.vector().clone(),
        columns=columns_of(body64, hands=True, face=False, betas=False), one_shape=False,
        offsets=torch.zeros(25, 3).double(), u=torch.zeros(len(COVERINGS)).double(),
        targets=Targets(truth, torch.ones(1, 67).double(), 0.02),
    )  # fmt: skip
    before = _depth(body64, params, _find(body64, contact, params))
    for _ in range(3):
        problem.pairs = _find(body64, contact, body64.parameters(problem.base))
        solution = minimise(problem, problem.own_start(), max_trials=10)
        problem.accept(solution.own, solution.shared)
    here = body64.parameters(problem.base)
    after = _depth(body64, here, _find(body64, contact, here))
    assert before > 0.008
    assert after - SELF_TOLERANCE_M < 0.5 * (before - SELF_TOLERANCE_M)
    moved = (body64.keypoints_of(here)[:, :67] - truth).norm(dim=2)
    assert float(moved.median()) < 0.03
