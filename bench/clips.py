"""Recordings in memory as the object's tracker, the body's fit and the joint stage see them.

Each clip also holds the truth. It reads the artefacts of the stages before the measured stage, so
that the comparisons with the paper's recipes do not time the decoding of images.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from intercap_core import artefacts
from intercap_core.body.artefact import load_model, load_pose_prior
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.model import BodyModel
from intercap_core.body_fit.clouds import PersonCloud, person_clouds
from intercap_core.body_fit.observations import Observations, read_observations
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.body_fit.schedule import Fitter, Settled
from intercap_core.config import BodyFitSettings, JointSettings, ObjectTrackSettings
from intercap_core.errors import UserError
from intercap_core.evaluation import object_pose
from intercap_core.evaluation.body import vertex_error
from intercap_core.evaluation.truth import Truth
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.transforms import apply_step, rigid
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.joint.contact.detect import contact_probability, region_motion
from intercap_core.joint.floor import FloorPlane
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.sequential import SequentialFits
from intercap_core.joint.skin import contact_patches
from intercap_core.joint.state import State
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.recording import TRACKING_FACES, ObjectRecording
from intercap_core.object_track.view import View
from intercap_core.project import Project
from intercap_core.schemas import BODY_FIT, JOINT, OBJECT_TRACK, SCENE

# Error of an annotated pose, rotation (rad) and translation (m), as in the evaluation's annotations
ANNOTATION_ERROR = np.concatenate([np.radians(5) * np.ones(3), 0.010 * np.ones(3)]) / np.sqrt(3)
SEEN_VIEWS = 2  # frames that fewer truly see are not counted, as in the evaluation


@dataclass(frozen=True, eq=False)
class ObjectClip:
    """T consecutive frame sets with C views each, as the object's tracker reads them."""

    whole: ObjectMesh  # the object's mesh
    mesh: ObjectMesh  # the simplified mesh that is tracked
    views: list[list[View]]  # T lists of C
    times: np.ndarray  # (T,) seconds
    up: np.ndarray | None  # (3,) normal of the floor; None if unknown
    joints: np.ndarray  # (T, 135, 3) triangulated keypoints
    labels: tuple[str, ...]  # detector labels of the object
    settings: ObjectTrackSettings
    true_rotation: np.ndarray  # (T, 3, 3) master_from_object
    true_translation: np.ndarray  # (T, 3)
    true_views: np.ndarray  # (T,) number of cameras that truly see the object

    @classmethod
    def load(cls, project: Project, sequence: str, count: int) -> ObjectClip:
        """``count`` frame sets from the first in which two cameras truly see the object.

        Raises UserError if the sequence has no truth or an artefact is missing.
        """
        row = project.sequences[sequence]
        if row.truth is None:
            raise UserError(f"sequence {sequence} has no truth; measure a virtual recording")
        entry = project.objects[row.object]
        whole = ObjectMesh.load(entry)
        with Frames.open(project.artefact(sequence, "frames")) as frames:
            source = ObjectRecording(
                frames,
                Detections.load(project.artefact(sequence, "detections")),
                project.artefact(sequence, "scene"),
                project.artefact(sequence, "person"),
                whole.diameter,
            )
            truth = Truth.load(row.truth, frames.time_s, frames.fps, 0)
            first = int(np.argmax(truth.object_views >= SEEN_VIEWS))
            kept = slice(first, min(first + count, frames.num_sets))
            views = [source.views(t) for t in range(kept.start, kept.stop)]
            return cls(
                whole,
                whole.simplified(TRACKING_FACES),
                views,
                frames.time_s[kept],
                source.up if np.isfinite(source.up).all() else None,
                source.joints[kept],
                entry.labels,
                project.config.object_track,
                truth.rotation[kept],
                truth.translation[kept],
                truth.object_views[kept],
            )

    def __len__(self) -> int:
        return len(self.views)

    @property
    def annotated(self) -> np.ndarray:
        """The first frame's pose (4, 4) with the error of an annotation: 10 mm and 5 degrees."""
        pose = rigid(self.true_rotation[0], self.true_translation[0])
        return apply_step(pose, ANNOTATION_ERROR)

    @property
    def step_s(self) -> float:
        """Seconds between frames."""
        return float(np.median(np.diff(self.times)))

    def observer(self) -> Observer:
        """The observer of one pass of the tracker over the images."""
        labels = [[[k.label for k in view.candidates] for view in views] for views in self.views]
        return Observer(
            self.mesh,
            self.views.__getitem__,
            labels,
            self.settings,
            self.times,
            labels=self.labels,
            up=self.up,
            joints=self.joints,
        )

    def errors(self, poses: np.ndarray, frames: np.ndarray | int) -> tuple[np.ndarray, np.ndarray]:
        """Errors (...) of poses (..., 4, 4) in the given frames, millimetres and degrees."""
        centre = self.whole.centre_of_mass
        rotation = np.broadcast_to(self.true_rotation[frames], (*poses.shape[:-2], 3, 3))
        fitted = object_pose.posed_point(poses[..., :3, :3], poses[..., :3, 3], centre)
        true = object_pose.posed_point(rotation, self.true_translation[frames], centre)
        turned = self.mesh.symmetry.rotation_error_deg(poses[..., :3, :3], rotation)
        return 1e3 * np.linalg.norm(fitted - true, axis=-1), turned

    @cached_property
    def seen(self) -> np.ndarray:
        """Mask (T,) of the frames that are evaluated: two cameras truly see the object."""
        return self.true_views >= SEEN_VIEWS


