"""Colours decide turns that shape leaves open, of an object that has more than one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.rigid.mesh import ObjectMesh, Paint
from intercap_core.geometry.rigid.render import Renderer
from intercap_core.geometry.rigid.shots import Shot, Surface
from intercap_core.object_track.colour_decision import ColourDecision
from intercap_core.object_track.constants import PATCHES_ACROSS
from intercap_core.object_track.decoder import Decoded, decode, given, mixed
from intercap_core.object_track.hypotheses import Hypotheses
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.prior import Prior
from intercap_core.object_track.surface_kernel import patches_of
from intercap_core.object_track.view import View, ViewGeometry
from tests.geometry.rigid.conftest import catalogue
from tests.helpers.object_capture import ObjectCapture

FRAMES, OPEN = 12, 6
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # a toolbox looks alike from behind
GAINS = np.array([[1.0, 1.0, 1.0], [0.8, 0.9, 0.95], [1.1, 1.0, 0.9], [0.9, 1.05, 1.0]])
Paints = Callable[[np.ndarray], np.ndarray]


def plain(points: np.ndarray) -> np.ndarray:
    return np.tile([0.2, 0.35, 0.3], (len(points), 1))


def two_sides(points: np.ndarray) -> np.ndarray:
    """Red before, blue behind: linear light (N, 3)."""
    return np.where(points[:, 1:2] < 0, (0.5, 0.06, 0.05), (0.05, 0.08, 0.4))


@pytest.fixture(scope="module")
def mesh() -> ObjectMesh:
    return ObjectMesh.load(catalogue()["toolbox"]).simplified(600)


@pytest.fixture(scope="module")
def capture(mesh) -> ObjectCapture:
    return ObjectCapture.make(mesh, FRAMES)


@pytest.fixture(scope="module")
def views(capture) -> list[list[View]]:
    found = []
    for t in range(FRAMES):
        found.append([])
        for c, camera in enumerate(capture.rig):
            depth, person, candidates = capture.image(t, c)
            geometry = ViewGeometry.for_object(camera, capture.mesh.diameter)
            found[t].append(View.build(geometry, depth, person, candidates))
    return found


def observer_of(
    capture: ObjectCapture, views: list[list[View]], paints: Paints, paint: Paint | None = None
) -> Observer:
    """Its pictures show the true object in these colours, lit from above, each camera's gain on
    it."""
    mesh, renderer = capture.mesh, Renderer()

    def pictures(t: int) -> list[np.ndarray | None]:
        rng = np.random.default_rng(t)
        found: list[np.ndarray | None] = []
        for c, view in enumerate(views[t]):
            lens = view.geometry.lens
            pose = view.geometry.colour_from_master @ capture.poses[t]
            (drawn,) = renderer.draw(Surface.of(mesh), [Shot(lens, pose)])
            light = np.full((lens.height, lens.width, 3), 0.1)
            rows, columns = np.nonzero(drawn.mask)
            z = drawn.depth[rows, columns][:, None].astype(float)
            rays = lens.rays[rows + drawn.y0, columns + drawn.x0]
            points = (np.concatenate([rays * z, z], 1) - pose[:3, 3]) @ pose[:3, :3]
            up = (mesh.face_normals[drawn.face[rows, columns]] @ capture.poses[t][:3, :3].T) @ (
                capture.master_from_room[:3, 2]
            )
            shade = 0.5 + 0.5 * np.maximum(up, 0)
            light[rows + drawn.y0, columns + drawn.x0] = (
                paints(points) * shade[:, None] * GAINS[c % 4]
            )
            levels = 255 * np.clip(light, 0, 1) ** (1 / 2.2) + rng.normal(0, 2, light.shape)
            found.append(np.clip(levels, 0, 255).astype(np.uint8)[..., ::-1])
        return found

    labels = [[[k.label for k in view.candidates] for view in own] for own in views]
    settings = ObjectTrackSettings()
    return Observer(
        mesh, views.__getitem__, labels, settings, ("suitcase",), pictures=pictures, paint=paint
    )


def decided(observer: Observer, capture: ObjectCapture, open_frames: set[int]) -> Decoded:
    """What colours add where the images of some frames leave open whether the object is turned,
    and nothing says that it does not turn there and back."""
    hypotheses = Hypotheses(
        observer, Prior(observer, 0.1), 0.1, 0.1 * np.arange(len(capture.poses))
    )
    emissions, steps = [], []
    for t, pose in enumerate(capture.poses):
        hypotheses.fits[t] = observer.assess_all(t, np.array([pose, pose @ HALF_TURN]))
        emissions.append(np.array([5.0, 5.0 if t in open_frames else -9.0]))
    together = len(open_frames) == len(capture.poses)  # then it is all turned, or nothing is
    for _ in capture.poses[1:]:
        step = np.full((3, 3), -20.0 if together else 0.0)
        np.fill_diagonal(step, 0.0)
        steps.append(step[None, None])
    before = decode(emissions, steps)
    assert all(
        before.probability[t][:2] == pytest.approx([0.5, 0.5], abs=0.01) for t in open_frames
    )
    return ColourDecision(observer, hypotheses, 1.0, 0.1).decide(emissions, steps, before)


def test_a_printed_object_is_not_taken_for_turned_half_way(capture, views):
    found = decided(observer_of(capture, views, two_sides), capture, {OPEN})
    assert (found.path == 0).all()
    assert found.probability[OPEN][0] > 0.95


def test_an_object_of_one_colour_stays_open(capture, views):
    found = decided(observer_of(capture, views, plain), capture, {OPEN})
    assert found.probability[OPEN][:2] == pytest.approx([0.5, 0.5], abs=0.1)


def test_without_pictures_nothing_changes(capture, views):
    observer = observer_of(capture, views, two_sides)
    observer.pictures = None
    found = decided(observer, capture, {OPEN})
    assert found.probability[OPEN][:2] == pytest.approx([0.5, 0.5], abs=0.01)


def other_sides(points: np.ndarray) -> np.ndarray:
    """Another copy of the object: white before, green behind."""
    return np.where(points[:, 1:2] < 0, (0.8, 0.8, 0.75), (0.1, 0.4, 0.12))


@pytest.mark.parametrize("brought", [None, two_sides, plain, other_sides])
def test_what_is_open_in_all_frames_is_open_but_for_the_colours_of_the_mesh(
    capture, views, mesh, brought
):
    """Learnt colours are relative to the pose they were learnt with, those of a scan are not; a
    scan in other colours than the object's says nothing."""
    paint = None
    if brought is not None:
        rng = np.random.default_rng(0)
        face = rng.integers(len(mesh.faces), size=20000)
        weights = rng.dirichlet((1, 1, 1), len(face))
        points = np.einsum("nk,nkc->nc", weights, mesh.vertices[mesh.faces[face]])
        colours = 255 * brought(points) ** (1 / 2.2)
        paint = Paint(points, mesh.face_normals[face], colours.astype(np.uint8))
    found = decided(observer_of(capture, views, two_sides, paint), capture, set(range(FRAMES)))
    share = np.array([own[0] for own in found.probability])
    if brought is two_sides:
        assert (share > 0.95).all() and (found.path == 0).all()
    else:
        assert share == pytest.approx(0.5, abs=0.2)


