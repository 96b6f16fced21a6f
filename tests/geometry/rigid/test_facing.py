"""Contact of surfaces that face each other: walls, rims, plates and solids."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from bench.evaluate.through_wall import behind_wall
from intercap_core.evaluation.contact import vertex_contact
from intercap_core.geometry.rigid.facing import facing_distance
from intercap_core.geometry.rigid.surface_tree import SurfaceTree
from intercap_core.geometry.rigid.surfaces import face_normals, sample_surface
from intercap_core.schemas import CONTACT_M

FINGER_M, INNER_M, OUTER_M, HEIGHT_M = 0.008, 0.036, 0.039, 0.09  # radii and height


class Surface:
    """A mesh with evenly spread points."""

    def __init__(self, mesh: trimesh.Trimesh, *, watertight: bool = True) -> None:
        self.vertices, self.faces = np.array(mesh.vertices, float), np.array(mesh.faces)
        samples = sample_surface(self.vertices, self.faces, 4000)
        self.points = samples.of(self.vertices, self.faces)
        self.normals = watertight * face_normals(self.vertices, self.faces)[samples.faces]
        self.surface = SurfaceTree(self.vertices, self.faces).shaped(self.vertices)

    def distances(self, other: Surface) -> tuple[np.ndarray, np.ndarray]:
        """Signed and contact distances of the points to another surface."""
        signed = other.surface.signed_distance(self.points, 0.1, 0.25)
        facing = facing_distance(
            self.points, self.normals, signed, self.surface, other.surface, 0.03
        )
        return signed, facing

    def touched(self, other: Surface) -> np.ndarray:
        return vertex_contact(self.distances(other)[1])


def make_finger(*at: float) -> Surface:
    capsule = trimesh.creation.capsule(height=0.02, radius=FINGER_M, count=[24, 24])
    return Surface(capsule.apply_translation(at))


@pytest.fixture(scope="module")
def cup() -> Surface:
    return Surface(trimesh.creation.annulus(INNER_M, OUTER_M, HEIGHT_M, sections=48))


def radius(cup: Surface) -> np.ndarray:
    return np.hypot(*cup.points[:, :2].T)


@pytest.mark.parametrize("gap", [0.001, -0.001, -0.004])
def test_finger_outside_touches_the_outer_wall_only(cup: Surface, gap: float) -> None:
    """Also if the finger penetrates the wall, and if its tip is in the hollow."""
    finger = make_finger(OUTER_M + FINGER_M + gap, 0, 0)
    touched, inner = cup.touched(finger), radius(cup) < INNER_M + 1e-4
    assert touched[~inner].any() and not touched[inner].any()
    assert vertex_contact(cup.distances(finger)[0])[inner].any()  # the distance alone
    assert finger.touched(cup).any()


def test_finger_inside_touches_the_inner_wall_only(cup: Surface) -> None:
    finger = make_finger(INNER_M - FINGER_M - 0.001, 0, 0)
    touched = cup.touched(finger)
    assert touched.any() and (radius(cup)[touched] < INNER_M + 1e-4).all()


def test_finger_on_the_rim_touches_the_rim(cup: Surface) -> None:
    finger = make_finger((INNER_M + OUTER_M) / 2, 0, HEIGHT_M / 2 + 0.01 + FINGER_M + 0.001)
    touched = cup.touched(finger)
    assert touched.any() and (cup.normals[touched, 2] > 0.9).all()


def test_pinch_touches_both_sides_of_a_plate() -> None:
    """A plate thinner than the threshold: the nearer finger is behind the plate."""
    plate = Surface(trimesh.creation.box((0.1, 0.1, 0.001)))
    below, above = (s * (0.0005 + FINGER_M + 0.01) for s in (-1.0003, 1.15))
    fingers = [make_finger(0, 0, below).vertices, make_finger(0, 0, above).vertices]
    faces = make_finger(0, 0, 0).faces
    hand = Surface(trimesh.Trimesh(np.concatenate(fingers), np.r_[faces, faces + len(fingers[0])]))
    touched, up = plate.touched(hand), plate.normals[:, 2] > 0.9
    assert touched[up].any() and touched[~up].any()
    single = plate.touched(make_finger(0, 0, below))
    assert not single[up].any() and single[~up].any()


def test_a_second_layer_blocks() -> None:
    layers = trimesh.util.concatenate(
        [trimesh.creation.box((0.1, 0.1, 0.0005)).apply_translation((0, 0, z)) for z in (0, 0.002)]
    )
    plates = Surface(layers)
    touched = plates.touched(make_finger(0, 0, 0.00225 + 0.01 + FINGER_M + 0.0005))
    assert touched.any() and (plates.points[touched, 2] > 0.0022).all()


@pytest.mark.parametrize("gap", [0.002, -0.003])
def test_solids_touch_by_distance_alone(gap: float) -> None:
    """A finger on a ball: the rule only leaves out the finger's flanks."""
    ball = Surface(trimesh.creation.icosphere(subdivisions=4, radius=0.05))
    finger = make_finger(0.05 + FINGER_M + gap, 0, 0)
    for one, other in ((ball, finger), (finger, ball)):
        signed, facing = one.distances(other)
        near = signed <= (CONTACT_M if one is ball or gap > 0 else 0)
        assert near.any()
        assert facing[near] == pytest.approx(signed[near])


def test_an_open_sheet_is_touched_from_both_sides() -> None:
    sheet = trimesh.Trimesh(
        [[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]], [[0, 1, 2], [0, 2, 3]]
    )
    for side in (-1, 1):
        finger = make_finger(0, 0, side * (0.01 + FINGER_M + 0.001))
        assert Surface(sheet, watertight=False).touched(finger).any()


def test_points_far_away_face_nothing(cup: Surface) -> None:
    assert np.isinf(cup.distances(make_finger(1, 0, 0))[1]).all()


@pytest.mark.parametrize("gap", [0.001, -0.004])
def test_ray_cast_agrees(cup: Surface, gap: float) -> None:
    """The evaluation's ray cast finds the points behind the wall, and none among those touched."""
    finger = make_finger(OUTER_M + FINGER_M + gap, 0, 0)
    near = vertex_contact(cup.distances(finger)[0])
    meshes = ((cup.vertices, cup.faces), (finger.vertices, finger.faces))
    hidden = behind_wall(cup.points[near], cup.normals[near], *meshes)
    assert not hidden[cup.touched(finger)[near]].any()
    inner = radius(cup)[near] < INNER_M + 1e-4
    assert hidden[inner].any() and not hidden[~inner].any()
