"""Rigid transforms against matrix algebra and scipy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import (
    apply,
    apply_step,
    invert,
    is_rigid,
    rigid,
    rotation_exp,
    rotation_log,
    step_between,
)

BATCHES = [(), (5,), (2, 3)]


def _transforms(batch: tuple[int, ...], seed: int) -> np.ndarray:
    count = int(np.prod(batch))
    rotation = Rotation.random(count, random_state=seed).as_matrix().reshape(*batch, 3, 3)
    return rigid(rotation, np.random.default_rng(seed).normal(size=(*batch, 3)))


@pytest.mark.parametrize("batch", BATCHES)
def test_inverse_and_application_match_matrix_algebra(batch: tuple[int, ...]) -> None:
    pose = _transforms(batch, 0)
    np.testing.assert_allclose(invert(pose), np.linalg.inv(pose), atol=1e-12)
    points = np.random.default_rng(1).normal(size=(*batch, 7, 3))
    homogeneous = np.concatenate([points, np.ones((*batch, 7, 1))], -1)
    expected = np.einsum("...ij,...nj->...ni", pose, homogeneous)[..., :3]
    np.testing.assert_allclose(apply(pose, points), expected, atol=1e-12)
    assert apply(pose, points.astype(np.float32)).dtype == np.float32


@pytest.mark.parametrize("batch", BATCHES)
def test_step_between_inverts_apply_step(batch: tuple[int, ...]) -> None:
    step = np.random.default_rng(8).uniform(-1.5, 1.5, size=(*batch, 6))
    start, end = _transforms(batch, 9), _transforms(batch, 10)
    np.testing.assert_allclose(step_between(start, apply_step(start, step)), step, atol=1e-12)
    np.testing.assert_allclose(apply_step(start, step_between(start, end)), end, atol=1e-12)


def test_a_step_turns_the_object_about_its_own_origin() -> None:
    pose, turn, shift = _transforms((), 11), [0.3, -0.2, 0.5], [0.1, 0.2, -0.3]
    moved = apply_step(pose, np.array(turn + shift))
    np.testing.assert_allclose(moved[:3, 3], pose[:3, 3] + shift, atol=1e-15)
    expected = Rotation.from_rotvec(turn).as_matrix() @ pose[:3, :3]
    np.testing.assert_allclose(moved[:3, :3], expected, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-4, 1.0, np.pi - 1e-6])
def test_rotation_vectors_of_any_length_are_recovered(angle: float) -> None:
    vector = angle * np.array([2.0, -1.0, 2.0]) / 3
    matrix = rotation_exp(vector)
    np.testing.assert_allclose(matrix, Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(rotation_log(matrix), vector, atol=1e-9)


def test_only_finite_proper_orthonormal_transforms_are_rigid() -> None:
    pose = _transforms((), 12)
    assert is_rigid(pose)
    for place, value in (((0, 0), 2.0), ((0, 3), np.nan), ((3, 0), 0.1)):
        broken = pose.copy()
        broken[place] = value
        assert not is_rigid(broken)
    assert not is_rigid(pose @ np.diag([1.0, 1, -1, 1])) and not is_rigid(pose[:3])
