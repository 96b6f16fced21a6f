"""Inputs of the joint fit, read from the artefacts of earlier stages."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from intercap_core import artefacts
from intercap_core.artefacts import Artefact
from intercap_core.body.artefact import load_model, load_pose_prior
from intercap_core.body.lemo import FEWEST_FRAMES, FRAMES_PER_SECOND, MotionEncoder
from intercap_core.body.model import BodyModel
from intercap_core.body_fit.observations import read_observations
from intercap_core.config import JointSettings
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.rigid.distance import DistanceField, SurfacePart
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.thread_pool import ThreadPool, threads_of_job
from intercap_core.joint.cameras import BIAS, CameraFit, Cameras
from intercap_core.joint.floor import FloorPlane, contradiction
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.sequential import SequentialFits
from intercap_core.joint.skin import contact_patches
from intercap_core.joint.state import State
from intercap_core.joint.terms.body_data import BodyData
from intercap_core.joint.terms.object_images import ObjectImages
from intercap_core.object_track.recording import ObjectRecording
from intercap_core.schemas import BODY_FIT, OBJECT_TRACK, SCENE
from intercap_core.sequence_inputs import FitSettings, SequenceModels, SequencePaths


@dataclass(frozen=True, eq=False)
class JointInputs:
    """The sequential fits of a recording, and the data that they were fitted to."""

    frames: slice  # The T frames of the recording
    geometry: Geometry  # Meshes of body and object
    sequential: SequentialFits  # Body fit and object track
    load_body_data: Callable[[State, slice], BodyData]  # Reads E_B of bodies in some frames
    images: ObjectImages | None  # None without an object or without ``look_again``
    floor: FloorPlane | None  # The scene's floor, if it has one
    against_floor: str  # Why the recording's sequential fits contradict the floor; "" if they don't
    time_offset: np.ndarray  # (C,) the scene's time offsets, seconds
    time_offset_sigma: np.ndarray  # (C,) standard deviations, seconds; NaN if not estimated
    cameras_of_person: np.ndarray  # (C,) cameras that show the body in any usable frame
    cameras: CameraFit  # The scene's cameras and their covariance
    encoder: MotionEncoder | None  # LEMO's motion encoder, if the settings name its weights
    fps: float  # Frames per second
    threads: ThreadPool  # Threads that compute rows and compare images
    attributes: dict[str, object]  # Sequence, gender and body model of the body fit

    @cached_property
    def body_data(self) -> BodyData:
        """E_B over keypoints and clouds, which are read on first use."""
        return self.load_body_data(self.sequential.state, self.frames)

    def window(self, frames: slice) -> JointInputs:
        """The inputs of frames ``start`` to ``stop`` of these.

        Data of the body are read anew. What follows from the whole recording stays: usable frames,
        median confidences, smoothed hands, the contradiction of the floor.
        """
        first = self.frames.start
        return replace(
            self,
            frames=slice(first + frames.start, first + frames.stop),
            sequential=self.sequential.window(frames),
            images=self.images and self.images.window(frames),
        )

    @property
    def model(self) -> BodyModel:
        """The body model."""
        return self.geometry.model


@contextmanager
def open_inputs(
    paths: SequencePaths, models: SequenceModels, fit_settings: FitSettings
) -> Iterator[JointInputs]:
    """Open the inputs of the joint fit for a ``with`` block, in which images are read.

    An object whose track is lost in all frames counts as absent. Raises UserError if an artefact or
    the mesh cannot be used.
    """
    settings, object_, body_models = fit_settings.joint, models.object_, models.body_models
    mesh: ObjectMesh | None = None
    if object_ is not None:
        problem = settings.check_object(object_)
        if problem:
            raise UserError(problem)
        mesh = ObjectMesh.load(object_)
    with (
        artefacts.read(paths.body_fit, BODY_FIT) as body,
        artefacts.read(paths.object_track, OBJECT_TRACK) as track,
        artefacts.read(paths.scene, SCENE) as scene,
    ):
        model = load_model(body_models, str(body.attributes["gender"]), body)
        encoder = _motion_encoder(settings, scene, model)
        sequential = SequentialFits.read(body, track, scene)
        attributes = {name: body.attributes[name] for name in ("sequence", "gender", "body_model")}
        fps = float(scene.attributes["fps"])
        floor = None
        if scene.attributes["ground_found"]:
            floor = FloorPlane(scene["ground_point"], scene["ground_normal"])
        time_offset, time_offset_sigma = scene["time_offset"], scene["time_offset_sigma"]
        cameras = read_cameras(scene)
    if sequential.tracked is None:
        mesh = None
    geometry = _geometry(model, mesh, settings)
    against_floor = contradiction(geometry, sequential, floor) if floor else ""
    observations = read_observations(paths.scene, paths.person)
    pose_prior = load_pose_prior(body_models, model)

    def load_body_data(state: State, frames: slice) -> BodyData:
        return BodyData.load(
            paths,
            observations,
            model=model,
            state=state,
            frames=frames,
            settings=fit_settings.body_fit,
            fps=fps,
            pose_prior=pose_prior,
        )

    threads = ThreadPool(threads_of_job())
    # one BLAS thread: small matrix products gain nothing from more, and would block ``threads``
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
            frames=slice(0, len(sequential.state)),
            geometry=geometry,
            sequential=sequential,
            load_body_data=load_body_data,
            images=images,
            floor=floor,
            against_floor=against_floor,
            time_offset=time_offset,
            time_offset_sigma=time_offset_sigma,
            cameras_of_person=observations.cameras_of_person,
            cameras=cameras,
            encoder=encoder,
            fps=fps,
            threads=threads,
            attributes=attributes,
        )


def _geometry(model: BodyModel, mesh: ObjectMesh | None, settings: JointSettings) -> Geometry:
    """Build the geometry; contact draws to the part of the object that ``contact_to`` names."""
    patches = contact_patches(model)
    if mesh is None:
        return Geometry(model, None, None, patches)
    field = DistanceField(mesh.vertices, mesh.faces, watertight=mesh.watertight)
    touched = None
    if settings.contact_to == "annotated":
        touched = SurfacePart(field, mesh.vertices, mesh.faces, mesh.contact_vertices)
    return Geometry(model, mesh, field, patches, touched)


def _motion_encoder(
    settings: JointSettings, scene: Artefact, model: BodyModel
) -> MotionEncoder | None:
    """The encoder of the learned E_S, if the settings name its weights.

    Raises UserError for unusable files and for recordings that the encoder was not trained for.
    """
    if settings.lemo_files is None:
        return None
    frames, fps = len(scene["times"]), float(scene.attributes["fps"])
    problem = ""
    if frames < FEWEST_FRAMES:
        problem = f"has {frames} frames, and LEMO's encoder needs {FEWEST_FRAMES} or more"
    elif abs(fps / FRAMES_PER_SECOND - 1) > 0.1:  # walking speeds in LEMO's data differ by more
        problem = (
            f"has {fps:g} frames a second, and LEMO's encoder knows steps of motion at "
            f"{FRAMES_PER_SECOND:g}"
        )
    elif not scene.attributes["ground_found"]:
        problem = "has no ground, and LEMO's encoder must know what is up; annotate the ground"
    if problem:
        raise UserError(
            f"{scene.path}: sequence {scene.attributes['sequence']!r} {problem}; or remove "
            "joint.lemo to penalise joint accelerations instead"
        )
    weights, statistics = settings.lemo_files
    # double precision: E_S is a small difference of large latents, and GPU convolutions in single
    # precision may round to ten bits
    return MotionEncoder.load(weights, statistics, dtype=torch.float64)


def read_cameras(scene: Artefact) -> CameraFit:
    """The scene's cameras with their covariance, 0 for absent cameras and unknown depth biases.

    Raises UserError if the covariance is not positive definite.
    """
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
