"""People, their shoes, and the colours of objects."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from intercap_core.body.model import BodyModel
from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.studio.objects import object_colours
from intercap_core.studio.stage import StudioStage
from intercap_core.studio.subjects import (
    FEET,
    LEATHER_M,
    SOLE_M,
    Subject,
    build_names,
    in_heavy_shoes,
    shoe_area,
    subject_names,
)


@pytest.fixture(scope="module")
def person() -> Subject:
    return Subject.load("s04")


def _random_pose(batch: int) -> np.ndarray:
    return np.random.default_rng(5).normal(0, 0.35, (batch, 165))


def test_a_dozen_people_of_both_genders() -> None:
    people = [Subject.load(n) for n in subject_names()]
    assert len(people) == 12
    assert sum(p.gender == "female" for p in people) == 6
    heights = [p.height_m for p in people]
    assert 1.45 < min(heights) < 1.6 and 1.8 < max(heights) < 2.0
    with pytest.raises(KeyError, match="s99"):
        Subject.load("s99")


def test_other_builds_are_small_and_tall_slight_and_strong() -> None:
    people = [Subject.load(n) for n in build_names()]
    assert len(people) == 6
    heights = np.array([p.height_m for p in people])
    np.testing.assert_allclose(heights, [np.ptp(p.rest[:, 1]) for p in people], atol=0.004)
    assert abs(heights.min() - 1.50) < 0.005 and abs(heights.max() - 1.95) < 0.005
    girths = []
    for p in people:
        forearm = np.asarray(p.weights[:, [18]].sum(1)).ravel() > 0.9
        around = p.rest[forearm] - p.rest_joints[18]
        bone = p.rest_joints[20] - p.rest_joints[18]
        along = around @ bone / (bone @ bone)
        ring = around[(along > 0.2) & (along < 0.5)]
        off = ring - np.outer(ring @ bone / (bone @ bone), bone)
        girths.append(np.linalg.norm(off - off.mean(0), axis=1).mean() / np.linalg.norm(bone))
    slight, strong = np.array(girths)[[0, 2, 4]], np.array(girths)[[1, 3, 5]]
    assert strong.min() > 1.1 * slight.max()


@pytest.mark.parametrize("name", build_names())
def test_other_builds_stand_on_the_same_mesh(name: str) -> None:
    person, usual = Subject.load(name), Subject.load("s04")
    assert np.array_equal(person.faces, usual.faces)
    ours, theirs = (
        np.sort(np.linalg.norm(np.diff(p.rest[p.faces], axis=1), axis=2).ravel())
        for p in (person, usual)
    )
    assert 0.5 < np.median(ours / theirs) < 2  # no triangle is torn
    assert ours.max() < 2 * theirs.max()
    out = person.skin(_random_pose(1), np.zeros((1, 3)))
    assert np.isfinite(out.clothed).all()
    worn = person.clothing[person.clothing > 0]
    assert np.median(worn) > 0.003 and worn.max() < 0.021


def test_the_rest_pose_is_the_rest_mesh(person: Subject) -> None:
    shift = np.array([0.1, 0.2, 0.3])
    out = person.skin(np.zeros((1, 165)), shift[None])
    assert np.allclose(out.vertices[0], person.rest + shift, atol=1e-9)
    assert np.allclose(out.joints[0], person.rest_joints + shift)
    assert np.allclose(out.tips[0], person.rest_tips + shift)


def test_turning_the_whole_body_is_rigid(person: Subject) -> None:
    pose = _random_pose(2)
    pose[1, 3:] = pose[0, 3:]
    pose[1, :3] = [0.5, 2.9, -0.3]
    out = person.skin(pose, np.zeros((2, 3)))
    v = out.clothed[:, ::200]
    gaps = np.linalg.norm(v[:, :, None] - v[:, None], axis=-1)
    assert np.allclose(gaps[0], gaps[1], atol=1e-9)


def test_poses_agree_with_the_fitted_body(person: Subject, body: BodyModel) -> None:
    """Limb directions of the posed skeleton agree, although the bones' lengths do not."""
    pose = np.zeros((1, 165))
    pose[0, [48, 51, 55, 12, 1]] = [0.3, -0.2, -1.2, 1.1, 0.7]
    truth = person.skin(pose, np.zeros((1, 3))).joints[0]
    ours = (
        body.forward(
            body.parameters(torch.as_tensor(np.c_[pose, np.zeros((1, 23))], dtype=torch.float32))
        )
        .joints[0]
        .numpy()
    )
    for a, b in ((16, 18), (18, 20), (17, 19), (1, 4), (4, 7), (28, 29)):
        u, w = truth[b] - truth[a], ours[b] - ours[a]
        assert u @ w / np.linalg.norm(u) / np.linalg.norm(w) > np.cos(np.radians(3))


def test_rotations_and_axis_angle_are_the_same_pose(person: Subject) -> None:
    pose = _random_pose(2)
    matrices = Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix().reshape(2, 55, 3, 3)
    a, b = (person.skin(p, np.zeros((2, 3))).vertices for p in (pose, matrices))
    assert np.allclose(a, b, atol=1e-12)


