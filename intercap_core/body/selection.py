"""Selection of the points of a body that are evaluated: vertices, and the joints if requested.

A joint is a point that follows only the bone of its parent, so the same code poses both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import NUM_JOINTS, PARENTS, ancestors

# A limb is a group of points that follow nearly the same joints. They share one dense block of the
# normal equations. The table maps the joint with the largest weight of a point to its limb, which
# is named by one of its joints.
_LIMB_OF_JOINT: tuple[int, ...] = (
    0, 1, 2, 0, 4, 5, 0, 4, 5, 9, 4, 5, 12, 9, 9, 12, 16, 17, 16, 17, 20, 21, 12, 12, 12,
    *(25 + 3 * (i // 3) for i in range(30)),
)  # fmt: skip


class Limbs(NamedTuple):
    """N points grouped into L limbs, whose points follow nearly the same joints."""

    order: np.ndarray
    """(N,) indices of the points, limb by limb."""
    starts: np.ndarray
    """(L + 1,) start of each limb in ``order``, then N."""
    moved_by: np.ndarray
    """(L, 55) bool, the joints that move a point of the limb."""

    @classmethod
    def of(cls, groups: Sequence[np.ndarray], moved_by: np.ndarray) -> Limbs:
        """Return one limb for each group of points.

        Args:
            groups: indices of the points of each limb.
            moved_by: (N, 55) bool, the joints that move each point.
        """
        return cls(
            np.concatenate(groups),
            np.cumsum([0, *map(len, groups)]),
            np.stack([moved_by[points].any(0) for points in groups]),
        )


@dataclass(frozen=True)
class Selection:
    """N points in the rest pose and their dependence on joints and shape."""

    template: Tensor
    """(N, 3) metres."""
    directions: Tensor
    """(N, 3, S) derivatives by betas and expression."""
    posedirs: Tensor | None
    """(N, 3, 486) pose blend shapes; zero for joints."""
    weights: Tensor
    """(N, 55) skinning weights."""
    bones: Tensor
    """(N, K) joints with a positive weight, padded with 0."""
    bone_weights: Tensor
    """(N, K) weights of these joints, padded with zero."""
    chain: Tensor
    """(N, L) all joints whose rotation moves the point, padded with 0."""
    below: Tensor
    """(N, L, K) weight of bones[n, k] if it is chain[n, l] or a descendant, else 0."""
    limbs: Limbs
    """Points that share one dense block of the normal equations."""
    num_vertices: int
    """Number of vertices; the other points are the 55 joints."""


_IS_ANCESTOR = np.zeros((NUM_JOINTS, NUM_JOINTS), bool)  # [joint, ancestor or itself]
for _joint in range(NUM_JOINTS):
    _IS_ANCESTOR[_joint, list(ancestors(_joint))] = True


def _padded(flags: np.ndarray) -> np.ndarray:
    """Return the columns (N,K) of the set flags of (N,55), ascending, padded with -1."""
    width = max(1, int(flags.sum(1).max()))
    order = np.argsort(~flags, axis=1, kind="stable")[:, :width]
    return np.where(np.take_along_axis(flags, order, 1), order, -1)


def select_points(
    template: Tensor,
    directions: Tensor,
    posedirs: Tensor | None,
    weights: Tensor,
    joints: tuple[Tensor, Tensor] | None,
) -> Selection:
    """Return the selection of N vertices, and of the joints if given.

    Args:
        template: (N, 3) vertices, metres.
        directions: (N, 3, S)
        posedirs: (N, 3, 486), or None.
        weights: (N, 55) skinning weights.
        joints: rest positions (55, 3) and directions (55, 3, S) of the joints, or None.
    """
    count = template.shape[0]
    if joints is not None:
        rest, moves = joints
        # skinning weights of the joints: each follows its parent, the root follows itself
        follow = torch.zeros(NUM_JOINTS, NUM_JOINTS, dtype=weights.dtype, device=weights.device)
        follow[torch.arange(NUM_JOINTS), torch.tensor([max(p, 0) for p in PARENTS])] = 1
        template = torch.cat([template, rest])
        directions = torch.cat([directions, moves])
        weights = torch.cat([weights, follow])
        if posedirs is not None:
            posedirs = torch.cat([posedirs, posedirs.new_zeros(NUM_JOINTS, *posedirs.shape[1:])])
    dense = weights.detach().cpu().double().numpy()
    bones = _padded(dense > 0)
    share = np.where(bones >= 0, np.take_along_axis(dense, np.maximum(bones, 0), 1), 0)
    moved_by = (dense > 0) @ _IS_ANCESTOR
    chain = _padded(moved_by)
    limb = np.array(_LIMB_OF_JOINT)[dense.argmax(1)]
    # [n, l, k]: bone k is joint l of the chain or a descendant of it
    hangs = _IS_ANCESTOR[np.maximum(bones, 0)[:, None, :], np.maximum(chain, 0)[:, :, None]]
    below = hangs * share[:, None, :] * (chain >= 0)[:, :, None]

    def tensor(array: np.ndarray) -> Tensor:
        return torch.as_tensor(array, device=template.device)

    return Selection(
        template=template,
        directions=directions,
        posedirs=posedirs,
        weights=weights,
        bones=tensor(np.maximum(bones, 0)),
        bone_weights=tensor(share).to(weights.dtype),
        chain=tensor(np.maximum(chain, 0)),
        below=tensor(below).to(weights.dtype),
        limbs=Limbs.of([np.flatnonzero(limb == name) for name in np.unique(limb)], moved_by),
        num_vertices=count,
    )
