"""The recipe's terms are ours where the equations are the same, and its gradient is right."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from bench.joint_baseline import (
    Energy,
    ObjectImages,
    Posed,
    RigidAndSkin,
    body_motion,
    contact,
    contact_weights,
    ground,
    object_motion,
    penetration,
    refine,
    standing,
)
from bench.joint_clip import JointClip
from bench.object_baseline import Crops, Recipe
from bench.object_baseline import Energy as ObjectEnergy
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.geometry.rigid.twist import moved
from intercap_core.joint.constants import CONTACT_SIGMA
from intercap_core.joint.contact.patches import contact_patches
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.state import BODY, OBJECT, State
from intercap_core.joint.terms.ground import BodyGround, Ground, ObjectGround
from intercap_core.joint.terms.motion import BodyMotion, ObjectMotion
from intercap_core.joint.terms.penetration import Penetration
from intercap_core.joint.terms.term import Term
from intercap_core.object_track.view import View, ViewGeometry
from intercap_core.schemas import CONTACT_REGIONS
from tests.helpers.bodies import open_body
from tests.helpers.object_capture import ObjectCapture

FRAMES, FPS = 4, 15.0
LEFT_HAND = CONTACT_REGIONS.index("left_hand")


@pytest.fixture(scope="module")
def geometry() -> Geometry:
    solid = trimesh.creation.box((0.1, 0.12, 0.14))
    vertices, faces = np.asarray(solid.vertices), np.asarray(solid.faces, np.int32)
    grey = np.zeros((len(vertices), 3), np.uint8)
    box = ObjectMesh("box", vertices, faces, np.arange(8), SymmetryGroup.none(), grey)
    model = open_body()
    return Geometry(model, box, DistanceField(vertices, faces), contact_patches(model))


@pytest.fixture(scope="module")
def start(geometry: Geometry) -> State:
    """T-poses with a box that the left palm is in, everything shaken."""
    rng = np.random.default_rng(0)
    body = 0.02 * rng.standard_normal((FRAMES, BODY.stop))
    still = State(body, np.zeros(10), np.zeros((FRAMES, 10)), np.tile(np.eye(3), (FRAMES, 1, 1)),
                  np.zeros((FRAMES, 3)))  # fmt: skip
    skin = geometry.model(still.parameters(geometry.model)).vertices.numpy()
    palm = skin[:, geometry.model.regions["left_hand"]].mean(1) - [0, 0.064, 0]
    return State(body, still.betas, still.expression, still.rotation, palm.astype(float))


@pytest.fixture(scope="module")
def clip(geometry: Geometry, start: State) -> JointClip:
    """What the terms that need no image read of a clip."""
    low = geometry.at(start).skin[..., 1].min()
    floor = Ground(np.array([0, low + 0.02, 0]), np.array([0.0, 1.0, 0.0]))
    return cast(JointClip, SimpleNamespace(geometry=geometry, floor=floor))


def _ours(term: Term, state: State) -> tuple[float, np.ndarray]:
    """Energy and gradient (T, 174)."""
    equations = NormalEquations(len(state))
    term.refresh(state)
    term.add(state, equations)
    return equations.total, equations.gradient


def _posed(geometry: Geometry, start: State) -> tuple[Tensor, Posed]:
    x = torch.zeros((len(start), OBJECT.stop), requires_grad=True)
    return x, RigidAndSkin(geometry, start).at(x)


def test_penetration_motion_and_ground_are_ours(
    geometry: Geometry, start: State, clip: JointClip
) -> None:
    assert clip.floor is not None
    x, posed = _posed(geometry, start)
    inside = penetration(posed.distance(), geometry)
    stands_on = standing(posed.object_vertices, clip)
    pairs: list[tuple[Tensor, list[Term]]] = [
        (inside, [Penetration(geometry, 1.0)]),
        (body_motion(posed.joints, FPS), [BodyMotion(geometry, FPS, 1.0)]),
        (object_motion(posed.moments, FPS), [ObjectMotion(geometry, FPS, 1.0)]),
        (
            ground(posed, clip, stands_on),
            [BodyGround(geometry, clip.floor, 1.0), ObjectGround(geometry, clip.floor, 1.0)],
        ),
    ]
    for theirs, terms in pairs:
        (gradient,) = torch.autograd.grad(theirs, x, retain_graph=True)
        energies, gradients = zip(*(_ours(term, start) for term in terms), strict=True)
        assert sum(energies) > 0
        assert theirs.item() == pytest.approx(sum(energies), rel=1e-3)
        scale = np.abs(sum(gradients)).max()
        assert np.abs(gradient.numpy() - sum(gradients)).max() < 2e-3 * scale


def test_contact_is_measured_by_our_distances(geometry: Geometry, start: State) -> None:
    touching = np.zeros((FRAMES, len(CONTACT_REGIONS)), bool)
    touching[1, LEFT_HAND] = True
    weights = contact_weights(geometry, touching)
    assert weights.sum(1).tolist() == pytest.approx([0, 1, 0, 0])
    _, posed = _posed(geometry, start)
    distance = posed.distance().detach().numpy()
    assert distance == pytest.approx(geometry.at(start).proximity.distance, abs=1e-5)
    at_hand = geometry.skin.patch[geometry.patches.region == LEFT_HAND]
    squared = distance[1, at_hand] ** 2
    wanted = np.mean(0.05**2 * squared / (squared + 0.05**2)) / 2 / CONTACT_SIGMA**2
    found = contact(torch.as_tensor(distance[:, geometry.skin.patch]), weights)
    assert found.item() == pytest.approx(wanted, rel=1e-3)


def test_all_frames_drawn_at_once_are_each_frames_equation_1() -> None:
    solid = trimesh.creation.box((0.4, 0.25, 0.15))
    vertices, faces = trimesh.remesh.subdivide(solid.vertices, solid.faces)
    grey = np.full((len(vertices), 3), 128, np.uint8)
    mesh = ObjectMesh(
        "box", vertices, faces.astype(np.int32), np.zeros(0, np.int64), SymmetryGroup.none(), grey
    )
    capture = ObjectCapture.make(mesh, FRAMES, cameras=2)
    poses = np.array([moved(capture.poses[t], 0.02 * np.ones(6)) for t in (0, 3)])
    views = [
        [
            View.build(ViewGeometry.for_object(camera, mesh.diameter), *capture.image(t, c))
            for c, camera in enumerate(capture.rig)
        ]
        for t in (0, 3)
    ]
    none = np.zeros((2, BODY.stop))
    state = State(none, np.zeros(10), np.zeros((2, 10)), poses[:, :3, :3], poses[:, :3, 3])
    labels = ("suitcase",)
    clip = SimpleNamespace(
        tracked=mesh, start=state, views=views, labels=labels,
        object_settings=SimpleNamespace(min_overlap=0.3),
    )  # fmt: skip
    rotation, translation = (
        torch.as_tensor(part, dtype=torch.float32) for part in (state.rotation, state.translation)
    )
    translation.requires_grad_(True)
    empty = torch.zeros(2, 0, 3)
    posed = Posed(cast(Geometry, None), empty, empty, empty, rotation, translation)
    whole = ObjectImages(cast(JointClip, clip))(posed)
    (gradient,) = torch.autograd.grad(whole, translation)
    total = 0.0
    for t, pose in enumerate(poses):
        crops = Crops.cut(mesh, views[t], pose, 0.3, labels)
        assert crops is not None
        place = torch.tensor(pose[:3, 3], dtype=torch.float32, requires_grad=True)
        alone = ObjectEnergy(mesh, crops, pose, Recipe())(torch.zeros(3), place)
        (of_one,) = torch.autograd.grad(alone, place)
        assert gradient[t].numpy() == pytest.approx(of_one.numpy(), rel=1e-2)
        total += alone.item()
    assert total > 0 and whole.item() == pytest.approx(total, rel=1e-3)


def _energy_of(clip: JointClip, start: State) -> Energy:
    """The energy of the terms without images."""
    energy = object.__new__(Energy)
    posing = RigidAndSkin(clip.geometry, start)
    weights = contact_weights(
        clip.geometry, np.eye(len(CONTACT_REGIONS), dtype=bool)[[LEFT_HAND] * FRAMES]
    )
    at_patch = torch.as_tensor(clip.geometry.skin.patch)
    stands_on = standing(_posed(clip.geometry, start)[1].object_vertices.detach(), clip)

    def terms(x: Tensor) -> dict[str, Tensor]:
        posed = posing.at(x)
        distance = posed.distance()
        return {
            "body_data": 0.5 * (x[:, BODY] ** 2).sum() / 0.05**2,
            "contact": contact(distance[:, at_patch], weights),
            "penetration": penetration(distance, clip.geometry),
            "ground": ground(posed, clip, stands_on),
            "object_motion": object_motion(posed.moments, FPS),
        }

    free = cast(Any, energy)
    free.terms, free.observe, free.state = (
        terms,
        lambda x: None,
        lambda x: start.moved(x.detach().double().numpy()),
    )
    return energy


def test_the_gradient_is_that_of_the_energy(clip: JointClip, start: State) -> None:
    energy = _energy_of(clip, start)
    generator = torch.Generator().manual_seed(1)
    x = (0.01 * torch.randn(FRAMES, OBJECT.stop, generator=generator)).requires_grad_(True)
    (gradient,) = torch.autograd.grad(energy(x), x)
    along = gradient / gradient.norm()
    step = 2e-4 * along
    with torch.no_grad():
        ahead, behind = (float(energy(x + sign * step)) for sign in (1, -1))
    assert (ahead - behind) / 4e-4 == pytest.approx(float(gradient.norm()), rel=0.02)


def test_the_recipe_descends_and_counts_its_steps(clip: JointClip, start: State) -> None:
    found = refine(_energy_of(clip, start), FRAMES, 15)
    assert found.steps.tolist() == [0, 10, 15]
    assert (np.diff(found.energy) <= 0).all() and found.energy[-1] < 0.8 * found.energy[0]
    assert found.seconds[0] == 0 and (np.diff(found.seconds) > 0).all()
    assert np.array_equal(found.states[0].body, start.body)
    assert not np.allclose(found.states[-1].body, start.body)