def _load_truth(project: Project, sequence: str, seen: Observations, model: BodyModel) -> Truth:
    """Truth at the times of the observations; raises UserError if it has no skin for the model."""
    path = project.sequences[sequence].truth
    with artefacts.read(project.artefact(sequence, "scene"), SCENE) as scene:
        fps = float(scene.attributes["fps"])
    truth = path and Truth.load(path, seen.times, fps, model.num_vertices)
    if truth is None or truth.vertices is None:
        raise UserError(
            f"sequence {sequence} has no true skin for {model.path}; measure a virtual "
            "recording with the body model that it was made for"
        )
    return truth


_CHUNK = 32  # bodies posed at once


@dataclass(frozen=True, eq=False)
class BodyClip:
    """T consecutive frame sets, as the body's fit reads them."""

    model: BodyModel
    seen: Observations
    clouds: list[PersonCloud | None]  # T entries
    settings: BodyFitSettings
    true_vertices: np.ndarray  # (T, V, 3) true skin at the model's vertices, metres, master frame

    @classmethod
    def load(cls, project: Project, sequence: str) -> BodyClip:
        """All frame sets of a sequence.

        Raises UserError if it has no truth for this body model or an artefact is missing.
        """
        row = project.sequences[sequence]
        gender = project.subjects[row.subject].gender
        model = BodyModel.load(project.config.body_models.of(gender) or OPEN_BODY)
        settings = project.config.body_fit
        frames, scene, person = (
            project.artefact(sequence, stage) for stage in ("frames", "scene", "person")
        )
        seen = read_observations(scene, person)
        truth = _load_truth(project, sequence, seen, model)
        clouds = list(person_clouds(frames, person, seen, settings.points_per_frame))
        assert truth.vertices is not None
        return cls(model, seen, clouds, settings, truth.vertices)

    def __len__(self) -> int:
        return len(self.clouds)

    def part(self, frames: slice) -> BodyClip:
        """A clip of some of the frames."""
        return replace(
            self,
            seen=self.seen.window(frames),
            clouds=self.clouds[frames],
            true_vertices=self.true_vertices[frames],
        )

    def errors(self, vectors: Tensor, frames: np.ndarray, *, step: int = 1) -> np.ndarray:
        """PVE (N,) of bodies (N, P) in ``frames`` (N,) over every step-th vertex, millimetres."""
        ids = np.arange(0, self.model.num_vertices, step)
        found = []
        for start in range(0, len(vectors), _CHUNK):
            at = slice(start, start + _CHUNK)
            chosen = None if step == 1 else ids
            params = self.model.parameters(vectors[at])
            with torch.no_grad():
                vertices = self.model.forward(params, vertex_ids=chosen).vertices
            true = self.true_vertices[frames[at]][:, ids]
            found.append(1e3 * vertex_error(vertices.cpu().numpy(), true))
        return np.concatenate(found)