def test_patches_are_cells_of_the_surface_and_know_their_side(mesh):
    size = mesh.diameter / PATCHES_ACROSS
    point = np.array([[0.01, 0.02, 0.03]])
    normal = np.array([[0.1, 0.9, 0.2]])
    own = patches_of(point, normal, size)
    assert own == patches_of(point + 1e-4, normal, size)
    assert own != patches_of(point, -normal, size)
    assert own != patches_of(point + np.array([size, 0, 0]), normal, size)


def test_given_a_state_the_others_follow_and_their_mixture_is_the_whole():
    rng = np.random.default_rng(1)
    emissions = [rng.normal(size=n) for n in (2, 3, 2)]
    steps = [rng.normal(size=(2, 2, 3, 4)), rng.normal(size=(2, 2, 4, 3))]
    whole = decode(emissions, steps)
    parts = [given(emissions, steps, 1, k) for k in range(3)]
    for k, part in enumerate(parts):
        assert part.path[1] == k and part.probability[1][k] == pytest.approx(1)
        log_share = np.log(whole.probability[1][k])
        assert part.evidence - whole.evidence == pytest.approx(log_share, abs=1e-6)
    again = mixed(parts)
    share = whole.probability[1][:3]
    assert again.probability[1][:3] == pytest.approx(share / share.sum())
    by_hand = sum(s * part.probability[0] for s, part in zip(share, parts, strict=True))
    assert again.probability[0] == pytest.approx(by_hand / share.sum())
    unseen = decode([emissions[0], np.full(3, -1e4), emissions[2]], steps)
    rest = share.sum() * again.probability[2] + (1 - share.sum()) * unseen.probability[2]
    assert rest == pytest.approx(whole.probability[2], abs=1e-9)
