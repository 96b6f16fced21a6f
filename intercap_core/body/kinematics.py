"""Rotations, the kinematic tree of the 55 joints with derivatives, and linear blend skinning."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from intercap_core.body.joints import NUM_JOINTS, PARENTS

SMALL_ANGLE_SQUARED = 1e-4  # rad^2; below it the next term of the series is under 1e-10
_CACHE_BYTES = 2 << 20  # size of the blended bones of one piece, bytes: fits the cache of a core


def skew(v: Tensor) -> Tensor:
    """Return (...,3,3) with skew(v) @ x = v x x, of v (...,3)."""
    zero = torch.zeros_like(v[..., 0])
    x, y, z = v.unbind(-1)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*v.shape[:-1], 3, 3)


def _coefficients(theta_squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3 of squared angles t^2.

    Below a small angle they are Taylor series, so autograd is finite at zero.
    """
    small = theta_squared < SMALL_ANGLE_SQUARED
    t2 = torch.where(small, torch.ones_like(theta_squared), theta_squared)
    t = t2.sqrt()
    s2 = torch.where(small, theta_squared, torch.zeros_like(theta_squared))
    a = torch.where(small, 1 - s2 / 6 + s2 * s2 / 120, torch.sin(t) / t)
    b = torch.where(small, 0.5 - s2 / 24 + s2 * s2 / 720, 2 * torch.sin(t / 2) ** 2 / t2)
    c = torch.where(small, 1 / 6 - s2 / 120 + s2 * s2 / 5040, (t - torch.sin(t)) / (t2 * t))
    return a, b, c


def rotation_from_axis_angle(axis_angle: Tensor) -> Tensor:
    """Return rotations (...,3,3) of axis-angles (...,3): Rodrigues' formula."""
    a, b, _ = (x[..., None, None] for x in _coefficients((axis_angle**2).sum(-1)))
    k = skew(axis_angle)
    return torch.eye(3, dtype=k.dtype, device=k.device) + a * k + b * (k @ k)


def left_jacobian(axis_angle: Tensor) -> Tensor:
    """Return J (...,3,3) with exp(theta + d) = exp(J d) exp(theta) to first order in d.

    Chirikjian 2011, "Stochastic Models, Information Theory, and Lie Groups" 2, section 10.8:
    J = I + (1-cos t)/t^2 [theta] + (t - sin t)/t^3 [theta]^2.
    """
    _, b, c = (x[..., None, None] for x in _coefficients((axis_angle**2).sum(-1)))
    k = skew(axis_angle)
    return torch.eye(3, dtype=k.dtype, device=k.device) + b * k + c * (k @ k)


@dataclass(frozen=True)
class _Level:
    """The n joints of one depth of the tree."""

    own: Tensor
    """(n,) the joints."""
    parents: Tensor
    """(n,) their parents."""
    parent_place: Tensor
    """(n,) places of the parents in the list of joints sorted by depth."""


def _levels() -> tuple[tuple[_Level, ...], Tensor]:
    """Return the levels below the root, and the place (55,) of each joint sorted by depth."""
    depth = [0] * NUM_JOINTS
    for joint in range(1, NUM_JOINTS):
        depth[joint] = depth[PARENTS[joint]] + 1
    order = sorted(range(NUM_JOINTS), key=lambda j: (depth[j], j))
    place = {joint: i for i, joint in enumerate(order)}
    levels = []
    for level in range(1, max(depth) + 1):
        own = [j for j in order if depth[j] == level]
        parents = [PARENTS[j] for j in own]
        at = [place[p] for p in parents]
        levels.append(_Level(torch.tensor(own), torch.tensor(parents), torch.tensor(at)))
    return tuple(levels), torch.tensor([place[j] for j in range(NUM_JOINTS)])


_LEVELS, _PLACE = _levels()


