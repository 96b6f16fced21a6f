"""Stage ``body_fit``: SMPL-X parameters in every frame (equation 2).

All frames are fitted at once by second-order steps. No term couples frames; they only share the
shape, the thickness of the clothing and the offsets of the detector's keypoints.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.body.artefact import file_digest, load_pose_prior, put_parameters
from intercap_core.body.loading import OPEN_BODY, ShapePrior, load_body_file
from intercap_core.body.model import BodyModel, check_body
from intercap_core.body_fit import quality
from intercap_core.body_fit.bridge import bridge, bridged_sigma, unwrap_turns
from intercap_core.body_fit.clouds import PersonCloud, person_clouds, put_clouds
from intercap_core.body_fit.definition import Definition
from intercap_core.body_fit.observations import read_observations
from intercap_core.body_fit.recover import JUMP_M, measure_jumps
from intercap_core.body_fit.schedule import BodyFit, Fitter
from intercap_core.body_fit.shared_estimate import SharedEstimate
from intercap_core.body_fit.uncertainty import Covariances, deviation, fit_covariances, widen
from intercap_core.config import BodyFitSettings, BodyModels, digest
from intercap_core.disk import DiskList
from intercap_core.entries import SubjectEntry
from intercap_core.errors import UserError
from intercap_core.geometry.solve.robust import MEDIAN_CHI_3
from intercap_core.schemas import BAD_BODY_M, BODY_FIT, BODY_PARTS

# Median trunk keypoint error from which the fit is not of the subject's body; tuned on the studio.
WRONG_TRUNK_M = 0.06
# Frames of the fit that checks the shape of another sequence. Its covariance does not depend on
# their number, since a recording counts as 3 independent frames (:mod:`.problem`).
CHECKED_FRAMES = 16


def run(
    *,
    frames: Path,
    scene: Path,
    person: Path,
    output: Path,
    subject: SubjectEntry,
    body_models: BodyModels,
    settings: BodyFitSettings,
    shape_from: Path | None = None,
) -> None:
    """Fit the subject's body in all frames and write body_fit.h5.

    A frame fails if it has too few keypoints, or if the fitted trunk is far from its keypoints. It
    also fails if only one view and no depth points show the person. Failed frames are marked
    ``failed`` and ``bridged``: their bodies are interpolated from neighbouring frames.

    Args:
        shape_from: body_fit artefact of another sequence of the subject, whose shape and coverings
            are start and prior of this one's. They are not used if this recording contradicts the
            shape.

    Raises UserError if no frame can be fitted, the body file cannot be used, or the artefacts do
    not belong together.
    """
    path = body_models.of(subject.gender) or OPEN_BODY
    file = load_body_file(path, settings.betas, num_expression=10)
    shapes = ShapePrior.of(file, subject.gender, subject.height)
    # the shapes of the fit are in units of the subject's prior
    model = BodyModel(shapes.centred(file), torch.device("cpu"), torch.float32)
    check_body(model)
    pose_prior = load_pose_prior(body_models, model)
    seen = read_observations(scene, person)
    earlier = None
    if shape_from is not None:
        body_model = file_digest(path)
        earlier = SharedEstimate.read(shape_from, seen.sequence, subject, body_model, shapes)
    if not seen.usable.any():
        raise UserError(
            f"{person}: sequence {seen.sequence}: in none of its {seen.num_frames} frames do two "
            "views, or one and its depth, place three keypoints of the subject's trunk; check the "
            "keypoints and the camera poses of this sequence"
        )
    clouds: DiskList[PersonCloud | None] = DiskList(output.parent)
    for cloud in person_clouds(frames, person, seen, settings.points_per_frame):
        clouds.append(cloud)
    definition = Definition.read(settings.keypoint_definition)

    def fit_with(
        earlier: SharedEstimate | None, some: np.ndarray | None = None
    ) -> tuple[BodyFit, Covariances, SharedEstimate]:
        own = clouds if some is None else clouds.select(some.tolist())
        fit = Fitter(model, seen, own, settings, pose_prior, definition, some, earlier).run()
        covariances = fit_covariances(model, fit)
        return fit, covariances, fit.shared_estimate(seen.sequence, covariances.shared)

    shape_note = {}
    if earlier is not None:
        usable = np.flatnonzero(seen.usable)
        rows = np.linspace(0, len(usable) - 1, min(CHECKED_FRAMES, len(usable))).astype(int)
        if earlier.contradicts(fit_with(None, usable[rows])[2]):
            shape_note["shape_note"] = (
                f"the images contradict the shape of sequence {earlier.sequence} (shape_from), "
                "which was not used; check that both show the same person"
            )
            earlier = None
    fit, covariances, shared = fit_with(earlier)

    fitted = np.zeros(seen.num_frames, bool)
    # limbs may be occluded: only the trunk decides whether this is the subject's body
    on_trunk = quality.trunk_distance(fit.parts) < WRONG_TRUNK_M
    # two views, or one view and depth points: keypoints of one view do not determine the distance
    determined = (~fit.pixel_residual.isnan()).sum(1) + (~fit.cloud_residual.isnan()) >= 2
    fitted[fit.frames[on_trunk & determined.numpy()]] = True
    if not fitted.any():
        raise UserError(
            f"{person}: sequence {seen.sequence}: in every frame the fitted trunk is more than "
            f"{1000 * WRONG_TRUNK_M:.0f} mm from its keypoints, or rests on one view without "
            "points of the person; check the camera poses, and that keypoints and masks belong to "
            "this recording"
        )
    vectors = np.zeros((seen.num_frames, model.num_parameters))
    vectors[fit.frames] = fit.vectors.double().numpy()
    vectors = bridge(vectors, fitted, seen.times)
    vectors[:, :3] = unwrap_turns(vectors[:, :3])

    params = model.parameters(torch.as_tensor(vectors, dtype=model.dtype))
    joints = model.forward(params, vertex_ids=np.array([0])).joints.numpy()
    stated = _state_uncertainty(model, fit, covariances.joints.numpy(), seen.times, fitted, joints)
    keypoint_residual = np.full((seen.num_frames, len(seen.rig)), np.nan)
    keypoint_residual[fit.frames] = fit.pixel_residual.numpy()
    cloud_residual = np.full(seen.num_frames, np.nan)
    cloud_residual[fit.frames] = fit.cloud_residual.numpy()
    with artefacts.write(
        output,
        BODY_FIT,
        settings_digest=digest(settings),
        sequence=seen.sequence,
        subject=subject.subject,
        gender=subject.gender,
        body_model=file_digest(path),
        **shape_note,
    ) as writer:
        put_parameters(writer, params, joints, betas=shapes.betas(params.betas).numpy())
        writer.put("keypoint_residual", keypoint_residual)
        writer.put("cloud_residual", cloud_residual)
        writer.put("joint_sigma", stated.sigma)
        writer.put("joint_covariance", stated.covariance)
        writer.put("keypoint_offsets", fit.settled.offsets.numpy())
        writer.put("keypoint_sigma", fit.settled.keypoint_sigma.numpy())
        writer.put("keypoint_doubt", fit.settled.keypoint_doubt.numpy())
        writer.put("covering", fit.settled.covering.numpy())
        writer.put("shared_covariance", shared.of_file(shapes))
        writer.put("covering_noise", fit.settled.cloud_noise.numpy())
        put_clouds(writer, clouds, len(seen.rig))
        writer.put("failed", ~fitted)
        writer.put("bridged", ~fitted)
        writer.put("uncertain", stated.uncertain)
        writer.put("part_names", list(BODY_PARTS))
        writer.put("undetermined", stated.undetermined)


class _Uncertainty(NamedTuple):
    """Uncertainty of the joints in T frames."""

    sigma: np.ndarray
    """(T, 55) standard deviation along one coordinate, metres."""
    covariance: np.ndarray
    """(T, 55, 3, 3) square metres."""
    undetermined: np.ndarray
    """(T, 8) bool: the images do not determine this part, in the order of BODY_PARTS."""
    uncertain: np.ndarray
    """(T,) bool: the expected mean vertex error exceeds BAD_BODY_M."""


def _state_uncertainty(
    model: BodyModel,
    fit: BodyFit,
    covariance: np.ndarray,
    times: np.ndarray,
    fitted: np.ndarray,
    joints: np.ndarray,
) -> _Uncertainty:
    """Return the uncertainty of all frames: fitted and bridged.

    The covariance of the fit gives the direction. Its size is widened for jumps of a joint, for
    limbs that only one view constrains, and in bridged frames.

    Args:
        model: the body.
        fit: the fit of N frames.
        covariance: (N, 55, 3, 3) of its joints, square metres.
        times: (T,) seconds.
        fitted: (T,) bool; other frames are bridged.
        joints: (T, 55, 3) metres.
    """
    count = len(times)
    sigma = np.zeros((count, 55))
    # A jump of a joint may be a wrong minimum, so it widens sigma. Jumps count from JUMP_M on; for
    # joints that only keypoints of one view constrain, and in refitted frames, from 0 on.
    least = np.full_like(sigma, JUMP_M)
    least[fit.frames] *= ~(quality.flag_unmeasured_joints(fit.parts) | fit.refitted[:, None])
    jumped = np.zeros_like(sigma)
    jumped[fitted] = measure_jumps(joints[fitted].astype(float), times[fitted], least[fitted])
    sigma[fit.frames] = np.hypot(
        quality.widen_sigma(deviation(covariance), fit.parts), jumped[fit.frames] / MEDIAN_CHI_3
    )
    undetermined = np.ones((count, len(BODY_PARTS)), bool)
    undetermined[fit.frames] = quality.flag_undetermined(sigma[fit.frames], fit.parts)
    undetermined[~fitted] = True
    sigma = bridged_sigma(joints.astype(float), fitted, sigma, times)
    stated = np.zeros((*sigma.shape, 3, 3))
    stated[fit.frames] = covariance
    stated[~fitted] = 0
    share = model.skinning_weights.double().mean(0).numpy()
    uncertain = fitted & (quality.expected_error(sigma, share) > BAD_BODY_M)
    return _Uncertainty(sigma, widen(stated, sigma), undetermined, uncertain)
