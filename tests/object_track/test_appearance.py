"""Colours decide between turns that the shape leaves ambiguous."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from intercap_core.geometry.rigid.mesh import Paint
from intercap_core.geometry.rigid.render import Renderer
from intercap_core.geometry.rigid.shots import Shot, Surface
from intercap_core.object_track.appearance import patches_of
from intercap_core.object_track.colour_decision import ColourDecision
from intercap_core.object_track.decoder import Decoded, MarkovModel, mix_decisions
from intercap_core.object_track.hypotheses import Hypotheses
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.view import View
from tests.helpers.object_capture import ObjectCapture
from tests.object_track.scenes import images_of, mesh_of, observer_of

FRAMES, OPEN = 8, 5
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # a near symmetry of a toolbox
GAINS = np.array([[1.0, 1.0, 1.0], [0.8, 0.9, 0.95], [1.1, 1.0, 0.9], [0.9, 1.05, 1.0]])
Paints = Callable[[np.ndarray], np.ndarray]
Image = np.ndarray | None


def plain(points: np.ndarray) -> np.ndarray:
    return np.tile([0.2, 0.35, 0.3], (len(points), 1))


def two_sides(points: np.ndarray) -> np.ndarray:
    """Red before, blue behind: linear light (N, 3)."""
    return np.where(points[:, 1:2] < 0, (0.5, 0.06, 0.05), (0.05, 0.08, 0.4))


@pytest.fixture(scope="module")
def toolbox() -> ObjectCapture:
    return ObjectCapture.make(mesh_of("toolbox"), FRAMES, cameras=3)


@pytest.fixture(scope="module")
def views(toolbox) -> list[list[View]]:
    return images_of(toolbox)


def paint_images(capture: ObjectCapture, views: list[View], t: int, paints: Paints) -> list[Image]:
    """Pictures of the object in these colours, lit from above, with each camera's gain."""
    rng, mesh = np.random.default_rng(t), capture.mesh
    pictures: list[Image] = []
    for c, view in enumerate(views):
        lens = view.geometry.lens
        pose = view.geometry.camera.colour_from_master @ capture.poses[t]
        (drawn,) = Renderer().draw(Surface.of(mesh), [Shot(lens, pose)])
        light = np.full((lens.height, lens.width, 3), 0.1)
        rows, columns = np.nonzero(drawn.mask)
        z = drawn.depth[rows, columns][:, None].astype(float)
        rays = lens.rays[rows + drawn.y0, columns + drawn.x0]
        points = (np.concatenate([rays * z, z], 1) - pose[:3, 3]) @ pose[:3, :3]
        normals = mesh.face_normals[drawn.face[rows, columns]] @ capture.poses[t][:3, :3].T
        shade = 0.5 + 0.5 * np.maximum(normals @ capture.master_from_room[:3, 2], 0)
        light[rows + drawn.y0, columns + drawn.x0] = paints(points) * shade[:, None] * GAINS[c]
        levels = 255 * np.clip(light, 0, 1) ** (1 / 2.2) + rng.normal(0, 2, light.shape)
        pictures.append(np.clip(levels, 0, 255).astype(np.uint8)[..., ::-1])
    return pictures


@pytest.fixture(scope="module")
def observe(toolbox, views) -> Callable[..., Observer]:
    """Observers of the toolbox in given colours; pictures are painted once."""
    pictures = cache(lambda paints, t: paint_images(toolbox, views[t], t, paints))

    def make(paints: Paints, paint: Paint | None = None) -> Observer:
        observer = observer_of(
            toolbox,
            views,
            times=0.1 * np.arange(FRAMES),
            pictures=lambda t: pictures(paints, t),
            paint=paint,
        )
        observer.share = 1.0  # each frame is an independent observation
        return observer

    return make


def decide(observer: Observer, capture: ObjectCapture, open_frames: set[int]) -> Decoded:
    """Result with colours if the images of ``open_frames`` do not decide a half turn."""
    hypotheses = Hypotheses(observer)
    emissions, steps = [], []
    for t, pose in enumerate(capture.poses):
        hypotheses.fits[t] = observer.assess_all(t, np.array([pose, pose @ HALF_TURN]))
        emissions.append(np.array([5.0, 5.0 if t in open_frames else -9.0]))
    together = len(open_frames) == len(capture.poses)  # then it is all turned, or nothing is
    for _ in capture.poses[1:]:
        step = np.full((3, 3), -20.0 if together else 0.0)
        np.fill_diagonal(step, 0.0)
        steps.append(step[None, None])
    before = MarkovModel(emissions, steps).decode()
    assert all(
        before.probability[t][:2] == pytest.approx([0.5, 0.5], abs=0.01) for t in open_frames
    )
    model = MarkovModel(emissions, steps, 1.0)
    return ColourDecision(observer, hypotheses).decide(model, before)


