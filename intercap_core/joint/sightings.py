"""Residuals of keypoints and clouds by camera, as the estimate of time offsets takes them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.keypoints import BODY, FACE, LEFT_HAND, RIGHT_HAND
from intercap_core.body_fit.evidence import Evidence
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.geometry.camera import projection
from intercap_core.joint.constants import HALF_WEIGHT_POINTS
from intercap_core.joint.time_offsets import Sightings


def keypoint_sightings(evidence: Evidence, problem: BodyProblem) -> Sightings:
    """The problem's keypoints in every colour image, in units of their sigma."""
    views = problem.views
    if views is None:
        raise ValueError("the problem has no views to compare with")
    points = evidence.points(problem)
    seen = points[:, None] if views.shift is None else points[:, None] + views.shift
    rotation = views.colour_from_master[:, :3, :3]
    in_camera = seen @ rotation.transpose(1, 2) + views.colour_from_master[:, None, :3, 3]
    pixels, by_camera = projection.project_with_jacobian(in_camera, views.lenses[:, None])
    by_point = by_camera @ rotation[:, None] / views.sigma[..., None, None]
    velocity = by_point @ evidence.velocity(points)[:, None, :, :, None]
    return Sightings(
        _array((pixels - views.observed) / views.sigma[..., None]),
        _array(velocity[..., 0]),
        _array(by_point),
        _array(views.confidence),
        _part_of_keypoint(problem.keypoints.index.cpu().numpy()),
    )


def cloud_sightings(evidence: Evidence, problem: BodyProblem) -> Sightings | None:
    """The person's points at every sample of the skin, along its normal; None without depth."""
    found = evidence.by_view
    if found is None:
        return None
    params = evidence.model.parameters(problem.base)
    where = evidence.model.forward(params, vertex_ids=evidence.sample_ids).vertices
    along = (evidence.velocity(where) * found.normal).sum(-1)
    joint = evidence.model.skinning_weights.argmax(1)[evidence.sample_ids]
    shape = (*found.distance.shape, 1)
    return Sightings(
        -_array(found.distance)[..., None],
        np.broadcast_to(_array(along)[:, None, :, None], shape),
        np.ones((*shape, 1)),
        _array(found.points / (found.points + HALF_WEIGHT_POINTS)),
        joint.cpu().numpy(),
    )


def _part_of_keypoint(index: np.ndarray) -> np.ndarray:
    """Each body keypoint is a part of its own; all of a hand are one, and all of the face."""
    starts = (LEFT_HAND.start, RIGHT_HAND.start, FACE.start)
    hand_or_face = BODY.stop - 1 + np.searchsorted(starts, index, side="right")
    return np.where(index < BODY.stop, index, hand_or_face)


def _array(values: Tensor) -> np.ndarray:
    with torch.no_grad():
        return values.double().cpu().numpy()