def test_the_fitted_model_cannot_reproduce_the_people(body: BodyModel) -> None:
    template = body.template.numpy().astype(float)
    params = body.zeros(10)
    params.betas = torch.eye(10)
    basis = (body.forward(params).vertices.numpy() - template).reshape(10, -1).T
    for name in subject_names():
        subject = Subject.load(name)
        mapped = subject.on_fitted_topology(subject.rest[None])[0]
        offset = (mapped - template).reshape(-1)
        betas, *_ = np.linalg.lstsq(basis, offset, rcond=None)
        rest = (offset - basis @ betas).reshape(-1, 3)
        rms = 1e3 * np.sqrt((rest**2).sum(1).mean())
        assert 1.5 < rms < 9, name
        assert np.abs(betas).max() < 5


def test_mapped_points_are_on_the_surface_and_on_the_same_limb(
    person: Subject, body: BodyModel
) -> None:
    mapped = person.on_fitted_topology(person.rest[None])[0]
    own = body.skinning_weights.numpy().argmax(1)
    theirs = np.asarray(person.weights.argmax(1)).ravel()[person.faces[person.fitted_face]]
    hands = np.flatnonzero(own >= 25)
    assert (np.abs(theirs[hands] - own[hands, None]).min(1) <= 2).mean() > 0.97
    assert mapped.shape == (body.num_vertices, 3)
    assert person.fitted_bary.min() >= 0


def test_clothing_covers_trunk_and_legs_only(person: Subject) -> None:
    out = person.skin(_random_pose(1), np.zeros((1, 3)))
    gap = np.linalg.norm(out.clothed - out.vertices, axis=-1)[0]
    assert np.allclose(gap, person.clothing, atol=1e-9)
    dominant = np.asarray(person.weights.argmax(1)).ravel()
    for joints, low, high in (([3, 6, 9], 0.004, 0.021), ([1, 2], 0.004, 0.021)):
        worn = person.clothing[np.isin(dominant, joints)]
        assert low < np.median(worn) and worn.max() < high
    bare = np.isin(dominant, [15, 22, 10, 11, *range(25, 55)])
    assert person.clothing[bare].max() < 1e-3


def test_a_bent_elbow_bulges_by_millimetres(person: Subject) -> None:
    pose = np.zeros((1, 165))
    pose[0, 55] = -1.6
    bent = person.skin(pose, np.zeros((1, 3))).vertices[0]
    flat = Subject(**{**person.__dict__, "bulges": np.zeros_like(person.bulges)})
    change = np.linalg.norm(bent - flat.skin(pose, np.zeros((1, 3))).vertices[0], axis=1)
    assert 0.003 < change.max() < 0.02
    assert (change > 1e-3).mean() < 0.1


@pytest.mark.parametrize("name", subject_names()[::3])
def test_soles_are_flat_and_leather_has_its_thickness(name: str) -> None:
    bare = Subject.load(name)
    shod = in_heavy_shoes(bare, np.random.default_rng(3))
    np.testing.assert_array_equal(shod.rest, bare.rest)
    away = ~shoe_area(bare)
    np.testing.assert_array_equal(shod.clothing[away], bare.clothing[away])
    normals = bare.normals(bare.rest[None])[0]
    for foot in FEET:
        own = shoe_area(bare) & (np.asarray(bare.weights[:, foot].sum(1)).ravel() > 0.5)
        ground = bare.rest[own, 1].min() - SOLE_M
        assert shod.rest_clothed[own, 1].min() == pytest.approx(ground, abs=1e-4)
        under = own & (normals[:, 1] < -0.9)
        assert np.percentile(shod.rest_clothed[under, 1] - ground, 90) < 0.001
        level = own & (np.abs(normals[:, 1]) < 0.2) & (bare.rest[:, 1] < ground + SOLE_M + 0.03)
        thick = shod.clothing[level]
        assert LEATHER_M[0] <= thick.min() and thick.max() <= LEATHER_M[1]


def test_a_person_stands_on_the_soles() -> None:
    """Bare feet are at the height of the sole, soles on the floor."""
    settings = StudioSettings(captures={}, cameras=1)
    for shoes, height in (("plain", 0.0), ("heavy", SOLE_M)):
        capture = StudioCapture(
            interaction="walk_and_wave", subject="s06", seed=11, frames=20, shoes=shoes
        )
        stage = StudioStage(capture, settings, None)
        state = stage.at(stage.set_times[::4])
        lowest, soles = (part[..., 2].min(1) for part in (state.body, state.clothed))
        assert np.abs(soles).max() < 0.001 and np.abs(lowest - height).max() < 0.001


@pytest.fixture
def ball() -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(2000, 3))
    return 0.1 * points / np.linalg.norm(points, axis=1, keepdims=True)


def test_plain_objects_have_one_colour_printed_ones_spots(ball):
    of_mesh = np.full((len(ball), 3), 0.5)
    for seed in range(4):
        plain, printed = (
            object_colours(look, ball, of_mesh, np.random.default_rng(seed))
            for look in ("plain", "printed")
        )
        assert len(np.unique(plain, axis=0)) == 1
        assert 2 <= len(np.unique(printed, axis=0)) <= 7
        common = (printed == plain[0]).all(1)
        assert 0.02 < common.mean() < 0.98, "spots leave some of the first colour"
        turned = printed[np.argsort(np.arctan2(ball[:, 1], ball[:, 0]))]
        assert not np.allclose(turned, np.roll(turned, len(ball) // 2, axis=0))


def test_an_object_may_look_like_its_mesh(ball):
    of_mesh = np.random.default_rng(1).random((len(ball), 3))
    assert object_colours("mesh", ball, of_mesh, np.random.default_rng(0)) is of_mesh
