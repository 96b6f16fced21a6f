"""A recording, in memory, as the joint stage sees it, and its truth.

Reads the artefacts of the stages before ``joint``; what is decoded here is not timed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.body.artefact import load_model, load_pose_prior
from intercap_core.body_fit.body_samples import choose_samples
from intercap_core.body_fit.observations import person_clouds, read_observations
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.body_fit.schedule import Fitter, Settled
from intercap_core.body_fit.torch_terms import TorchTerms
from intercap_core.config import JointSettings, ObjectTrackSettings
from intercap_core.errors import UserError
from intercap_core.evaluation import object_pose
from intercap_core.evaluation.body import vertex_error
from intercap_core.evaluation.truth import Truth
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.joint.contact.detect import contact_probability
from intercap_core.joint.contact.motion import region_motion
from intercap_core.joint.contact.patches import contact_patches
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.sequential import SequentialFits
from intercap_core.joint.state import State
from intercap_core.joint.terms.ground import Ground
from intercap_core.object_track.constants import TRACKING_FACES
from intercap_core.object_track.view import View
from intercap_core.project import Project
from intercap_core.schemas import BODY_FIT, JOINT, OBJECT_TRACK, SCENE
from intercap_core.stages.object_track import ObjectRecording

SEEN_VIEWS = 2  # frames in which fewer truly see the object are not counted, as in the evaluation
SURE = 0.5  # probability over which a region touches
_SETTLED = ("keypoint_offsets", "covering", "keypoint_sigma", "covering_noise", "keypoint_doubt")
_POSE = (
    "global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose", "left_hand_pose",
    "right_hand_pose", "transl",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class BodyEvidence:
    """E_B: ``fitter`` takes correspondences of ``problem``, whose terms are plain torch and whose
    constants are those that the body's fit has settled."""

    fitter: Fitter
    problem: BodyProblem


@dataclass(frozen=True, eq=False)
class JointClip:
    """T frame sets with C views each; ``start`` is the state of the sequential fits.

    ``tracked`` is the object's mesh with fewer faces, ``views`` what E_O compares it with;
    ``touching`` (T, R) the regions that touch at the start by the stage's own detection.
    """

    geometry: Geometry
    start: State
    body: BodyEvidence
    tracked: ObjectMesh
    views: list[list[View]]
    labels: tuple[str, ...]
    object_settings: ObjectTrackSettings
    touching: np.ndarray
    floor: Ground | None
    fps: float
    settings: JointSettings
    truth: Truth

    @classmethod
    def load(cls, project: Project, sequence: str) -> JointClip:
        """All frame sets of a sequence.

        Raises UserError where it has no truth for its body model, an artefact is missing or a frame
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
            model = load_model(models, str(fitted.attributes["gender"]), fitted, device="cpu")
            sequential = SequentialFits.read(fitted, track, scene)
            settled = Settled(*(torch.from_numpy(fitted[name]) for name in _SETTLED))
            failed = fitted["failed"]
            found = bool(scene.attributes["ground_found"])
            floor = Ground(scene["ground_point"], scene["ground_normal"]) if found else None
            fps = float(scene.attributes["fps"])
        seen = read_observations(paths["scene"], paths["person"])
        clouds = person_clouds(paths["frames"], seen, settings.points_per_frame, model.device)
        terms = TorchTerms(model, choose_samples(model))
        fitter = Fitter(model, seen, clouds, settings, load_pose_prior(models, model), terms)
        start = sequential.state
        if failed.any() or len(fitter.frames) != len(start):
            raise UserError(f"{sequence}: frames without a person cannot be compared")
        problem = fitter.resume(start.parameters(model).vector(), settled)
        problem.columns = torch.arange(start.body.shape[1])
        field = DistanceField(mesh.vertices, mesh.faces, watertight=mesh.watertight)
        geometry = Geometry(model, mesh, field, contact_patches(model))
        truth = row.truth and Truth.load(row.truth, seen.times, fps, model.num_vertices)
        if truth is None or truth.vertices is None:
            raise UserError(
                f"sequence {sequence} has no true skin for {model.path}; measure a virtual "
                "recording with the body model that it was made for"
            )
        with Frames.open(paths["frames"]) as frames:
            source = ObjectRecording(
                frames, Detections.load(paths["detections"]), paths["scene"], paths["person"],
                mesh.diameter,
            )  # fmt: skip
            views = [source.views(t) for t in range(len(start))]
        return cls(
            geometry, start, BodyEvidence(fitter, problem), mesh.simplified(TRACKING_FACES), views,
            project.objects[row.object].labels, project.config.object_track,
            _touching(geometry, sequential, fps), floor, fps, project.config.joint, truth,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.start)

    def errors(self, state: State) -> Errors:
        """How far ``state`` is from the truth."""
        model, true = self.geometry.model, self.truth
        assert true.vertices is not None
        with torch.no_grad():
            vertices = model(state.parameters(model)).vertices.numpy()
        centre = self.geometry.mesh.centre_of_mass
        apart = object_pose.centre_error(
            object_pose.posed_point(state.rotation, state.translation, centre),
            object_pose.posed_point(true.rotation, true.translation, centre),
        )
        return Errors(
            1e3 * float(vertex_error(vertices, true.vertices).mean()),
            1e3 * float(apart[true.object_views >= SEEN_VIEWS].mean()),
        )


@dataclass(frozen=True)
class Errors:
    """Millimetres: ``pve`` the mean over frames and skin vertices; ``object_`` the mean over the
    frames that enough views see, at the centre of mass."""

    pve: float
    object_: float

    @property
    def mean(self) -> float:
        """Mean of the two: what a state is judged by."""
        return (self.pve + self.object_) / 2


def read_state(joint: Path) -> State:
    """The state that the joint stage has written."""
    with artefacts.read(joint, JOINT) as found:
        body = np.concatenate([found[name] for name in _POSE], axis=1).astype(float)
        return State(
            body, found["betas"].astype(float), found["expression"].astype(float),
            found["rotation"], found["translation"],
        )  # fmt: skip


def _touching(geometry: Geometry, sequential: SequentialFits, fps: float) -> np.ndarray:
    """(T, R) regions that touch where the sequential fits end, as the stage detects them."""
    state = sequential.state
    posed, at_patch = geometry.at(state), geometry.skin.patch
    motion = region_motion(
        geometry.patches, posed.skin[:, at_patch], posed.proximity.at(at_patch), state.rotation,
        state.translation, sequential.joint_sigma, sequential.object_sigma, fps,
    )  # fmt: skip
    given = np.zeros((len(state), int(geometry.patches.region.max()) + 1))
    return contact_probability(motion, fps, given=given) > SURE
