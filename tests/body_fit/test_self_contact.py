"""E_P_self: constructed contacts by winding numbers, and a fit that separates limbs."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import scipy.spatial.distance
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
def samples(body: BodyModel) -> Samples:
    return choose_samples(body)


@pytest.fixture(scope="module")
def contact(body: BodyModel, samples: Samples) -> SelfContact:
    return SelfContact.of(body, samples)


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
    body: BodyModel, contact: SelfContact
) -> None:
    for params in (body.zeros(), _pose(body), _pose(body, left_elbow=(0, -90, 0))):
        assert _depth(body, params, _find(body, contact, params)) < SELF_TOLERANCE_M


def _penetrating(
    contact: SelfContact, vertices: Tensor, normals: Tensor, same_hand: bool
) -> Iterator[tuple[int, int]]:
    """Sample and surface vertex of each contact with fingers of the same hand, or all others."""
    skin, outward = vertices.numpy(), normals.numpy()
    far = scipy.spatial.distance.cdist(skin[contact.vertex], skin[contact.vertex])
    one_hand = (contact.hand[:, None] == contact.hand) & (contact.hand >= 0)
    far[~contact.apart | (one_hand != same_hand)] = np.inf
    for i, j in enumerate(far.argmin(1)):
        v, patch = contact.vertex[i], contact.patch[j][contact.patch_part[j] == contact.part[j]]
        outer = patch[np.linalg.norm(skin[v] - skin[patch], axis=1).argmin()]
        gap, normal = skin[v] - skin[outer], outward[outer]
        height = gap @ normal
        near = np.linalg.norm(gap - height * normal) < contact.sideways[j]
        near &= np.isfinite(far[i, j]) and -contact.deepest[j] < height < 0.004
        if near and not (same_hand and outward[v] @ normal >= 0):
            yield int(v), int(outer)


@pytest.mark.parametrize("name", CASES)
def test_contacts_are_inside_by_winding_number(
    name: str, body: BodyModel, contact: SelfContact
) -> None:
    vertices, normals = (values[0] for values in posed_normals(body, _pose(body, **CASES[name])))
    inner, outer, normal = find_contacts(contact, vertices, normals)
    expected = {
        pair
        for search in (False, True)
        for pair in _penetrating(contact, vertices, normals, search)
    }
    assert set(zip(inner.tolist(), outer.tolist(), strict=True)) == expected
    depth = -((vertices[inner] - vertices[outer]) * normal).sum(1)
    deep = inner[depth > SELF_TOLERANCE_M]
    assert len(deep) >= 3
    # just outside its own skin, the mesh is wound around a point only inside another part
    just_outside = vertices[deep] + 1e-3 * normals[deep]
    wound = _winding(just_outside, vertices[body.faces])
    assert float((wound > 0.5).float().mean()) > 0.9


def test_geodesic_distances_are_right_up_to_their_limit(body: BodyModel, samples: Samples) -> None:
    template, faces = body.template.double().numpy(), body.faces.numpy()
    part, vertex = body.skinning_weights.argmax(1).numpy(), samples.vertex[::9]
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
    name: str, body: BodyModel, contact: SelfContact, samples: Samples
) -> None:
    """Keypoints with 20 mm of noise put parts inside each other; with the term, they touch."""
    params = _pose(body, **CASES[name])
    truth = body.keypoints_of(params)[:, :67]
    problem = BodyProblem(
        model=body, keypoints=keypoint_set(body, range(67)), samples=samples,
        base=params.vector().clone(),
        columns=columns_of(body, hands=True, face=False, betas=False), one_shape=False,
        offsets=torch.zeros(25, 3), u=torch.zeros(len(COVERINGS)),
        targets=Targets(truth, torch.ones(1, 67), 0.02),
    )  # fmt: skip
    before = _depth(body, params, _find(body, contact, params))
    for _ in range(3):
        problem.pairs = _find(body, contact, body.parameters(problem.base))
        solution = minimise(problem, problem.own_start(), max_trials=10)
        problem.accept(solution.own, solution.shared)
    here = body.parameters(problem.base)
    after = _depth(body, here, _find(body, contact, here))
    assert before > 0.008
    assert after - SELF_TOLERANCE_M < 0.5 * (before - SELF_TOLERANCE_M)
    moved = (body.keypoints_of(here)[:, :67] - truth).norm(dim=2)
    assert float(moved.median()) < 0.03