def test_colours_decide_a_single_ambiguous_frame(toolbox, observe):
    found = decide(observe(two_sides), toolbox, {OPEN})
    assert (found.path == 0).all()
    assert found.probability[OPEN][0] > 0.95


def test_an_object_of_one_colour_stays_ambiguous(toolbox, observe):
    found = decide(observe(plain), toolbox, {OPEN})
    assert found.probability[OPEN][:2] == pytest.approx([0.5, 0.5], abs=0.1)


def test_nothing_changes_without_pictures(toolbox, observe):
    observer = observe(two_sides)
    observer.pictures = None
    found = decide(observer, toolbox, {OPEN})
    assert found.probability[OPEN][:2] == pytest.approx([0.5, 0.5], abs=0.01)


def other_sides(points: np.ndarray) -> np.ndarray:
    """Another copy of the object: white before, green behind."""
    return np.where(points[:, 1:2] < 0, (0.8, 0.8, 0.75), (0.1, 0.4, 0.12))


@pytest.mark.parametrize("brought", [None, two_sides, plain, other_sides])
def test_only_the_right_colours_of_the_mesh_decide_all_frames(toolbox, observe, brought):
    """Learnt colours are relative to the pose they were learnt with, those of a scan are not. A
    scan in other colours decides nothing."""
    paint, mesh = None, toolbox.mesh
    if brought is not None:
        rng = np.random.default_rng(0)
        face = rng.integers(len(mesh.faces), size=20000)
        weights = rng.dirichlet((1, 1, 1), len(face))
        points = np.einsum("nk,nkc->nc", weights, mesh.vertices[mesh.faces[face]])
        colours = 255 * brought(points) ** (1 / 2.2)
        paint = Paint(points, mesh.face_normals[face], colours.astype(np.uint8))
    found = decide(observe(two_sides, paint), toolbox, set(range(FRAMES)))
    share = np.array([own[0] for own in found.probability])
    if brought is two_sides:
        assert (share > 0.95).all() and (found.path == 0).all()
    else:
        assert share == pytest.approx(0.5, abs=0.2)


def test_patches_are_cells_of_one_side_of_the_surface(toolbox):
    size = toolbox.mesh.diameter / 12
    point = np.array([[0.01, 0.02, 0.03]])
    normal = np.array([[0.1, 0.9, 0.2]])
    own = patches_of(point, normal, size)
    assert own == patches_of(point + 1e-4, normal, size)
    assert own != patches_of(point, -normal, size)
    assert own != patches_of(point + np.array([size, 0, 0]), normal, size)


def test_results_given_each_state_average_to_the_whole():
    rng = np.random.default_rng(1)
    emissions = [rng.normal(size=n) for n in (2, 3, 2)]
    steps = [rng.normal(size=(2, 2, 3, 4)), rng.normal(size=(2, 2, 4, 3))]
    model = MarkovModel(emissions, steps)
    whole = model.decode()
    parts = [model.decode_given(1, k) for k in range(3)]
    for k, part in enumerate(parts):
        assert part.path[1] == k and part.probability[1][k] == pytest.approx(1)
        log_share = np.log(whole.probability[1][k])
        assert part.evidence - whole.evidence == pytest.approx(log_share, abs=1e-6)
    again = mix_decisions(parts)
    share = whole.probability[1][:3]
    assert again.probability[1][:3] == pytest.approx(share / share.sum())
    by_hand = sum(s * part.probability[0] for s, part in zip(share, parts, strict=True))
    assert again.probability[0] == pytest.approx(by_hand / share.sum())
    unseen = MarkovModel([emissions[0], np.full(3, -1e4), emissions[2]], steps).decode()
    rest = share.sum() * again.probability[2] + (1 - share.sum()) * unseen.probability[2]
    assert rest == pytest.approx(whole.probability[2], abs=1e-9)
