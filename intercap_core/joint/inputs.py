"""What the joint fit works on, read from the artefacts of the stages before it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from intercap_core import artefacts
from intercap_core.artefacts import Artefact
from intercap_core.body.artefact import load_model, load_pose_prior
from intercap_core.body.lemo import FEWEST_FRAMES, FRAMES_PER_SECOND, MotionEncoder
from intercap_core.body.model import BodyModel
from intercap_core.config import JointSettings, ObjectEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.rigid.distance import DistanceField, SurfacePart
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.joint.cameras import BIAS, CameraFit, Cameras
from intercap_core.joint.floor import Ground
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.sequential import SequentialFits
from intercap_core.joint.skin import contact_patches
from intercap_core.joint.terms.body_data import BodyData
from intercap_core.joint.terms.motion import LearnedMotion
from intercap_core.joint.terms.object_images import ObjectImages
from intercap_core.joint.time_offsets import OffsetPrior
from intercap_core.object_track.recording import ObjectRecording
from intercap_core.schemas import BODY_FIT, OBJECT_TRACK, SCENE
from intercap_core.sequence_inputs import FitSettings, SequenceModels, SequencePaths

# A recording whose rate differs by more than this share from that of a learned prior shows it other
# motion: AMASS, on which LEMO's was trained, holds walks that differ by more among themselves.
MAX_RATE_ERROR = 0.1


@dataclass(frozen=True, eq=False)
class JointInputs:
    """The sequential fits with what they were fitted to.

    ``images`` is None where the settings do not look again or there is no object, ``floor`` where
    none was seen, ``motion`` without a learned E_S. ``cameras`` are the scene's, with what is known
    of them. ``attributes``: sequence, gender and body model of the body's fit.
    """

    geometry: Geometry
    sequential: SequentialFits
    body_data: BodyData
    images: ObjectImages | None
    floor: Ground | None
    prior: OffsetPrior
    cameras: CameraFit
    motion: LearnedMotion | None
    fps: float
    threads: ThreadPool
    attributes: dict[str, object]

    @property
    def model(self) -> BodyModel:
        """The body."""
        return self.geometry.model


@contextmanager
def open_inputs(
    paths: SequencePaths,
    models: SequenceModels,
    fit_settings: FitSettings,
    device: str = "cpu",
) -> Iterator[JointInputs]:
    """Open the inputs of the joint fit for a ``with`` block, in which images are read.

    An object whose track is lost in all frames is treated as absent. Raises UserError if an
    artefact or the mesh cannot be used.
    """
    settings, object_, body_models = fit_settings.joint, models.object_, models.body_models
    mesh = _mesh(object_, settings)
    with (
        artefacts.read(paths.body_fit, BODY_FIT) as body,
        artefacts.read(paths.object_track, OBJECT_TRACK) as track,
        artefacts.read(paths.scene, SCENE) as source,
    ):
        model = load_model(body_models, str(body.attributes["gender"]), body, device=device)
        encoder = _motion_encoder(settings, source, model)
        sequential = SequentialFits.read(body, track, source)
        attributes = {name: body.attributes[name] for name in ("sequence", "gender", "body_model")}
        fps = float(source.attributes["fps"])
        body_data = BodyData.load(
            frames=paths.frames,
            scene=paths.scene,
            person=paths.person,
            body_fit=body,
            model=model,
            state=sequential.state,
            settings=fit_settings.body_fit,
            fps=fps,
            pose_prior=load_pose_prior(body_models, model),
        )
        floor, prior = _floor(source), _offset_prior(source)
        cameras = read_cameras(source)
        up = source["ground_normal"]
    if sequential.tracked is None:
        mesh = None
    geometry = _geometry(model, mesh, settings)
    motion = None
    if encoder is not None:
        motion = LearnedMotion(geometry, encoder, up, settings.body_smoothness)
    threads = ThreadPool(torch.get_num_threads() if model.device.type == "cpu" else 1)
    # numpy divides its products among threads too; small ones gain nothing by that, and those of
    # two threads would wait for each other
    with Frames.open(paths.frames) as recording, threadpool_limits(1, user_api="blas"):
        images = None
        if settings.look_again and object_ is not None and mesh is not None:
            seen = ObjectRecording(
                recording,
                Detections.load(paths.detections),
                paths.scene,
                paths.person,
                mesh.diameter,
            )
            images = ObjectImages(seen, mesh, fit_settings.object_track, object_.labels, threads)
        yield JointInputs(
            geometry,
            sequential,
            body_data,
            images,
            floor,
            prior,
            cameras,
            motion,
            fps,
            threads,
            attributes,
        )


def _mesh(entry: ObjectEntry | None, settings: JointSettings) -> ObjectMesh | None:
    """The object's, None for a person alone; raises UserError where it cannot be used."""
    if entry is None:
        return None
    problem = settings.check_object(entry)
    if problem:
        raise UserError(problem)
    return ObjectMesh.load(entry)


def _geometry(model: BodyModel, mesh: ObjectMesh | None, settings: JointSettings) -> Geometry:
    patches = contact_patches(model)
    if mesh is None:
        return Geometry(model, None, None, patches)
    field = DistanceField(mesh.vertices, mesh.faces, watertight=mesh.watertight)
    return Geometry(model, mesh, field, patches, _touched(mesh, field, settings))


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


def read_cameras(scene: Artefact) -> CameraFit:
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
