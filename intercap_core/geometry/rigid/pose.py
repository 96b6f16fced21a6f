"""Poses ``a_from_b`` of SO(3) x R^3, and the increments by which the solvers update them.

A pose maps points of frame b to frame a: x_a = R x_b + t, metres. A step is six numbers, a turn
w (rad) about the object's own origin, from the left, and a shift d (m) of that origin, in frame a::

    R <- exp(w) R,    t <- t + d

so that ``exp`` and ``log`` are those of SO(3) x R^3 and not of the twists of SE(3): a turn does not
carry the origin along a helix. That is the retraction whose derivatives the energy terms hold
(:mod:`intercap_core.object_track.object_depth`). Composition ``@`` and ``inverse`` are those of
rigid motions all the same.

Everything takes any leading batch shape. Plain functions on arrays of transforms are in
:mod:`intercap_core.geometry.camera.transforms`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera import transforms


@dataclass(frozen=True, eq=False)
class Pose:
    """``a_from_b``: ``rotation`` (..., 3, 3) and ``translation`` (..., 3), metres."""

    rotation: np.ndarray
    translation: np.ndarray

    @classmethod
    def identity(cls, *batch: int) -> Pose:
        """The identity, of shape ``batch``."""
        return cls(np.tile(np.eye(3), (*batch, 1, 1)), np.zeros((*batch, 3)))

    @classmethod
    def of(cls, matrix: np.ndarray) -> Pose:
        """The pose of transforms (..., 4, 4); its arrays are views of them."""
        return cls(matrix[..., :3, :3], matrix[..., :3, 3])

    @classmethod
    def exp(cls, step: np.ndarray) -> Pose:
        """The pose of steps (..., 6) from the identity: turn (rad), then shift (m)."""
        return cls(rotation_exp(step[..., :3]), step[..., 3:])

    @property
    def matrix(self) -> np.ndarray:
        """Transforms (..., 4, 4)."""
        return transforms.rigid(self.rotation, self.translation)

    def __matmul__(self, other: Pose) -> Pose:
        """``a_from_b @ b_from_c`` is ``a_from_c``; batch shapes are broadcast."""
        moved = (self.rotation @ other.translation[..., None])[..., 0] + self.translation
        return Pose(self.rotation @ other.rotation, moved)

    def inverse(self) -> Pose:
        """``b_from_a``."""
        back = np.swapaxes(self.rotation, -1, -2)
        return Pose(back, -(back @ self.translation[..., None])[..., 0])

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Points (..., N, 3) of b in frame a."""
        return points @ np.swapaxes(self.rotation, -1, -2) + self.translation[..., None, :]

    def log(self) -> np.ndarray:
        """Steps (..., 6) from the identity; turns of at most pi."""
        return self.step_from(Pose.identity())

    def moved(self, step: np.ndarray) -> Pose:
        """The pose after steps (..., 6): turn about its origin from the left, and shift."""
        turn = rotation_exp(step[..., :3])
        return Pose(turn @ self.rotation, self.translation + step[..., 3:])

    def step_from(self, start: Pose) -> np.ndarray:
        """Steps (..., 6) that take ``start`` to this pose: ``start.moved(step)`` is this."""
        turn = rotation_log(self.rotation @ np.swapaxes(start.rotation, -1, -2))
        return np.concatenate([turn, self.translation - start.translation], axis=-1)


def rotation_exp(vector: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3) of rotation vectors (..., 3), rad."""
    flat = Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix()
    return flat.reshape(*vector.shape[:-1], 3, 3)


def rotation_log(rotation: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3), rad, of rotations (..., 3, 3), of length at most pi."""
    flat = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec()
    return flat.reshape(*rotation.shape[:-2], 3)