@dataclass(frozen=True)
class PosedJoints:
    """The joints of B posed bodies. A point x that follows only joint k moves to
    rotations[k] @ x + offsets[k]."""

    rest: Tensor
    """(B, 55, 3) joints at rest, metres."""
    local: Tensor
    """(B, 55, 3, 3) rotations in the frames of the parents."""
    rotations: Tensor
    """(B, 55, 3, 3) rotations in the world."""
    joints: Tensor
    """(B, 55, 3) posed joints, metres."""
    offsets: Tensor
    """(B, 55, 3) metres."""


def pose_joints(rest: Tensor, local: Tensor, transl: Tensor) -> PosedJoints:
    """Pose joints: rest (B,55,3), local rotations (B,55,3,3), transl (B,3)."""
    device = rest.device
    world, posed = local[:, :1], rest[:, :1] + transl[:, None]
    for level in _LEVELS:
        at = level.parent_place.to(device)
        own, parents = level.own.to(device), level.parents.to(device)
        rotation = world[:, at]
        bone = (rotation @ (rest[:, own] - rest[:, parents])[..., None])[..., 0]
        posed = torch.cat([posed, posed[:, at] + bone], 1)
        world = torch.cat([world, rotation @ local[:, own]], 1)
    back = _PLACE.to(device)
    world, posed = world[:, back], posed[:, back]
    offsets = posed - (world @ rest[..., None])[..., 0]
    return PosedJoints(rest, local, world, posed, offsets)


def joint_shape_derivatives(posed: PosedJoints, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Return the derivatives (B,55,3,S) of joints and offsets by the shape.

    directions (55,3,S): derivatives of the rest joints.
    """
    device = directions.device
    batch = posed.rotations.shape[0]
    moved = torch.empty(batch, *directions.shape, dtype=posed.rotations.dtype, device=device)
    moved[:, 0] = directions[0]
    for level in _LEVELS:
        own, parent = level.own.to(device), level.parents.to(device)
        bone = directions[own] - directions[parent]
        moved[:, own] = moved[:, parent] + posed.rotations[:, parent] @ bone
    return moved, moved - posed.rotations @ directions


def skin(points: Tensor, rotations: Tensor, offsets: Tensor, weights: Tensor) -> Tensor:
    """Return posed points (B,N,3), metres: v_n = sum over bones m of w_nm (R_m x_n + t_m).

    Differentiable once, by points, rotations and offsets. The 12 numbers of each bone are blended
    by one dense product. Its result (B,12,N) is large, so a few bodies are processed at a time.

    Args:
        points: (B, N, 3) at rest, metres.
        rotations: (B, J, 3, 3)
        offsets: (B, J, 3) t_m, metres.
        weights: (N, J) skinning weights.
    """
    bones = torch.cat([rotations.permute(0, 2, 3, 1).flatten(1, 2), offsets.transpose(1, 2)], 1)
    return _Skin.apply(points, bones, weights)


class _Skin(torch.autograd.Function):
    """Linear blend skinning of points (B,N,3) by bones (B,12,J) with weights (N,J).

    The 12 numbers of a bone are its rotation, row by row, then its offset. The backward pass blends
    again instead of storing the blended rotations M_n:
    dE/dx_n = M_n^T dE/dv_n, dE/d(R_m | t_m) = sum over n of w_nm dE/dv_n (x_n | 1)^T.
    """

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
    """Return the bones blended for each point, (b,12,N)."""
    return (bones.flatten(0, 1) @ weights.mT).unflatten(0, (-1, 12))


def _pieces(points: Tensor) -> Iterator[slice]:
    """Yield the bodies that are blended at once; on a GPU all of them."""
    batch, count = points.shape[:2]
    size = 12 * max(count, 1) * points.element_size()
    step = max(1, _CACHE_BYTES // size) if points.device.type == "cpu" else max(1, batch)
    for start in range(0, batch, step):
        yield slice(start, start + step)


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Return area-weighted unit normals (B,V,3) of vertices (B,V,3) with faces (F,3)."""
    a, b, c = (vertices[:, faces[:, i]] for i in range(3))
    cross = torch.linalg.cross(b - a, c - a)
    normals = torch.zeros_like(vertices)
    for i in range(3):
        normals.index_add_(1, faces[:, i], cross)
    return torch.nn.functional.normalize(normals, dim=2)
