"""Linear blend skinning of many points, and its pull-back, in pieces that stay in the cache.

v_n = sum over bones m of w_nm (R_m x_n + t_m). Blending the bones' 12 numbers is one dense product,
12 times as large as what comes out; a few bodies at a time keep it out of the main memory. The
pull-back blends anew rather than keep it:

    dE/dx_n = M_n^T dE/dv_n,    dE/d(R_m | t_m) = sum over n of w_nm dE/dv_n (x_n | 1)^T
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

_CACHE_BYTES = 2 << 20  # of blended bones held at once, about a core's own cache


def skin(points: Tensor, rotations: Tensor, offsets: Tensor, weights: Tensor) -> Tensor:
    """Posed points (B,N,3), metres.

    points (B,N,3) at rest; rotations (B,J,3,3) and offsets (B,J,3): a point that follows joint k
    alone goes to rotations[k] @ x + offsets[k]; weights (N,J), constant. Differentiable once by
    points, rotations and offsets.
    """
    bones = torch.cat([rotations.permute(0, 2, 3, 1).flatten(1, 2), offsets.transpose(1, 2)], 1)
    return _Skin.apply(points, bones, weights)


class _Skin(torch.autograd.Function):
    """points (B,N,3), bones (B,12,J): rows of the rotation, then the offset; weights (N,J)."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, bones: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(points, bones, weights)
        posed = torch.empty_like(points, memory_format=torch.contiguous_format)
        for at in _pieces(points):
            x, blended = points[at].mT.contiguous(), _blended(bones[at], weights)
            sum_ = blended[:, 9:]
            for c in range(3):
                sum_ = torch.addcmul(sum_, blended[:, c:9:3], x[:, c : c + 1])
            posed[at] = sum_.mT
        return posed

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        points, bones, weights = ctx.saved_tensors
        by_points, by_bones = torch.empty_like(points), torch.empty_like(bones)
        for at in _pieces(points):
            x, gradient = points[at].mT.contiguous(), gradients[0][at].mT.contiguous()
            blended = _blended(bones[at], weights)
            blended, gradient_ = blended[:, :9].unflatten(1, (3, 3)), gradient[:, :, None]
            by_points[at] = (blended * gradient_).sum(1).mT
            outer = torch.cat([(gradient_ * x[:, None]).flatten(1, 2), gradient], 1)
            by_bones[at] = (outer.flatten(0, 1) @ weights).unflatten(0, (-1, 12))
        return by_points, by_bones, None


def _blended(bones: Tensor, weights: Tensor) -> Tensor:
    """(b,12,N)"""
    return (bones.flatten(0, 1) @ weights.mT).unflatten(0, (-1, 12))


def _pieces(points: Tensor) -> Iterator[slice]:
    """Bodies that are blended at once; a GPU takes them all."""
    batch, count = points.shape[:2]
    size = 12 * max(count, 1) * points.element_size()
    step = max(1, _CACHE_BYTES // size) if points.device.type == "cpu" else max(1, batch)
    for start in range(0, batch, step):
        yield slice(start, start + step)
