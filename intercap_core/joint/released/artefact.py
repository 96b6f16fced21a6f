"""Write another program's results as joint.h5, in place of a joint fit."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.body.artefact import file_digest, put_parameters
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.errors import UserError
from intercap_core.flags import PARTS, Flags
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
from intercap_core.geometry.solve.time_series import nearest
from intercap_core.joint.released import behave, intercap
from intercap_core.schemas import CONTACT_REGIONS, JOINT, PERSON, SCENE
from intercap_core.sequence_inputs import SequenceModels, SequencePaths

log = logging.getLogger(__name__)


def read_results(path: Path, recording: Recording) -> Results:
    """Read a sequence's results, in InterCap's or BEHAVE's format.

    InterCap: a file, or a folder that holds one of its names. BEHAVE: a folder with frame folders
    ``t<seconds>`` or with parameters at 30 fps. Raises UserError if ``path`` is neither, or if the
    files cannot be used.
    """
    file = intercap_file(Path(path))
    if not file.is_dir():
        return intercap.read_results(file)
    at_30_fps = (BEHAVE_PERSON, BEHAVE_OBJECT)
    if any((file / name).is_file() for name in at_30_fps) or any(file.glob("t[0-9]*/")):
        return behave.read_results(file, recording)
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
    """Write joint.h5 from another program's results.

    The cameras are those of the calibration, to which the results refer, without corrections of
    stage ``scene``. Contact probabilities are NaN, and there are no energies. Frames without a
    result get the nearest result and are flagged.
    Raises UserError if the results have another number of frames, or more shape parameters than
    the body file.

    Args:
        betas: number of shape parameters of our body if it is fitted to another body's surface.
    """
    object_, subject = models.object_, models.subject
    body_file = models.body_models.of(subject.gender) or OPEN_BODY
    with artefacts.read(paths.scene, SCENE) as scene:
        total, sequence = len(scene["times"]), str(scene.attributes["sequence"])
        rig = Rig.from_artefact(scene).moved(scene["master_from_colour_start"])
        offsets, offset_sigma = scene["time_offset"], scene["time_offset_sigma"]
    with Frames.open(paths.frames) as frames:
        times = frames.first_set_s + frames.time_s
    released = read_results(results, Recording(sequence, times, object_, body_file, betas))
    if len(released) != total:
        raise UserError(
            f"{released.path}: holds {len(released)} frames, sequence {sequence!r} has {total}; "
            "name the results of this recording, or drop the same frames of both (drop_frames)"
        )
    known = released.known
    if not known.any():
        raise UserError(f"{released.path}: has no frame in which all numbers are finite")
    model = BodyModel.load(
        body_file, num_betas=released.betas.shape[1], num_expression=released.expression.shape[1]
    )
    used = nearest(np.flatnonzero(known), np.arange(total))
    shape = np.median(released.betas[known], axis=0)
    params = _body_parameters(released, model, used, shape)
    with torch.no_grad():
        posed = model.forward(params, vertex_ids=model.keypoint_map.vertex_ids)
        keypoints = model.keypoints(posed).double().numpy()
    missing = (~known, "no result in the imported file", PARTS)
    flags = released.flags or Flags.of(total, [missing], has_object=object_ is not None)
    variation = _shape_variation(model, released.betas[known], shape)
    if variation > 0.001:
        log.warning(
            "sequence %s: the shape in %s varies by frame; its median is used, which displaces the "
            "skin by up to %.0f mm",
            sequence, released.path, 1e3 * variation,
        )  # fmt: skip
    rotation, translation = released.rotation[used], released.translation[used]
    if object_ is None or not np.isfinite(released.translation).any():
        rotation, translation = np.full_like(rotation, np.nan), np.full_like(translation, np.nan)
        if object_ is not None:
            log.warning("sequence %s: %s has no poses of an object", sequence, released.path)
    count, regions = len(rig), len(CONTACT_REGIONS)
    with artefacts.write(
        output,
        JOINT,
        settings_digest=settings_digest,
        sequence=sequence,
        subject=subject.subject,
        object=object_.name if object_ else "",
        gender=subject.gender,
        body_model=file_digest(body_file),
        iterations=0,
        refused=0,
        converged=True,
        cameras_corrected=False,
        made_by=f"another program: {released.source}",
    ) as writer:
        put_parameters(writer, params, posed.joints.numpy(), betas=shape.astype(np.float32))
        writer.put("keypoint_residual", _keypoint_errors(paths.person, rig, keypoints))
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
        flags.write(writer)
        if released.surface_distance is not None:
            writer.put("surface_distance", released.surface_distance)


def _body_parameters(
    released: Results, model: BodyModel, frames: np.ndarray, betas: np.ndarray
) -> BodyParameters:
    """Parameters of ``frames`` (T,) with one shape ``betas`` (S,) and full hand poses."""
    hands = []
    for side, hand in enumerate(released.hands):
        if hand.shape[1] < intercap.FULL_HAND:
            basis = model.hand_components[side, : hand.shape[1]].numpy().astype(np.float64)
            hand = model.hand_mean[side].numpy().astype(np.float64) + hand @ basis
        hands.append(hand)
    values = {
        **released.turns,
        "transl": released.transl,
        "expression": released.expression,
        "left_hand_pose": hands[0],
        "right_hand_pose": hands[1],
    }
    tensors = {
        name: torch.as_tensor(value[frames], dtype=torch.float32) for name, value in values.items()
    }
    shape = torch.as_tensor(betas, dtype=torch.float32)[None]
    return BodyParameters(betas=shape, **tensors)


def _shape_variation(model: BodyModel, betas: np.ndarray, median: np.ndarray) -> float:
    """Largest distance between the T-poses of the ``median`` and the most different shape, metres.

    ``betas`` (T, S) are the shapes.
    """
    farthest = betas[np.abs(betas - median).max(axis=1).argmax()]
    if np.allclose(farthest, median, atol=1e-6):
        return 0.0
    skins = []
    for shape in (farthest, median):
        rest = model.zeros(1)
        rest.betas = torch.as_tensor(shape, dtype=model.dtype)[None]
        with torch.no_grad():
            skins.append(model.forward(rest).vertices[0].numpy())
    return float(np.linalg.norm(skins[0] - skins[1], axis=1).max())


def _keypoint_errors(person: Path, rig: Rig, keypoints: np.ndarray) -> np.ndarray:
    """Median reprojection error (T, C) of keypoints (T, 135, 3), pixels; NaN if none is detected.

    Keypoints with a confidence below 0.3 do not count.
    """
    with artefacts.read(person, PERSON) as artefact:
        detected = artefact["keypoints"]
    median = np.full(detected.shape[:2], np.nan, np.float32)
    for c, camera in enumerate(rig):
        pixels = camera.colour.project(apply(invert(camera.master_from_colour), keypoints))
        error = np.linalg.norm(pixels - detected[:, c, :, :2], axis=-1)
        error[detected[:, c, :, 2] < 0.3] = np.nan
        frames = np.isfinite(error).any(axis=1)
        median[frames, c] = np.nanmedian(error[frames], axis=1)
    return median
