"""Keypoint term of the body's energy, E_J: equation 3, a part of equation 2.

    E_J = sum over views v, keypoints i of k_i w_i^v rho_J( Pi^v(X_i(theta, beta, gamma)) - J_i^v )

with Geman and McClure's rho_J, the projection Pi^v of view v, the detection J_i^v, the confidence w
of the detector and the precision k = 1 / sigma^2 of a keypoint. Beyond the paper: X_i is the
model's keypoint plus an offset o_i that is constant in the frame of one bone, its carrier.
Detectors and body models mean different points by the same name ("hip"), and the difference is the
same in every frame. o_i is estimated with a Gaussian prior (:class:`.problem.ParameterLayout`).
Also beyond the paper: triangulated keypoints are added as residuals in metres with the same rho_J.

The residuals of all views depend on the body only through the 3D point X_i. They are summed into
one gradient (3,) and one Gauss-Newton matrix (3, 3) by the point. Then the derivatives of the point
by the body are applied.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.correctives_kernel import Correctives, RestPoints
from intercap_core.body.joints import NUM_JOINTS
from intercap_core.body.kinematics import pose_joints, rotation_from_axis_angle, skew
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import NUM_POSE, TRANSL, BodyParameters
from intercap_core.body_fit import keypoint_kernel
from intercap_core.body_fit.keypoint_kernel import KeypointData, Pieces
from intercap_core.body_fit.term_inputs import (
    Batch,
    BatchEquations,
    Bodies,
    CompiledTerm,
    KeypointSet,
    Targets,
    TermInputs,
    Views,
    contiguous,
)
from intercap_core.geometry.camera import projection
from intercap_core.geometry.solve.robust import OUTLIER_SIGMAS

LEAST_CONFIDENCE = 0.1  # confidence below which sigma no longer grows; tuned on the studio


def fit_confidence_exponent(confidence: Tensor, error: Tensor) -> float:
    """Fit errors (M,) by a multiple of confidence^-a, confidence (M,), and return a.

    -a is the slope of log median error over log median confidence, in six bins of confidence. a is
    limited to 0 to 2, and 0 if a bin has less than 30 errors. Tuned on the studio.
    """
    bins = torch.tensor_split(confidence.argsort(), 6)
    if len(bins[0]) < 30:
        return 0.0
    x = torch.stack([confidence[at].median() for at in bins]).clamp_min(LEAST_CONFIDENCE).log()
    y = torch.stack([error[at].median() for at in bins]).clamp_min(1e-6).log()
    x, y = x - x.mean(), y - y.mean()
    slope = -float((x * y).sum() / (x * x).sum().clamp_min(1e-6))
    return min(max(slope, 0.0), 2.0)


class Keypoints(NamedTuple):
    """K keypoints of B bodies and their derivatives by n parameters."""

    points: Tensor
    """(B, K, 3) with offsets, metres."""
    derivatives: Tensor | None
    """(B, K, 3, n)"""


def evaluate(
    model: BodyModel,
    params: BodyParameters,
    chosen: KeypointSet,
    offsets: Tensor,
    *,
    derivatives: bool,
    columns: Tensor | None = None,
) -> Keypoints:
    """Return the chosen keypoints of B bodies.

    Args:
        model: the body.
        params: parameters of the B bodies.
        chosen: the keypoints.
        offsets: (K, 3) in the frames of the bones, metres.
        derivatives: compute the derivatives as well.
        columns: (n,) parameters to differentiate by; None = all.
    """
    arms = (carrier_rotations(params, chosen) @ offsets[..., None])[..., 0]
    if not derivatives:
        output = model.forward(params, vertex_ids=chosen.vertices)
        points = chosen.matrix @ torch.cat([output.vertices, output.joints], 1)
        return Keypoints(points + arms, None)
    if columns is None:
        columns = torch.arange(model.num_parameters)
    linear = model.linearise(params, vertex_ids=chosen.vertices, joints=True)
    full = replace(linear, correctives=None).full()
    batch, _, _, size = full.shape
    by = (chosen.matrix @ full.reshape(batch, full.shape[1], -1)).reshape(batch, -1, 3, size)
    # a rotation omega of joint l moves the rotated offset R o by omega x R o, if l is the carrier
    # or an ancestor of it
    moved = (offsets != 0).any(1).nonzero()[:, 0]
    turned = -skew(arms[:, moved])[:, :, None] @ linear.frames[:, None]
    turned = turned * chosen.turned_by[moved][None, :, :, None, None]
    by[:, moved, :, : 3 * NUM_JOINTS] += turned.transpose(2, 3).reshape(
        batch, len(moved), 3, 3 * NUM_JOINTS
    )
    if linear.correctives is not None:
        extra = torch.einsum("kn,bnijd->bkijd", chosen.matrix, linear.correctives)
        by[..., 3:NUM_POSE] += extra.flatten(3)
    points = chosen.matrix @ linear.points + arms
    return Keypoints(points, by[..., columns])


def carrier_rotations(params: BodyParameters, chosen: KeypointSet) -> Tensor:
    """Return the rotations (B, K, 3, 3) of the bones that carry the offsets."""
    local = rotation_from_axis_angle(params.full_pose())
    still = local.new_zeros(local.shape[0], NUM_JOINTS, 3)
    return pose_joints(still, local, still[:, 0]).rotations[:, chosen.carrier]


def pixel_residuals(points: Tensor, views: Views) -> Tensor:
    """Return projection minus observation (B, C, K, 2), px, of points (B, K, 3)."""
    in_camera = _in_cameras(points, views.colour_from_master, views.shift)
    return projection.project(in_camera, views.lenses[:, None]) - views.observed


def _in_cameras(points: Tensor, pose: Tensor, shift: Tensor | None) -> Tensor:
    """Return points (B, K, 3) in the frames of C cameras, (B, C, K, 3), when each camera exposes.

    pose (C, 4, 4): colour_from_master. shift (B, C, K, 3): displacement until then, or None.
    """
    moved = points[:, None] if shift is None else points[:, None] + shift
    return moved @ pose[:, :3, :3].transpose(1, 2) + pose[:, None, :3, 3]


# --- compiled --------------------------------------------------------------------------------


class CompiledKeypoints:
    """E_J by :mod:`.keypoint_kernel`; the pieces of the last set of keypoints are cached."""

    def __init__(self, model: BodyModel) -> None:
        self._model = model
        self._cached: tuple[KeypointSet, Pieces, Correctives | None] | None = None

    def prepare(self, inputs: TermInputs, bodies: Bodies, derivatives: bool) -> CompiledTerm:
        """Return the term at these bodies."""
        if self._cached is None or self._cached[0] is not inputs.keypoints:
            pieces = Pieces.of(self._model, inputs.keypoints)
            tables = pieces.posedirs
            correctives = Correctives.of(tables) if tables.shape[2] else None
            self._cached = inputs.keypoints, pieces, correctives
        _, pieces, correctives = self._cached
        shape = contiguous(bodies.vectors[:, TRANSL.stop :])
        at_rest = pieces.at_rest(shape, bodies.offsets.numpy())
        rest = RestPoints.of(at_rest, correctives, derivatives)
        data = _keypoint_data(inputs, bodies.vectors)

        def used(frames: np.ndarray) -> np.ndarray:
            return np.ones((len(frames), rest.points.shape[1]), bool)

        def add_cost(batch: Batch, cost: np.ndarray) -> None:
            points = rest.points[batch.at]
            keypoint_kernel.add_cost(batch.skeleton, pieces, points, data, batch.frames, cost)

        def add(batch: Batch, equations: BatchEquations) -> None:
            keypoint_kernel.add_equations(
                batch.skeleton, pieces, rest.points[batch.at], data, batch.frames, equations,
                rest.gradient[batch.at],
            )  # fmt: skip

        return CompiledTerm(rest, used, add_cost, add)


def _keypoint_data(inputs: TermInputs, like: Tensor) -> KeypointData:
    """Return the observations in the floating type of ``like``; absent ones have length 0."""
    if inputs.views is None and inputs.targets is None:
        raise ValueError("the problem has neither views nor targets")

    def absent(axes: int) -> Tensor:
        return like.new_zeros((0,) * axes)

    def array(values: Tensor) -> np.ndarray:
        return contiguous(values.to(like))

    views = inputs.views or Views(absent(4), absent(3), absent(3), absent(2), absent(3))
    targets = inputs.targets or Targets(absent(3), absent(2), sigma=1.0)
    return KeypointData(
        observed=array(views.observed),
        confidence=array(views.confidence),
        sigma=array(views.sigma),
        lenses=array(views.lenses),
        colour_from_master=array(views.colour_from_master),
        shift=array(absent(4) if views.shift is None else views.shift),
        targets=array(targets.points),
        targets_confidence=array(targets.confidence),
        targets_sigma=float(targets.sigma),
        scale=OUTLIER_SIGMAS,
    )
