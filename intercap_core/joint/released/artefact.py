"""Whose release results are of.

Another program's results as the joint artefact, which metrics and all that follows read.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.body.artefact import file_digest
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.released import (
    BEHAVE_OBJECT,
    BEHAVE_PERSON,
    INTERCAP,
    Recording,
    Results,
    intercap_file,
)
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.joint.released import behave as release_behave
from intercap_core.joint.released import intercap as release_intercap
from intercap_core.schemas import CONTACT_REGIONS, JOINT, PERSON, SCENE
from intercap_core.sequence_inputs import SequenceModels, SequencePaths

log = logging.getLogger(__name__)
_FULL_HAND = 45
_SHAPE_VARIES_M = 0.001  # of the skin, from which on one shape for all frames is told
_LEAST_CONFIDENCE = 0.3  # of keypoints whose residuals are reported
_POSE = ("global_orient", "transl", "body_pose", "jaw_pose", "leye_pose", "reye_pose",
         "left_hand_pose", "right_hand_pose")  # fmt: skip


def read_results(path: Path, recording: Recording) -> Results:
    """Results of a sequence, whoever's they are.

    A file, and a folder that holds one of InterCap's names, is InterCap's; a folder of frame
    folders ``t<seconds>``, or with BEHAVE's parameters at 30 fps, is BEHAVE's. Raises UserError
    where it is neither, and as the readers do.
    """
    file = intercap_file(Path(path))
    if not file.is_dir():
        return release_intercap.read_results(file)
    at_30_fps = (BEHAVE_PERSON, BEHAVE_OBJECT)
    if any((file / name).is_file() for name in at_30_fps) or any(file.glob("t[0-9]*/")):
        return release_behave.read_results(file, recording)
    raise UserError(
        f"{file}: holds none of {', '.join(INTERCAP)} (InterCap's), no frame's folder t<seconds> "
        f"and none of {' and '.join(at_30_fps)} (BEHAVE's); name the file or folder of results"
    )


def import_joint(
    results: Path,
    paths: SequencePaths,
    models: SequenceModels,
    output: Path,
    *,
    betas: int,
    settings_digest: str,
) -> None:
    """Write joint.h5 of what another program found, in place of a fit.

    Cameras are those that were given, which the results belong to, with depth as measured; contact
    is what the meshes say, so that no probability is stated, nor is any energy. Frames without a
    result are filled from the nearest one and flagged. ``betas``: numbers of the shape, where
    results are of another body and ours is fitted to it. Raises UserError where the results are of
    another number of frames, or of more numbers than the body file has.
    """
    object_, subject = models.object_, models.subject
    path = models.body_models.of(subject.gender) or OPEN_BODY
    with artefacts.read(paths.scene, SCENE) as setting:
        total, sequence = len(setting["times"]), str(setting.attributes["sequence"])
        rig = Rig.from_artefact(setting).moved(setting["master_from_colour_start"])
        offsets, offset_sigma = setting["time_offset"], setting["time_offset_sigma"]
    with Frames.open(paths.frames) as recorded:
        times = recorded.first_set_s + recorded.time_s
    found = read_results(results, Recording(sequence, times, object_, path, betas))
    if len(found) != total:
        raise UserError(
            f"{found.path}: holds {len(found)} frames, sequence {sequence!r} has {total}; name the "
            "results of this recording, or drop the same frames of both (drop_frames)"
        )
    known = found.known
    if not known.any():
        raise UserError(f"{found.path}: has no frame whose every number is finite")
    model = BodyModel.load(
        path, num_betas=found.betas.shape[1], num_expression=found.expression.shape[1]
    )
    fill = np.arange(total)
    places = np.flatnonzero(known)
    fill[~known] = places[np.abs(places[None] - fill[~known, None]).argmin(axis=1)]
    shape = np.median(found.betas[known], axis=0)
    params = _parameters(found, model, fill, shape)
    with torch.no_grad():
        posed = model.forward(params, vertex_ids=model.keypoint_map.vertex_ids)
        keypoints = model.keypoints(posed).double().numpy()
    nothing_told = np.where(known, "", "no result in the imported file")
    reasons = list(found.reasons) or list(nothing_told)
    varies = _shape_varies(model, found.betas[known], shape)
    if varies > _SHAPE_VARIES_M:
        log.warning(
            "sequence %s: the shape in %s varies by frame; its median was taken, up to %.0f mm "
            "from it",
            sequence, found.path, 1e3 * varies,
        )  # fmt: skip
    has_object = object_ is not None and np.isfinite(found.translation).any()
    if object_ is not None and not has_object:
        log.warning("sequence %s: %s has no poses of an object", sequence, found.path)
    nothing = np.full(found.rotation.shape, np.nan), np.full(found.translation.shape, np.nan)
    rotation, translation = (
        (found.rotation[fill], found.translation[fill]) if has_object else nothing
    )
    count, regions = len(rig), len(CONTACT_REGIONS)
    with artefacts.write(
        output,
        JOINT,
        settings_digest=settings_digest,
        sequence=sequence,
        subject=subject.subject,
        object=object_.name if object_ else "",
        gender=subject.gender,
        body_model=file_digest(path),
        iterations=0,
        refused=0,
        converged=True,
        cameras_corrected=False,
        made_by=f"another program: {found.source}",
    ) as writer:
        writer.put("betas", shape.astype(np.float32))
        writer.put("expression", params.expression.numpy())
        for name in _POSE:
            writer.put(name, getattr(params, name).numpy())
        writer.put("joints", posed.joints.numpy())
        writer.put("keypoint_residual", _residuals(paths.person, rig, keypoints))
        writer.put("cloud_residual", np.full(total, np.nan, np.float32))
        writer.put("rotation", rotation)
        writer.put("translation", translation)
        writer.put("region_names", list(CONTACT_REGIONS))
        writer.put("contact_probability", np.full((total, regions), np.nan, np.float32))
        writer.put("contact_annotated", np.full((total, regions), -1, np.int8))
        writer.put("time_offset", offsets)
        writer.put("time_offset_sigma", offset_sigma)
        writer.put("camera_names", list(rig.names))
        writer.put("master_from_colour", rig.master_from_colour)
        writer.put("depth_bias", np.zeros(count))
        writer.put("camera_covariance", np.zeros((count, 7, count, 7)))
        writer.put("energy_names", [])
        writer.put("energy_before", np.zeros(0))
        writer.put("energy_after", np.zeros(0))
        writer.put("hand_undetermined", np.zeros((total, 2), bool))
        writer.put("flagged", np.array([bool(reason) for reason in reasons]))
        writer.put("flag_reason", reasons)
        if found.surface_distance is not None:
            writer.put("surface_distance", found.surface_distance)


def _parameters(
    found: Results, model: BodyModel, fill: np.ndarray, betas: np.ndarray
) -> BodyParameters:
    """Those of all frames, one shape; hands as full poses, mean included."""
    hands = []
    for side, hand in enumerate(found.hands):
        if hand.shape[1] < _FULL_HAND:
            basis = model.hand_components[side, : hand.shape[1]].numpy().astype(np.float64)
            hand = model.hand_mean[side].numpy().astype(np.float64) + hand @ basis
        hands.append(hand)
    values = {
        **found.turns,
        "transl": found.transl,
        "expression": found.expression,
        "left_hand_pose": hands[0],
        "right_hand_pose": hands[1],
    }
    tensors = {
        name: torch.as_tensor(value[fill], dtype=torch.float32) for name, value in values.items()
    }
    shape = torch.as_tensor(betas, dtype=torch.float32)[None]
    return BodyParameters(betas=shape, **tensors)


def _shape_varies(model: BodyModel, betas: np.ndarray, median: np.ndarray) -> float:
    """How far the skin of the T-pose is from that of the median shape, at most, metres."""
    far = betas[np.abs(betas - median).max(axis=1).argmax()]
    if np.allclose(far, median, atol=1e-6):
        return 0.0
    skins = []
    for shape in (far, median):
        rest = model.zeros(1)
        rest.betas = torch.as_tensor(shape, dtype=model.dtype)[None]
        with torch.no_grad():
            skins.append(model.forward(rest).vertices[0].numpy())
    return float(np.linalg.norm(skins[0] - skins[1], axis=1).max())


def _residuals(person: Path, rig: Rig, keypoints: np.ndarray) -> np.ndarray:
    """Median reprojection error (T, C) px of keypoints (T, 135, 3); NaN = not seen."""
    with artefacts.read(person, PERSON) as artefact:
        seen = artefact["keypoints"]
    found = np.full(seen.shape[:2], np.nan, np.float32)
    for c, camera in enumerate(rig):
        pixels = camera.colour.project(apply(invert(camera.master_from_colour), keypoints))
        away = np.linalg.norm(pixels - seen[:, c, :, :2], axis=-1)
        away[seen[:, c, :, 2] < _LEAST_CONFIDENCE] = np.nan
        some = np.isfinite(away).any(axis=1)
        found[some, c] = np.nanmedian(away[some], axis=1)
    return found
