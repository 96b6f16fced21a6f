"""Symmetry groups of objects, as BOP's ``models_info`` states them.

An element is a rigid motion S of the object's frame that does not change the object's appearance:
the poses ``master_from_object`` and ``master_from_object @ S`` are indistinguishable. Discrete
elements are 4x4 transforms. Continuous elements are all rotations about one axis through
``offset``. The group contains every product of the two. ``sphere`` stands for all rotations about
the origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.entries import Symmetry
from intercap_core.geometry.camera.transforms import rigid, rotation_exp

# Transforms whose entries differ by less than this are equal: tables have 4 digits.
SAME_TRANSFORM = 1e-3


@dataclass(frozen=True)
class SymmetryGroup:
    """The symmetry group of one object, in the object's frame."""

    discrete: np.ndarray
    """(n, 4, 4), closed under products, the identity first."""
    axis: np.ndarray | None = None
    """(3,) unit vector of the continuous axis; None = no continuous symmetry."""
    offset: np.ndarray | None = None
    """(3,) point on the axis, metres."""
    sphere: bool = False
    """Whether all rotations about the origin are symmetries."""

    @classmethod
    def none(cls) -> SymmetryGroup:
        """Return the group of an object without symmetry."""
        return cls(np.eye(4)[None])

    @classmethod
    def from_settings(cls, symmetry: Symmetry) -> SymmetryGroup:
        """Build and check the group of an objects.yaml entry.

        Raises ValueError for a transform that is no rigid motion, for discrete elements that
        generate no small group, or for more than one continuous axis.
        """
        given = np.array(symmetry.discrete, np.float64).reshape(-1, 4, 4)
        for row, transform in enumerate(given):
            rotation = transform[:3, :3]
            orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
            if (
                not orthonormal
                or np.linalg.det(rotation) < 0
                or not np.allclose(transform[3], (0, 0, 0, 1))
            ):
                raise ValueError(f"discrete[{row}] is not a rotation and translation")
        for transform in given:  # products of rounded tables must stay rotations
            left, _, right = np.linalg.svd(transform[:3, :3])
            transform[:3, :3] = left @ right
        if len(symmetry.continuous) > 1:
            raise ValueError("more than one continuous axis: set 'sphere: true' instead")
        axis = offset = None
        if symmetry.continuous:
            axis = np.array(symmetry.continuous[0].axis, np.float64)
            offset = np.array(symmetry.continuous[0].offset, np.float64)
            length = np.linalg.norm(axis)
            if not length > 1e-6:
                raise ValueError("the continuous axis has no length")
            axis = axis / length
        return cls(_closure(given), axis, offset, symmetry.sphere)

    @property
    def trivial(self) -> bool:
        """Whether no motion but the identity leaves the object unchanged."""
        return len(self.discrete) == 1 and self.axis is None and not self.sphere

    def nearest_equivalent(self, rotation: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Return the rotation equivalent to ``rotation`` (..., 3, 3) that is closest to
        ``reference`` (..., 3, 3).

        The translations of the group's elements are ignored. For poses use
        :meth:`nearest_equivalent_pose`.
        """
        rotation, reference = np.broadcast_arrays(
            np.asarray(rotation, np.float64), np.asarray(reference, np.float64)
        )
        if self.sphere:
            return reference.copy()
        options = self._aligned(rotation, reference)
        distance = ((options - reference[..., None, :, :]) ** 2).sum((-1, -2))
        best = distance.argmin(-1)[..., None, None, None]
        return np.take_along_axis(options, best, -3)[..., 0, :, :]

    def nearest_equivalent_pose(self, pose: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Return the pose (4, 4) equivalent to ``pose`` with the rotation closest to that of
        ``reference``."""
        rotation = self.nearest_equivalent(pose[:3, :3], reference[:3, :3])
        if self.sphere:
            return rigid(rotation, pose[:3, 3])
        # The nearest rotation is R S with an element S of the group. Find the discrete factor of S;
        # the rest of S is a rotation about the axis. Both determine the translation of S.
        element = pose[:3, :3].T @ rotation
        for discrete in self.discrete:
            rest = discrete[:3, :3].T @ element
            if self.axis is None:
                if np.allclose(rest, np.eye(3), atol=SAME_TRANSFORM):
                    return pose @ discrete
            elif np.allclose(rest @ self.axis, self.axis, atol=SAME_TRANSFORM):
                return pose @ discrete @ self._about_axis(rest)
        raise AssertionError("the nearest rotation is not in the group")

    def rotation_error_deg(self, rotation: np.ndarray, true_rotation: np.ndarray) -> np.ndarray:
        """Return the smallest geodesic angle (...), degrees, over the group; 0 for a sphere."""
        nearest = self.nearest_equivalent(rotation, true_rotation)
        chord = np.linalg.norm(nearest - np.asarray(true_rotation), axis=(-1, -2))
        return np.degrees(2 * np.arcsin(np.clip(chord / (2 * np.sqrt(2)), 0, 1)))

    def elements(self, steps: int = 72) -> np.ndarray:
        """Return samples of the group (n, 4, 4), ``steps`` angles of a continuous axis.

        For errors of vertices over the group (MSSD, MSPD). A sphere returns the identity, because
        the error of its vertices is that of its centre.
        """
        if self.axis is None or self.sphere:
            return self.discrete.copy()
        turns = [
            self._about_axis(rotation_exp(angle * self.axis))
            for angle in 2 * np.pi * np.arange(steps) / steps
        ]
        return (self.discrete[:, None] @ np.array(turns)[None]).reshape(-1, 4, 4)

    def _about_axis(self, rotation: np.ndarray) -> np.ndarray:
        """Return the motion (4, 4) by ``rotation`` (3, 3) that keeps the axis in place."""
        assert self.offset is not None
        return rigid(rotation, self.offset - rotation @ self.offset)

    def _aligned(self, rotation: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Return one candidate (..., n, 3, 3) for each discrete element D.

        It is rotation D Rot(a, angle) with the axis a. The angle brings it closest to the
        reference: it maximises trace(M Rot(a, angle)) with M = reference^T rotation D, which is
        a.Ma + cos(angle) (tr M - a.Ma) + sin(angle) tr(M [a]x).
        """
        options = rotation[..., None, :, :] @ self.discrete[:, :3, :3]
        if self.axis is None:
            return options
        m = np.swapaxes(reference, -1, -2)[..., None, :, :] @ options
        along = np.einsum("i,...ij,j->...", self.axis, m, self.axis)
        cosine = np.trace(m, axis1=-2, axis2=-1) - along
        sine = np.einsum("...ij,ji->...", m, np.cross(np.eye(3), self.axis))
        return options @ rotation_exp(np.arctan2(sine, cosine)[..., None] * self.axis)


def _closure(generators: np.ndarray) -> np.ndarray:
    """Return all products of the generators (n, 4, 4), the identity first."""
    elements = [np.eye(4)]
    queue = list(generators)
    while queue:
        candidate = queue.pop(0)
        if any(np.abs(candidate - known).max() < SAME_TRANSFORM for known in elements):
            continue
        elements.append(candidate)
        if len(elements) > 128:  # the icosahedron's rotation group has 60
            raise ValueError(
                "the discrete elements generate more than 128 motions; check that they form a group"
            )
        queue += [candidate @ generator for generator in generators]
    return np.array(elements)
