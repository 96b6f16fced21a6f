"""Keypoint term of the body's energy, E_J: equation 3, a part of equation 2.

    E_J = sum over views v, keypoints i of k_i w_i^v rho_J( Pi^v(X_i(theta, beta, gamma)) - J_i^v )

with Geman and McClure's rho_J, the projection Pi^v of view v, the detection J_i^v, the detector's
confidence w and the precision k = 1 / sigma^2 of a keypoint. Beyond the paper: X_i is the model's
keypoint plus an offset o_i that is fixed in the frame of the bone that carries it. Detectors and
body models mean different points by the same name ("hip"), and that difference is the same in every
frame. o_i is estimated with a Gaussian prior, see :mod:`intercap_core.body_fit.layout`.

A view's residuals depend on the body through the 3D point alone, so the views are summed into one
3 x 3 matrix and one 3-vector for each keypoint before the body's derivatives come in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import NUM_JOINTS, PARENTS, ancestors
from intercap_core.body.kinematics import pose_joints, rotation_from_axis_angle, skew
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import NUM_POSE, BodyParameters
from intercap_core.body.selection import Limbs
from intercap_core.geometry.camera import projection
from intercap_core.geometry.solve.robust import geman_mcclure


class Keypoints(NamedTuple):
    """points (B,K,3) with offsets applied, derivatives (B,K,3,n), bone rotations (B,K,3,3).

    of_own_limb (B,K,3,n): derivatives with pose blend shapes by the joints of each keypoint's own
    limb alone, as Gauss-Newton matrices have them.
    """

    points: Tensor
    derivatives: Tensor | None
    rotations: Tensor
    of_own_limb: Tensor | None = None


class PointTerm(NamedTuple):
    """A term that acts through points: cost (B,), and by point gradient (B,K,3), matrix (B,K,3,3).

    The gradient is that of the cost by the points; the matrix is Gauss-Newton's.
    """

    cost: Tensor
    gradient: Tensor
    matrix: Tensor


@dataclass(frozen=True)
class KeypointSet:
    """Some of the 135 keypoints, by ``index`` (K,), and what they are made of.

    vertices (N,) ids; matrix (K,N+55) over those vertices and the joints; carrier (K,): joint whose
    bone carries the keypoint's offset, and turned_by (K,55): 1 for the joints that turn that bone.
    limbs: keypoints on the same chain of joints.
    """

    index: Tensor
    vertices: Tensor
    matrix: Tensor
    carrier: Tensor
    turned_by: Tensor
    limbs: Limbs


def keypoint_set(model: BodyModel, index: Sequence[int] | range) -> KeypointSet:
    """A joint is carried by its parent's bone, a vertex by the bone with the largest weight."""
    keypoints, rows = model.keypoint_map, np.asarray(index)
    heaviest = model.skinning_weights.argmax(1).cpu().numpy()
    carrier = [
        max(PARENTS[joint], 0) if joint >= 0 else int(heaviest[ids[weights.argmax()]])
        for joint, ids, weights in zip(
            keypoints.joint[rows], keypoints.ids[rows], keypoints.weights[rows], strict=True
        )
    ]
    turned = np.zeros((len(rows), NUM_JOINTS))
    for row, joint in enumerate(carrier):
        turned[row, list(ancestors(joint))] = 1
    matrix = keypoints.matrix[rows]
    count = len(keypoints.vertex_ids)
    used = np.flatnonzero(matrix[:, :count].any(0))
    matrix = np.concatenate([matrix[:, used], matrix[:, count:]], 1)
    device = model.device
    vertices = keypoints.vertex_ids[used]
    follows = np.zeros((len(vertices) + NUM_JOINTS, NUM_JOINTS), bool)  # a joint its parent alone
    follows[: len(vertices)] = model.skinning_weights[torch.as_tensor(vertices)].cpu().numpy() != 0
    follows[len(vertices) + np.arange(NUM_JOINTS), [max(parent, 0) for parent in PARENTS]] = True
    return KeypointSet(
        torch.as_tensor(rows, device=device),
        torch.as_tensor(vertices, device=device),
        torch.as_tensor(matrix, dtype=model.dtype, device=device),
        torch.as_tensor(carrier, device=device),
        torch.as_tensor(turned, dtype=model.dtype, device=device),
        _limbs([_chain(np.flatnonzero(bones)) for bones in (matrix != 0) @ follows]),
    )


