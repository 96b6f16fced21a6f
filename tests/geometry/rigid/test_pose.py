"""Poses: a group, with the exponential and the logarithm of SO(3) x R^3."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera import transforms
from intercap_core.geometry.rigid.pose import Pose, rotation_exp, rotation_log

BATCHES = [(), (5,), (2, 3)]


def poses(batch: tuple[int, ...], seed: int) -> Pose:
    rng = np.random.default_rng(seed)
    count = int(np.prod(batch))
    rotation = Rotation.random(count, random_state=seed).as_matrix().reshape(*batch, 3, 3)
    return Pose(rotation, rng.normal(size=(*batch, 3)))


def same(one: Pose, two: Pose) -> None:
    np.testing.assert_allclose(one.matrix, two.matrix, atol=1e-12)


@pytest.mark.parametrize("batch", BATCHES)
def test_poses_are_a_group(batch: tuple[int, ...]) -> None:
    a, b, c = (poses(batch, seed) for seed in range(3))
    identity = Pose.identity(*batch)
    same((a @ b) @ c, a @ (b @ c))
    same(a @ identity, a)
    same(identity @ a, a)
    same(a @ a.inverse(), identity)
    same(a.inverse() @ a, identity)
    same((a @ b).inverse(), b.inverse() @ a.inverse())


@pytest.mark.parametrize("batch", BATCHES)
def test_poses_are_what_transforms_are(batch: tuple[int, ...]) -> None:
    a, b = poses(batch, 3), poses(batch, 4)
    points = np.random.default_rng(5).normal(size=(*batch, 7, 3))
    np.testing.assert_allclose((a @ b).matrix, a.matrix @ b.matrix, atol=1e-12)
    np.testing.assert_allclose(a.inverse().matrix, transforms.invert(a.matrix), atol=1e-12)
    np.testing.assert_allclose(a.apply(points), transforms.apply(a.matrix, points), atol=1e-12)
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-12)
    same(Pose.of(a.matrix), a)


def test_a_pose_acts_as_scipys() -> None:
    a, b = poses((6,), 6), poses((6,), 7)
    theirs = [Rotation.from_matrix(one.rotation) for one in (a, b)]
    both = theirs[0] * theirs[1]
    np.testing.assert_allclose((a @ b).rotation, both.as_matrix(), atol=1e-12)
    moved = theirs[0].apply(b.translation) + a.translation
    np.testing.assert_allclose((a @ b).translation, moved, atol=1e-12)


@pytest.mark.parametrize("batch", BATCHES)
def test_exp_and_log_undo_each_other(batch: tuple[int, ...]) -> None:
    step = np.random.default_rng(8).uniform(-1.5, 1.5, size=(*batch, 6))
    np.testing.assert_allclose(Pose.exp(step).log(), step, atol=1e-12)
    a, b = poses(batch, 9), poses(batch, 10)
    same(Pose.exp(a.log()), a)
    same(a.moved(b.step_from(a)), b)
    np.testing.assert_allclose(a.moved(step).step_from(a), step, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-4, 1.0, np.pi - 1e-6])
def test_turns_of_any_size_against_scipy(angle: float) -> None:
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3
    np.testing.assert_allclose(
        rotation_exp(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-15
    )
    np.testing.assert_allclose(rotation_log(rotation_exp(vector)), vector, atol=1e-9)


def test_a_step_turns_about_the_poses_origin() -> None:
    """Unlike the exponential of SE(3), in which a turn moves the origin along a helix."""
    a = poses((), 11)
    turned = a.moved(np.array([0.3, -0.2, 0.5, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(turned.translation, a.translation)
    shift = np.array([0.1, 0.2, -0.3])
    step = np.concatenate([[0.3, -0.2, 0.5], shift])
    np.testing.assert_allclose(Pose.exp(step).translation, shift)


def test_a_batch_composes_with_one() -> None:
    one, many = poses((), 12), poses((4,), 13)
    for i in range(4):
        single = Pose(many.rotation[i], many.translation[i])
        np.testing.assert_allclose((one @ many).matrix[i], (one @ single).matrix, atol=1e-12)
        np.testing.assert_allclose((many @ one).matrix[i], (single @ one).matrix, atol=1e-12)
