"""The parameters of a body and their order in the parameter vector."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import accumulate

import torch
from torch import Tensor

POSE_BLOCKS: tuple[tuple[str, int], ...] = (
    ("global_orient", 3),
    ("body_pose", 63),
    ("jaw_pose", 3),
    ("leye_pose", 3),
    ("reye_pose", 3),
    ("left_hand_pose", 45),
    ("right_hand_pose", 45),
)
_ENDS = tuple(accumulate(size for _, size in POSE_BLOCKS))
POSE_COLUMNS = {
    name: slice(end - size, end) for (name, size), end in zip(POSE_BLOCKS, _ENDS, strict=True)
}
"""Columns of each block in the parameter vector."""
HAND_COLUMNS = (POSE_COLUMNS["left_hand_pose"], POSE_COLUMNS["right_hand_pose"])
NUM_POSE = sum(size for _, size in POSE_BLOCKS)
TRANSL = slice(NUM_POSE, NUM_POSE + 3)


@dataclass
class BodyParameters:
    """SMPL-X parameters of B bodies; rotations are axis-angles in radians.

    The parameter vector is global_orient, body_pose, jaw_pose, leye_pose, reye_pose,
    left_hand_pose, right_hand_pose, transl, betas, expression: joint k of the 55 has columns
    3k to 3k+2, `transl` 165 to 167, then the shape.
    """

    betas: Tensor
    """(B, S)"""
    expression: Tensor
    """(B, E)"""
    global_orient: Tensor
    """(B, 3)"""
    body_pose: Tensor
    """(B, 63)"""
    left_hand_pose: Tensor
    """(B, 45), the mean pose included."""
    right_hand_pose: Tensor
    """(B, 45), the mean pose included."""
    jaw_pose: Tensor
    """(B, 3)"""
    leye_pose: Tensor
    """(B, 3)"""
    reye_pose: Tensor
    """(B, 3)"""
    transl: Tensor
    """(B, 3) metres."""

    @classmethod
    def from_vector(cls, vector: Tensor, *, num_betas: int = 10) -> BodyParameters:
        """Split vectors (B,P); the columns after the betas are the expression."""
        parts = {name: vector[:, columns] for name, columns in POSE_COLUMNS.items()}
        shape = vector[:, TRANSL.stop :]
        return cls(
            **parts,
            transl=vector[:, TRANSL],
            betas=shape[:, :num_betas],
            expression=shape[:, num_betas:],
        )

    def vector(self) -> Tensor:
        """Return vectors (B,P); fields of one row are expanded to the batch."""
        batch = self.batch
        names = [*POSE_COLUMNS, "transl", "betas", "expression"]
        return torch.cat([getattr(self, n).expand(batch, -1) for n in names], 1)

    def full_pose(self) -> Tensor:
        """Return the axis-angles (B,55,3) in joint order."""
        batch = self.batch
        pose = [getattr(self, name).expand(batch, -1) for name in POSE_COLUMNS]
        return torch.cat(pose, 1).reshape(batch, 55, 3)

    @property
    def batch(self) -> int:
        return max(getattr(self, f.name).shape[0] for f in fields(self))

    def frames(self, index: slice | Tensor) -> BodyParameters:
        """Return the chosen frames; fields of one row are expanded to the batch first."""
        batch = self.batch
        return replace(
            self, **{f.name: getattr(self, f.name).expand(batch, -1)[index] for f in fields(self)}
        )