SURE = 0.5  # probability above which a region is in contact
_SETTLED = ("keypoint_offsets", "covering", "keypoint_sigma", "covering_noise", "keypoint_doubt")
_POSE = (
    "global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose", "left_hand_pose",
    "right_hand_pose", "transl",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class BodyEvidence:
    """The observations of E_B, with the noise constants that the body's fit has estimated."""

    fitter: Fitter  # computes the correspondences of ``problem``
    problem: BodyProblem


@dataclass(frozen=True, eq=False)
class JointClip:
    """T frame sets with C views each, as the joint stage reads them."""

    geometry: Geometry
    start: State  # state of the sequential fits
    body: BodyEvidence
    tracked: ObjectMesh  # simplified mesh of the object
    views: list[list[View]]  # T lists of C, evidence of E_O
    labels: tuple[str, ...]  # detector labels of the object
    object_settings: ObjectTrackSettings
    touching: np.ndarray  # (T, R) regions in contact at the start, by the stage's detection
    floor: FloorPlane | None
    fps: float
    settings: JointSettings
    truth: Truth

    @classmethod
    def load(cls, project: Project, sequence: str) -> JointClip:
        """All frame sets of a sequence.

        Raises UserError if it has no truth for its body model, an artefact is missing or a frame
        has no person.
        """
        row = project.sequences[sequence]
        paths = {
            name: project.artefact(sequence, name)
            for name in ("frames", "detections", "scene", "person", "object_track", "body_fit")
        }
        mesh = ObjectMesh.load(project.objects[row.object])
        settings, models = project.config.body_fit, project.config.body_models
        with (
            artefacts.read(paths["body_fit"], BODY_FIT) as fitted,
            artefacts.read(paths["object_track"], OBJECT_TRACK) as track,
            artefacts.read(paths["scene"], SCENE) as scene,
        ):
            model = load_model(models, str(fitted.attributes["gender"]), fitted)
            sequential = SequentialFits.read(fitted, track, scene)
            settled = Settled(*(torch.from_numpy(fitted[name]) for name in _SETTLED))
            failed = fitted["failed"]
            found = bool(scene.attributes["ground_found"])
            floor = FloorPlane(scene["ground_point"], scene["ground_normal"]) if found else None
            fps = float(scene.attributes["fps"])
        seen = read_observations(paths["scene"], paths["person"])
        clouds = list(
            person_clouds(paths["frames"], paths["person"], seen, settings.points_per_frame)
        )
        fitter = Fitter(model, seen, clouds, settings, load_pose_prior(models, model))
        start = sequential.state
        if failed.any() or len(fitter.frames) != len(start):
            raise UserError(f"{sequence}: frames without a person cannot be compared")
        problem = fitter.resume(start.parameters(model).vector(), settled)
        problem.columns = torch.arange(start.body.shape[1])
        field = DistanceField(mesh.vertices, mesh.faces, watertight=mesh.watertight)
        geometry = Geometry(model, mesh, field, contact_patches(model))
        truth = _load_truth(project, sequence, seen, model)
        with Frames.open(paths["frames"]) as frames:
            source = ObjectRecording(
                frames, Detections.load(paths["detections"]), paths["scene"], paths["person"],
                mesh.diameter,
            )  # fmt: skip
            views = [source.views(t) for t in range(len(start))]
        return cls(
            geometry, start, BodyEvidence(fitter, problem), mesh.simplified(TRACKING_FACES), views,
            project.objects[row.object].labels, project.config.object_track,
            _touching_regions(geometry, sequential, fps), floor, fps, project.config.joint, truth,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.start)

    def errors(self, state: State) -> JointErrors:
        """Errors of ``state`` against the truth."""
        model, true = self.geometry.model, self.truth
        assert true.vertices is not None
        with torch.no_grad():
            vertices = model(state.parameters(model)).vertices.numpy()
        centre = self.geometry.mesh.centre_of_mass
        fitted = object_pose.posed_point(state.rotation, state.translation, centre)
        truly = object_pose.posed_point(true.rotation, true.translation, centre)
        apart = np.linalg.norm(fitted - truly, axis=-1)
        return JointErrors(
            1e3 * float(vertex_error(vertices, true.vertices).mean()),
            1e3 * float(apart[true.object_views >= SEEN_VIEWS].mean()),
        )


@dataclass(frozen=True)
class JointErrors:
    """Errors of body and object, millimetres."""

    pve: float  # mean over frames and vertices
    object_: float  # mean error of the centre of mass over the frames with enough views

    @property
    def mean(self) -> float:
        """Mean of both errors, by which states are compared."""
        return (self.pve + self.object_) / 2


def read_state(joint: Path) -> State:
    """The state that the joint stage has written."""
    with artefacts.read(joint, JOINT) as found:
        body = np.concatenate([found[name] for name in _POSE], axis=1).astype(float)
        return State(
            body, found["betas"].astype(float), found["expression"].astype(float),
            found["rotation"], found["translation"],
        )  # fmt: skip


def _touching_regions(geometry: Geometry, sequential: SequentialFits, fps: float) -> np.ndarray:
    """Mask (T, R) of the regions in contact in the sequential fits, by the stage's detection."""
    state = sequential.state
    posed, at_patch = geometry.at(state), geometry.skin.patch
    motion = region_motion(
        geometry.patches, posed.skin[:, at_patch], posed.proximity.at(at_patch), state.rotation,
        state.translation, sequential.joint_sigma, sequential.object_sigma, fps,
    )  # fmt: skip
    given = np.zeros((len(state), int(geometry.patches.region.max()) + 1))
    return contact_probability(motion, fps, given=given) > SURE
