"""Stage joint: body and object refined together over all frames (equation 6).

One shape, the poses of body and object in every frame, contact detected or annotated. Starts where
the two sequential stages end. The energy's terms are listed in :mod:`intercap_core.joint.problem`.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from intercap_core import artefacts
from intercap_core.artefacts import Artefact
from intercap_core.body.artefact import load_model, load_pose_prior
from intercap_core.body.keypoints import LEFT_HAND, RIGHT_HAND
from intercap_core.body.lemo import FEWEST_FRAMES, FRAMES_PER_SECOND, MotionEncoder
from intercap_core.body.model import BodyModel
from intercap_core.camera.rig import Rig
from intercap_core.capture.frames import Frames
from intercap_core.config import (
    BodyFitSettings,
    BodyModels,
    ContactInterval,
    JointSettings,
    ObjectEntry,
    ObjectTrackSettings,
    SubjectEntry,
    digest,
)
from intercap_core.contact.patches import contact_patches
from intercap_core.detections.read import Detections
from intercap_core.errors import UserError
from intercap_core.joint.cameras import BIAS, CameraFit, Cameras
from intercap_core.joint.constants import FEW_HAND_VIEWS, MAX_RATE_ERROR
from intercap_core.joint.fit import JointFit, fit
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.object_images import ObjectImages
from intercap_core.joint.sequential import SequentialFits
from intercap_core.joint.state import State
from intercap_core.joint.terms.body_data import BodyData
from intercap_core.joint.terms.ground import Ground
from intercap_core.joint.terms.learned_motion import LearnedMotion
from intercap_core.joint.time_offsets import OffsetPrior
from intercap_core.object_track.recording import ObjectRecording
from intercap_core.rigid.distance import DistanceField, SurfacePart
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.schemas import BODY_FIT, CONTACT_REGIONS, JOINT, OBJECT_TRACK, PERSON, SCENE
from intercap_core.solve.thread_pool import ThreadPool

log = logging.getLogger(__name__)

_BODY_PARAMETERS = (
    "expression",
    "global_orient",
    "transl",
    "body_pose",
    "jaw_pose",
    "leye_pose",
    "reye_pose",
    "left_hand_pose",
    "right_hand_pose",
)


def run(
    *,
    frames: Path,
    scene: Path,
    detections: Path,
    person: Path,
    object_track: Path,
    body_fit: Path,
    output: Path,
    object_: ObjectEntry,
    subject: SubjectEntry,
    body_models: BodyModels,
    settings: JointSettings,
    body_settings: BodyFitSettings,
    track_settings: ObjectTrackSettings,
    contact: Sequence[ContactInterval] | None = None,
    device: str = "cpu",
) -> None:
    """Write joint.h5 from the sequential fits.

    ``body_settings`` say what the body fit had fitted, ``track_settings`` how the tracker compares
    images. ``contact`` are the annotated intervals,
    None where contact is to be detected from the geometry. Raises UserError where an artefact or
    the mesh cannot be used.
    """
    problem = settings.check_object(object_)
    if problem:
        raise UserError(problem)
    mesh = ObjectMesh.load(object_)
    with (
        artefacts.read(body_fit, BODY_FIT) as body,
        artefacts.read(object_track, OBJECT_TRACK) as track,
        artefacts.read(scene, SCENE) as source,
    ):
        model = load_model(body_models, str(body.attributes["gender"]), body, device=device)
        encoder = _motion_encoder(settings, source, model)
        sequential = SequentialFits.read(body, track, source)
        attributes = {name: body.attributes[name] for name in ("sequence", "gender", "body_model")}
        fps = float(source.attributes["fps"])
        body_data = BodyData.load(
            frames=frames,
            scene=scene,
            person=person,
            body_fit=body,
            model=model,
            state=sequential.state,
            settings=body_settings,
            fps=fps,
            pose_prior=load_pose_prior(body_models, model),
        )
        floor, prior = _floor(source), _offset_prior(source)
        cameras = _cameras(source)
        up = source["ground_normal"]
    field = DistanceField(mesh.vertices, mesh.faces, watertight=mesh.watertight)
    geometry = Geometry(model, mesh, field, contact_patches(model), _touched(mesh, field, settings))
    motion = None
    if encoder is not None:
        motion = LearnedMotion(geometry, encoder, up, settings.body_smoothness)
    threads = ThreadPool(torch.get_num_threads() if model.device.type == "cpu" else 1)
    # numpy divides its products among threads too; small ones gain nothing by that, and those of
    # two threads would wait for each other
    with Frames.open(frames) as recording, threadpool_limits(1, user_api="blas"):
        images = None
        if settings.refine_cameras and not settings.look_again:
            log.warning("refine_cameras needs look_again: the cameras stay as the scene has them")
        if settings.look_again:
            seen = ObjectRecording(
                recording, Detections.load(detections), scene, person, mesh.diameter
            )
            images = ObjectImages(seen, mesh, track_settings, object_.labels, threads)
        fitted = fit(
            geometry,
            sequential,
            body_data,
            floor=floor,
            fps=fps,
            prior=prior,
            settings=settings,
            intervals=contact,
            images=images,
            cameras=cameras if images and settings.refine_cameras else None,
            motion=motion,
            threads=threads,
        )
    for odd in fitted.contact.oddities:
        first, last = odd.frames.start, max(odd.frames.start, odd.frames.stop - 1)
        log.warning(
            "sequence %s, frames %d to %d: %s", attributes["sequence"], first, last, odd.text
        )
    with artefacts.write(
        output,
        JOINT,
        settings_digest=digest(settings),
        subject=subject.subject,
        object=object_.name,
        iterations=fitted.steps,
        refused=fitted.refused,
        converged=fitted.converged,
        cameras_corrected=fitted.cameras,
        **attributes,
    ) as writer:
        _put_body(writer, model, fitted.state)
        _put(writer, fitted)
        writer.put("hand_undetermined", sequential.flags.hands | _hands_of_few_views(person))
        _put_cameras(writer, cameras)


def _motion_encoder(
    settings: JointSettings, scene: Artefact, model: BodyModel
) -> MotionEncoder | None:
    """The learned E_S that the settings name; None = small accelerations of the joints.

    Raises UserError for files that hold none and for recordings that it is not for.
    """
    if settings.lemo_files is None:
        return None
    frames, fps = len(scene["times"]), float(scene.attributes["fps"])
    problem = ""
    if frames < FEWEST_FRAMES:
        problem = f"has {frames} frames, and LEMO's encoder needs {FEWEST_FRAMES} or more"
    elif abs(fps / FRAMES_PER_SECOND - 1) > MAX_RATE_ERROR:
        problem = (
            f"has {fps:g} frames a second, and LEMO's encoder knows steps of motion at "
            f"{FRAMES_PER_SECOND:g}"
        )
    elif not scene.attributes["ground_found"]:
        problem = "has no ground, and LEMO's encoder must know what is up; annotate the ground"
    if problem:
        raise UserError(
            f"{scene.path}: sequence {scene.attributes['sequence']!r} {problem}; or leave "
            "joint.lemo out for small accelerations of the joints"
        )
    weights, statistics = settings.lemo_files
    # in double precision: E_S is a small difference of large latents, which a GPU's convolutions
    # round to ten bits otherwise
    return MotionEncoder.load(weights, statistics, device=model.device, dtype=torch.float64)


def _touched(mesh: ObjectMesh, field: DistanceField, settings: JointSettings) -> SurfacePart | None:
    """What contact draws skin to; None = any point of the object."""
    if settings.contact_to == "any":
        return None
    return SurfacePart(field, mesh.vertices, mesh.faces, mesh.contact_vertices)


def _floor(scene: Artefact) -> Ground | None:
    if not scene.attributes["ground_found"]:
        return None
    return Ground(scene["ground_point"], scene["ground_normal"])


def _offset_prior(scene: Artefact) -> OffsetPrior:
    master = scene.text("camera_names").index(str(scene.attributes["master"]))
    return OffsetPrior(scene["time_offset"], scene["time_offset_sigma"], master)


def _hands_of_few_views(person: Path) -> np.ndarray:
    """Left and right hands (T, 2) bool that few views see: most of their keypoints in two or
    fewer."""
    with artefacts.read(person, PERSON) as artefact:
        views = artefact["joint_views"]
    few = [np.median(views[:, hand], axis=1) <= FEW_HAND_VIEWS for hand in (LEFT_HAND, RIGHT_HAND)]
    return np.stack(few, axis=1)


def _cameras(scene: Artefact) -> CameraFit:
    """The scene's cameras and what is known of them."""
    start = Cameras(Rig.from_artefact(scene), scene["depth_bias"])
    covariance = scene["camera_covariance"]
    usable = scene["present"] & np.isfinite(start.rig.master_from_colour).all((1, 2))
    covariance[~usable] = 0
    covariance[:, :, ~usable] = 0
    covariance[~np.isfinite(start.depth_bias), BIAS] = 0
    covariance[:, :, ~np.isfinite(start.depth_bias), BIAS] = 0
    try:
        return CameraFit(start, covariance)
    except np.linalg.LinAlgError:
        raise UserError(
            f"{scene.path}: sequence {scene.attributes['sequence']}: camera_covariance is not "
            "positive definite; re-run stage 'scene' for this sequence"
        ) from None


