"""Posed points and their exact derivatives with respect to every parameter.

A point x at rest is posed to sum_m w_m (R_m x + t_m) by the bones m with skinning weights w_m.
- Pose: a rotation of joint k by the world rotation vector omega moves the point by omega x a_k. The
  lever arm from the joint's position p_k is a_k = sum over m of w_m (R_m x + t_m - p_k), over the
  bones m of joint k and its descendants. This is the geometric Jacobian of a manipulator, blended.
  A change of the axis-angle theta_k is the rotation omega = R_parent J_l(theta_k) d theta_k with
  the left Jacobian J_l of the rotation group.
- Shape: the point moves by M S + sum_m w_m d t_m with the blended rotation M = sum_m w_m R_m and
  the point's shape directions S.
- Pose blend shapes P add M P d vec(R_k) / d theta_k, with the local rotation R_k.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import NUM_JOINTS, PARENTS
from intercap_core.body.kinematics import PosedJoints, joint_shape_derivatives, left_jacobian, skew
from intercap_core.body.parameters import NUM_POSE, TRANSL
from intercap_core.body.selection import Selection


def shaped_points(selection: Selection, shape: Tensor, local: Tensor) -> Tensor:
    """Return points (B,N,3) at rest, metres: the template after shape and pose blend shapes.

    shape (B,S): betas and expression. local (B,55,3,3): rotations of the joints.
    """
    batch, count = shape.shape[0], selection.template.shape[0]
    size = selection.directions.shape[-1]
    points = selection.template + (shape @ selection.directions.reshape(-1, size).T).reshape(
        batch, count, 3
    )
    if selection.posedirs is not None:
        eye = torch.eye(3, dtype=local.dtype, device=local.device)
        feature = (local[:, 1:] - eye).reshape(batch, -1)
        width = selection.posedirs.shape[-1]
        points = points + (feature @ selection.posedirs.reshape(-1, width).T).reshape(
            batch, count, 3
        )
    return points


@dataclass(frozen=True)
class Linearisation:
    """N posed points of B bodies and their derivatives."""

    points: Tensor
    """(B, N, 3) metres."""
    turns: Tensor
    """(B, N, L, 3) lever arm a_k of each joint in ``selection.chain``, metres."""
    frames: Tensor
    """(B, 55, 3, 3) R_parent J_l: maps a change of a joint's axis-angle to its rotation vector in
    the world."""
    shape: Tensor
    """(B, N, 3, S) derivatives by betas and expression; S = 0 if they are not requested."""
    correctives: Tensor | None
    """(B, N, 3, 54, 3) derivatives of the pose blend shapes by the axis-angles of the 54 joints
    below the root; None without pose blend shapes."""
    selection: Selection

    @property
    def num_parameters(self) -> int:
        return TRANSL.stop + self.shape.shape[-1]

    @property
    def vertices(self) -> Tensor:
        """(B,V,3)"""
        return self.points[:, : self.selection.num_vertices]

    @property
    def joints(self) -> Tensor:
        """(B,55,3); empty if the joints were not requested."""
        return self.points[:, self.selection.num_vertices :]

    def full(self) -> Tensor:
        """Return all derivatives (B,N,3,P), mostly zeros; for few points."""
        batch, count = self.points.shape[:2]
        eye = torch.eye(3, dtype=self.points.dtype, device=self.points.device)
        return self.along(eye.expand(batch, count, 3, 3))

    def along(self, directions: Tensor) -> Tensor:
        """Return n^T d point / d parameters (B,N,R,P) for directions n (B,N,R,3).

        With R = 1 and the normals of the surface these are the rows of point-to-plane residuals.
        With R = 2 and the derivative of a projection, they are those of pixel residuals.
        """
        batch, count, rows = directions.shape[:3]
        out = directions.new_zeros(batch, count, rows, self.num_parameters)
        chain = self.selection.chain
        # n . (omega x a) = omega . (a x n)
        twist = _cross(self.turns[:, :, :, None], directions[:, :, None])
        frame = self.frames[:, chain]
        columns = torch.einsum("bnlrc,bnlcd->bnrld", twist, frame)
        index = (3 * chain[..., None] + torch.arange(3, device=chain.device)).reshape(count, -1)
        out.scatter_add_(
            3,
            index[None, :, None].expand(batch, count, rows, -1),
            columns.reshape(batch, count, rows, -1),
        )
        if self.correctives is not None:
            extra = torch.einsum("bnrc,bncjd->bnrjd", directions, self.correctives)
            out[..., 3:NUM_POSE] += extra.reshape(batch, count, rows, -1)
        out[..., TRANSL] = directions
        out[..., TRANSL.stop :] = directions @ self.shape
        return out

    def normal_equations(
        self, directions: Tensor, weights: Tensor, residuals: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return J^T W J (B,P,P) and J^T W r (B,P) with the rows J of :meth:`along`.

        The points of a limb depend on few joints, so each limb (:class:`.selection.Limbs`) is one
        dense product over the columns of these joints.

        Args:
            directions: (B, N, R, 3)
            weights: (B, N, R)
            residuals: (B, N, R)
        """
        batch = self.points.shape[0]
        size = self.num_parameters
        hessian = directions.new_zeros(batch, size, size)
        gradient = directions.new_zeros(batch, size)
        three = torch.arange(3, device=directions.device)
        tail = torch.arange(TRANSL.start, size, device=directions.device)
        order, starts, moved_by = self.selection.limbs
        for first, last, joints in zip(starts, starts[1:], moved_by, strict=False):
            points = torch.as_tensor(order[first:last], device=directions.device)
            moving = np.flatnonzero(joints) if self.correctives is None else np.arange(NUM_JOINTS)
            active = torch.as_tensor(moving, device=directions.device)
            columns = torch.cat([(3 * active[:, None] + three).reshape(-1), tail])
            cost = len(points) * directions.shape[2] * len(columns) * directions.element_size()
            step = max(1, int(64e6 // max(cost, 1)))  # bytes in memory at once
            for start in range(0, batch, step):
                at = slice(start, start + step)
                j = self._rows(at, points, active, directions)
                w = weights[at, points].reshape(j.shape[:2])
                r = residuals[at, points].reshape(j.shape[:2])
                weighted = j * w[..., None]
                part = weighted.transpose(1, 2) @ j
                frames = torch.arange(batch, device=j.device)[at]
                hessian[frames[:, None, None], columns[:, None], columns] += part
                gradient[frames[:, None], columns] += (weighted * r[..., None]).sum(1)
        return hessian, gradient

    def _rows(self, at: slice, rows: Tensor, active: Tensor, directions: Tensor) -> Tensor:
        """Return the rows (b, n*R, 3m + 3 + S) of some points.

        Args:
            at: the b bodies.
            rows: (n,) points.
            active: (m,) joints, whose columns come first; all 55 with pose blend shapes.
            directions: (B, N, R, 3)
        """
        place = torch.zeros(NUM_JOINTS, dtype=torch.long, device=rows.device)
        place[active] = torch.arange(len(active), device=rows.device)
        chain = self.selection.chain[rows]
        n = directions[at, rows]
        batch, count, num_rows = n.shape[:3]
        arms = self.turns.new_zeros(batch, count, len(active), 3)
        arms.scatter_add_(
            2, place[chain][None, :, :, None].expand(batch, -1, -1, 3), self.turns[at, rows]
        )
        twist = _cross(arms[:, :, None], n[:, :, :, None])
        frame = self.frames[at][:, active]
        pose = torch.einsum("bnrmc,bmcd->bnrmd", twist, frame).reshape(batch, count, num_rows, -1)
        if self.correctives is not None:
            extra = torch.einsum("bnrc,bncjd->bnrjd", n, self.correctives[at, rows])
            pose[..., 3:] += extra.reshape(batch, count, num_rows, -1)
        shape = n @ self.shape[at, rows]
        return torch.cat([pose, n, shape], -1).reshape(batch, count * num_rows, -1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Return (...,3) x (...,3), broadcast, in a third of the time of torch.linalg.cross."""
    a0, a1, a2 = a.unbind(-1)
    b0, b1, b2 = b.unbind(-1)
    return torch.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], -1)


def linearise(
    selection: Selection,
    points: Tensor,
    posed: PosedJoints,
    axis_angle: Tensor,
    joint_directions: Tensor | None,
) -> Linearisation:
    """Pose points and differentiate them.

    Args:
        selection: skinning and directions of the N points.
        points: (B, N, 3) at rest, metres.
        posed: the posed joints.
        axis_angle: (B, 55, 3) local rotations.
        joint_directions: (55, 3, S) derivatives of the rest joints by the shape; None to leave out
            derivatives by the shape.
    """
    batch, count = points.shape[:2]
    both = torch.cat([posed.rotations.reshape(batch, NUM_JOINTS, 9), posed.offsets], 2)
    blended = selection.weights @ both
    matrix, offset = blended[..., :9].reshape(batch, -1, 3, 3), blended[..., 9:]
    placed = (matrix @ points[..., None])[..., 0] + offset

    bones = selection.bones
    parts = (
        torch.einsum("bnkij,bnj->bnki", posed.rotations[:, bones], points) + posed.offsets[:, bones]
    )
    turns = torch.einsum("nlk,bnki->bnli", selection.below, parts)
    turns = turns - selection.below.sum(2)[..., None] * posed.joints[:, selection.chain]

    # J_l in the frame of the parent; frames = R_parent J_l in the world
    turn_of_local = left_jacobian(axis_angle)
    around = posed.rotations[:, [max(parent, 0) for parent in PARENTS]]
    around[:, 0] = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    frames = around @ turn_of_local
    shape = points.new_zeros(batch, count, 3, 0)
    if joint_directions is not None:
        _, moved_offsets = joint_shape_derivatives(posed, joint_directions)
        shape = (selection.weights @ moved_offsets.reshape(batch, NUM_JOINTS, -1)).reshape(
            batch, count, 3, -1
        )
        # adds matrix @ directions; three dense passes are faster than one matmul
        for axis in range(3):
            shape = torch.addcmul(
                shape, matrix[..., axis : axis + 1], selection.directions[:, None, axis]
            )

    correctives = None
    if selection.posedirs is not None:
        # d R / d theta_c = skew(J_l e_c) R, with the unit vector e_c
        change = skew(turn_of_local[:, 1:].transpose(-1, -2)) @ posed.local[:, 1:, None]
        change = change.reshape(batch, NUM_JOINTS - 1, 3, 9)
        tables = selection.posedirs.reshape(count, 3, NUM_JOINTS - 1, 9)
        rest = torch.einsum("nija,bjca->bnijc", tables, change)
        correctives = (matrix @ rest.reshape(batch, count, 3, -1)).reshape(rest.shape)
    return Linearisation(placed, turns, frames, shape, correctives, selection)
