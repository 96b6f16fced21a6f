"""The points of a body that are evaluated: some or all vertices, and joints if asked.

A joint is a point that follows its parent alone, so one code path poses both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import NUM_JOINTS, PARENTS, ancestors

# Points that hang on nearly the same joints share one dense block of the normal equations.
# A block is named by the joint that moves its points most.
_BLOCK_OF_JOINT: tuple[int, ...] = (
    0, 1, 2, 0, 4, 5, 0, 4, 5, 9, 4, 5, 12, 9, 9, 12, 16, 17, 16, 17, 20, 21, 12, 12, 12,
    *(25 + 3 * (i // 3) for i in range(30)),
)  # fmt: skip


@dataclass(frozen=True)
class Block:
    """Rows (n,) of the selection and the joints (m,) that move any of them."""

    rows: Tensor
    joints: Tensor


class Limbs(NamedTuple):
    """N points by limb: those that hang on nearly the same joints.

    order (N,): points, limb by limb; starts (L+1,): where each limb starts in it, and the end;
    moved_by (L,55) bool: the joints that move any point of a limb.
    """

    order: np.ndarray
    starts: np.ndarray
    moved_by: np.ndarray

    def moved_by_point(self) -> np.ndarray:
        """(N,55) bool: the joints of each point's own limb."""
        flags = np.zeros((len(self.order), NUM_JOINTS), bool)
        flags[self.order] = self.moved_by.repeat(np.diff(self.starts), 0)
        return flags


@dataclass(frozen=True)
class Selection:
    """N points in the rest pose and what moves them.

    template (N,3), directions (N,3,S), posedirs (N,3,486) or None, weights (N,55).
    bones (N,K) and bone_weights (N,K): the joints with weight, padded with weight zero.
    chain (N,L): every joint whose rotation moves the point, padded with 0; below (N,L,K): bone
    weight of bones[n,k] if it hangs below chain[n,l], else 0. num_vertices: the first so many
    points are vertices, the rest are the 55 joints.
    """

    template: Tensor
    directions: Tensor
    posedirs: Tensor | None
    weights: Tensor
    bones: Tensor
    bone_weights: Tensor
    chain: Tensor
    below: Tensor
    blocks: tuple[Block, ...]
    num_vertices: int

    @cached_property
    def limbs(self) -> Limbs:
        """The blocks as arrays."""
        rows = [block.rows.cpu().numpy() for block in self.blocks]
        moved_by = np.zeros((len(rows), NUM_JOINTS), bool)
        for block, flags in zip(self.blocks, moved_by, strict=True):
            flags[block.joints.cpu().numpy()] = True
        return Limbs(np.concatenate(rows), np.cumsum([0, *map(len, rows)]), moved_by)


_IS_ANCESTOR = np.zeros((NUM_JOINTS, NUM_JOINTS), bool)  # [joint, ancestor or itself]
for _joint in range(NUM_JOINTS):
    _IS_ANCESTOR[_joint, list(ancestors(_joint))] = True


def _padded(flags: np.ndarray) -> np.ndarray:
    """(N,55) bool -> (N,K) column ids of the set flags, ascending, padded with -1."""
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
    """Vertices (N,...) as given, then the joints' rest (55,3) and directions (55,3,S) if given."""
    count = template.shape[0]
    if joints is not None:
        rest, moves = joints
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
        blocks=tuple(
            Block(tensor(rows), tensor(np.flatnonzero(moved_by[rows].any(0))))
            for rows in _block_rows(dense)
        ),
        num_vertices=count,
    )


def _block_rows(weights: np.ndarray) -> Sequence[np.ndarray]:
    """Row ids of each block, in the order of the joints that name them."""
    block = np.array(_BLOCK_OF_JOINT)[weights.argmax(1)]
    return [np.flatnonzero(block == name) for name in np.unique(block)]