def _put_cameras(writer: artefacts.Writer, cameras: CameraFit) -> None:
    writer.put("camera_names", list(cameras.now.rig.names))
    writer.put("master_from_colour", cameras.now.rig.master_from_colour)
    writer.put("depth_bias", cameras.now.depth_bias)
    writer.put("camera_covariance", cameras.covariance)


def _put_body(writer: artefacts.Writer, model: BodyModel, state: State) -> None:
    parameters = state.parameters(model)
    with torch.no_grad():
        joints = model(parameters, vertex_ids=np.array([0])).joints
    writer.put("betas", state.betas)
    for name in _BODY_PARAMETERS:
        writer.put(name, getattr(parameters, name).cpu().numpy())
    writer.put("joints", joints.cpu().numpy())


def _put(writer: artefacts.Writer, fitted: JointFit) -> None:
    """Write all but the body, in the order of the file."""
    before, after = fitted.energy_before, fitted.energy_after
    names = sorted(before.keys() | after.keys())
    writer.put("keypoint_residual", fitted.residuals.keypoint_px)
    writer.put("cloud_residual", fitted.residuals.cloud_m)
    writer.put("rotation", fitted.state.rotation)
    writer.put("translation", fitted.state.translation)
    writer.put("region_names", CONTACT_REGIONS)
    writer.put("contact_probability", fitted.contact.probability)
    writer.put("contact_annotated", fitted.contact.labels)
    writer.put("time_offset", fitted.time_offsets.offset)
    writer.put("time_offset_sigma", fitted.time_offsets.sigma)
    writer.put("energy_names", names)
    writer.put("energy_before", [before.get(name, 0.0) for name in names])
    writer.put("energy_after", [after.get(name, 0.0) for name in names])
    writer.put("flagged", np.array([bool(reason) for reason in fitted.flag_reasons]))
    writer.put("flag_reason", fitted.flag_reasons)
