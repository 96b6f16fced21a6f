"""How E_J and E_D (equations 3 and 4) change with small corrections of the cameras.

A camera that is turned by w about its centre s, shifted by v and whose depth bias grows by b moves
what it measured at p by w x (p - s) + v - b r, r the ray to p for a metre of depth. To keypoints it
is as if the body had moved the other way. The weights are those that E_B has at the last look.
"""

from __future__ import annotations

import numpy as np
import torch

from intercap_core.body_fit import body_cloud, body_keypoints
from intercap_core.body_fit.constants import KEYPOINT_SCALE
from intercap_core.body_fit.evidence import Evidence
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.geometry.camera import projection
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.joint.cameras import BIAS, FREEDOMS, SHIFT, TURN, Sights
from intercap_core.joint.state import BODY

_CHUNK = 32  # frames whose derivatives are held at once


def add_by_cameras(
    evidence: Evidence, problem: BodyProblem, trusted: np.ndarray, seen: Sights
) -> None:
    """Add the ``trusted`` (N,) of the evidence's N frames at the problem's bodies."""
    frames = np.flatnonzero(trusted)
    for part in np.array_split(frames, max(1, -(-len(frames) // _CHUNK))):
        if len(part):
            _add_keypoints(evidence, problem, part, seen)
            _add_clouds(evidence, problem, part, seen)


def _add_keypoints(
    evidence: Evidence, problem: BodyProblem, part: np.ndarray, seen: Sights
) -> None:
    views = problem.views
    if views is None:
        return
    offsets = problem.offsets.new_zeros(len(problem.keypoints.index), 3)
    offsets[: len(problem.offsets)] = problem.offsets
    found = body_keypoints.evaluate(
        problem.model,
        problem.model.parameters(problem.base[part]),
        problem.keypoints,
        offsets,
        derivatives=True,
        columns=torch.arange(BODY.stop, device=problem.base.device),
    )
    assert found.derivatives is not None
    points = found.points[:, None]
    if views.shift is not None:
        points = points + views.shift[part]
    rotation = views.colour_from_master[:, :3, :3]
    in_camera = points @ rotation.transpose(1, 2) + views.colour_from_master[:, None, :3, 3]
    pixels, by_camera = projection.project_with_jacobian(in_camera, views.lenses[:, None])
    sigma = views.sigma[part][..., None]
    known = (views.confidence[part] > 0)[..., None]
    residual = torch.where(known, (pixels - views.observed[part]) / sigma, 0)
    weight = views.confidence[part] * geman_mcclure_weight((residual**2).sum(-1), KEYPOINT_SCALE)
    by_point = by_camera @ rotation[:, None] / sigma[..., None]  # (b, C, K, 2, 3)
    by_point = torch.where(known[..., None], by_point, 0)
    centre = _poses(evidence).to(points)[:, :3, 3]
    arm = (points - centre[:, None])[..., None, :].expand(by_point.shape)
    nothing = by_point.new_zeros(*by_point.shape[:-1], 1)
    rows = -torch.cat([torch.linalg.cross(arm, by_point), by_point, nothing], -1)
    weighted = rows * weight[..., None, None]
    hessian = torch.einsum("bckaf,bckag->cfg", weighted, rows)
    gradient = torch.einsum("bckaf,bcka->cf", weighted, residual)
    by_keypoint = torch.einsum("bckaf,bckax->bkxcf", weighted, by_point)
    cross = torch.einsum("bkxn,bkxcf->bncf", found.derivatives, by_keypoint)
    for camera, block in enumerate(_array(hessian)):
        own = slice(FREEDOMS * camera, FREEDOMS * (camera + 1))
        seen.hessian[own, own] += block
    seen.pull[:] += _array(gradient).ravel()
    seen.cross[evidence.frames[part], BODY] += _array(cross).reshape(*cross.shape[:2], -1)


def _add_clouds(evidence: Evidence, problem: BodyProblem, part: np.ndarray, seen: Sights) -> None:
    rows, by_view = problem.rows, evidence.by_view
    if rows is None or by_view is None:
        return
    model = problem.model
    linear = model.linearise(model.parameters(problem.base[part]), vertex_ids=evidence.sample_ids)
    normal, points = rows.normal[part], linear.vertices
    by_body = -linear.along(normal[:, :, None])[:, :, 0][..., BODY]
    own = body_cloud.CloudRows(*(values[part] for values in rows))
    residual = body_cloud.residuals(points, own, problem.thickness_of_group(), evidence.group)
    poses = _poses(evidence).to(points)
    arm = points[:, None] - poses[:, None, :3, 3]  # (b, C, S, 3)
    ray = arm / (arm @ poses[:, :3, 2, None]).clamp_min(0.1)
    facing = normal[:, None].expand(arm.shape)
    by_camera = points.new_zeros(*arm.shape[:3], FREEDOMS)
    by_camera[..., TURN], by_camera[..., SHIFT] = torch.linalg.cross(arm, facing), facing
    by_camera[..., BIAS] = -(facing * ray).sum(-1)
    number = by_view.points[part]
    share = number / number.sum(1, keepdim=True).clamp_min(1e-6)
    flat = (by_camera * share[..., None]).transpose(1, 2).flatten(2)  # (b, S, D)
    weighted = flat * own.weight[..., None]
    seen.hessian[:] += _array(torch.einsum("bsd,bse->de", weighted, flat))
    seen.pull[:] += _array(torch.einsum("bsd,bs->d", weighted, residual))
    seen.cross[evidence.frames[part], BODY] += _array(by_body.transpose(1, 2) @ weighted)


def _poses(evidence: Evidence) -> torch.Tensor:
    """(C, 4, 4) of the cameras; zeros for one without, which shows nothing."""
    return torch.as_tensor(np.nan_to_num(evidence.seen.rig.master_from_colour))


def _array(values: torch.Tensor) -> np.ndarray:
    return values.double().cpu().numpy()