def _chain(bones: np.ndarray) -> frozenset[int]:
    """All joints that move any of the bones."""
    return frozenset().union(*(ancestors(bone) for bone in bones.tolist()))


def _limbs(chains: list[frozenset[int]]) -> Limbs:
    """Keypoints by limb: each goes with the first of those of longest chain that holds its own."""
    limbs: list[list[int]] = []
    for k in sorted(range(len(chains)), key=lambda k: (-len(chains[k]), k)):
        home = next((limb for limb in limbs if chains[k] <= chains[limb[0]]), None)
        if home is None:
            limbs.append([k])
        else:
            home.append(k)
    moved_by = np.zeros((len(limbs), NUM_JOINTS), bool)
    for flags, limb in zip(moved_by, limbs, strict=True):
        flags[sorted(chains[limb[0]])] = True
    return Limbs(np.concatenate(limbs), np.cumsum([0, *map(len, limbs)]), moved_by)


def evaluate(
    model: BodyModel,
    params: BodyParameters,
    chosen: KeypointSet,
    offsets: Tensor,
    *,
    derivatives: bool,
    columns: Tensor | None = None,
) -> Keypoints:
    """Keypoints (B,K,3) of B bodies; offsets (K,3), metres, in the frames of their bones.

    Derivatives, if requested, are by the chosen ``columns`` (n,) of the parameters, or by all.
    """
    local = rotation_from_axis_angle(params.full_pose())
    still = local.new_zeros(local.shape[0], NUM_JOINTS, 3)
    world = pose_joints(still, local, still[:, 0]).rotations
    rotations = world[:, chosen.carrier]
    arms = (rotations @ offsets[..., None])[..., 0]
    if not derivatives:
        output = model.forward(params, vertex_ids=chosen.vertices)
        points = chosen.matrix @ torch.cat([output.vertices, output.joints], 1)
        return Keypoints(points + arms, None, rotations)
    if columns is None:
        columns = torch.arange(model.num_parameters, device=model.device)
    linear = model.linearise(params, vertex_ids=chosen.vertices, joints=True)
    full = linear.with_correctives_of(None).full()
    batch, _, _, size = full.shape
    by = (chosen.matrix @ full.reshape(batch, full.shape[1], -1)).reshape(batch, -1, 3, size)
    # a turn w of joint l moves the arm R o by w x R o, for every l the carrier hangs on
    moved = (offsets != 0).any(1).nonzero()[:, 0]
    turned = -skew(arms[:, moved])[:, :, None] @ linear.frames[:, None]
    turned = turned * chosen.turned_by[moved][None, :, :, None, None]
    by[:, moved, :, : 3 * NUM_JOINTS] += turned.transpose(2, 3).reshape(
        batch, len(moved), 3, 3 * NUM_JOINTS
    )
    of_own_limb = by
    if linear.correctives is not None:
        extra = torch.einsum("kn,bnijd->bkijd", chosen.matrix, linear.correctives)
        flags = torch.as_tensor(chosen.limbs.moved_by_point()[:, 1:], device=model.device)
        of_own_limb = by.clone()
        of_own_limb[..., 3:NUM_POSE] += (extra * flags[:, None, :, None]).flatten(3)
        by[..., 3:NUM_POSE] += extra.flatten(3)
    points = chosen.matrix @ linear.points + arms
    return Keypoints(points, by[..., columns], rotations, of_own_limb[..., columns])


def reprojection(
    points: Tensor,
    observed: Tensor,
    confidence: Tensor,
    sigma: Tensor,
    lenses: Tensor,
    colour_from_master: Tensor,
    *,
    scale: float,
    shift: Tensor | None = None,
) -> PointTerm:
    """E_J (equation 3) of points (B,K,3), master frame, in C views.

    observed (B,C,K,2) px; confidence (B,C,K), 0 = not detected; sigma (B,C,K) px; lenses
    (C,13) as :mod:`projection` takes them; colour_from_master (C,4,4). ``scale``: residuals beyond
    so many sigma stop counting. shift (B,C,K,3), metres: how much farther each point has moved when
    that camera exposes. cost = sum w rho(|r / sigma|^2) / 2.
    """
    rotation, translation = colour_from_master[:, :3, :3], colour_from_master[:, :3, 3]
    moved = points[:, None] if shift is None else points[:, None] + shift
    in_camera = moved @ rotation.transpose(1, 2) + translation[:, None]
    pixels, by_point = projection.project_with_jacobian(in_camera, lenses[:, None])
    known = confidence > 0
    residual = torch.where(known[..., None], (pixels - observed) / sigma[..., None], 0)
    robust = geman_mcclure((residual**2).sum(-1), scale)
    by_point = by_point @ rotation[:, None] / sigma[..., None, None]
    weight = confidence * robust.weight
    weighted = by_point.transpose(-1, -2) * weight[..., None, None]
    gradient = (weighted @ residual[..., None])[..., 0].sum(1)
    cost = 0.5 * (confidence * robust.rho).sum((1, 2))
    return PointTerm(cost, gradient, (weighted @ by_point).sum(1))


def pixel_residuals(
    points: Tensor,
    observed: Tensor,
    lenses: Tensor,
    colour_from_master: Tensor,
    *,
    shift: Tensor | None = None,
) -> Tensor:
    """Projection minus observation (B,C,K,2), px."""
    rotation, translation = colour_from_master[:, :3, :3], colour_from_master[:, :3, 3]
    moved = points[:, None] if shift is None else points[:, None] + shift
    in_camera = moved @ rotation.transpose(1, 2) + translation[:, None]
    return projection.project(in_camera, lenses[:, None]) - observed


def triangulated(
    points: Tensor, targets: Tensor, confidence: Tensor, *, sigma: float, scale: float
) -> PointTerm:
    """The same term on triangulated keypoints (beyond the paper): where the fit starts.

    points, targets (B,K,3), master frame, metres; confidence (B,K), 0 = no target; ``sigma`` in
    metres, ``scale`` in sigmas. cost = sum w rho(|(X - target) / sigma|^2) / 2.
    """
    known = confidence > 0
    residual = torch.where(known[..., None], (points - targets) / sigma, 0)
    robust = geman_mcclure((residual**2).sum(-1), scale)
    weight = confidence * robust.weight / sigma
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    return PointTerm(
        0.5 * (confidence * robust.rho).sum(1),
        weight[..., None] * residual,
        (weight / sigma)[..., None, None] * eye,
    )


def assemble(term: PointTerm, keypoints: Keypoints) -> tuple[Tensor, Tensor]:
    """Gradient (B,n) and Hessian (B,n,n) by the parameters that the derivatives are by."""
    if keypoints.derivatives is None or keypoints.of_own_limb is None:
        raise ValueError("keypoints were evaluated without derivatives")
    batch, _, _, size = keypoints.derivatives.shape
    by = keypoints.derivatives.reshape(batch, -1, size)
    gradient = (by.transpose(1, 2) @ term.gradient.reshape(batch, -1, 1))[..., 0]
    weighted = (term.matrix @ keypoints.of_own_limb).reshape(batch, -1, size)
    rows = keypoints.of_own_limb.reshape(batch, -1, size)
    return gradient, rows.transpose(1, 2) @ weighted


def assemble_offsets(
    term: PointTerm, keypoints: Keypoints, count: int
) -> tuple[Tensor, Tensor, Tensor]:
    """The part of the offsets of the first ``count`` keypoints (beyond the paper).

    Returns gradient (B,3 count), cross block (B,n,3 count) with the body's parameters, and the
    offsets' own block (B,3 count,3 count), block diagonal.
    """
    if keypoints.of_own_limb is None:
        raise ValueError("keypoints were evaluated without derivatives")
    rotation = keypoints.rotations[:, :count]
    batch = rotation.shape[0]
    gradient = (rotation.transpose(2, 3) @ term.gradient[:, :count, :, None])[..., 0]
    turned = term.matrix[:, :count] @ rotation
    by = keypoints.of_own_limb[:, :count]
    cross = (by.transpose(2, 3) @ turned).permute(0, 2, 1, 3).flatten(2)
    own = rotation.new_zeros(batch, count, 3, count, 3)
    each = torch.arange(count, device=rotation.device)
    own[:, each, :, each, :] = (rotation.transpose(2, 3) @ turned).transpose(0, 1)
    return gradient.reshape(batch, -1), cross, own.reshape(batch, 3 * count, 3 * count)
