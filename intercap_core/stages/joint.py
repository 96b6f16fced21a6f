"""Stage joint: body and object refined together over all frames (equation 6).

One shape, the poses of body and object in every frame, contact found or annotated. Starts where
the two sequential stages end.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.artefacts import Artefact
from intercap_core.body.artefact import load_model, load_pose_prior
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL
from intercap_core.config import (
    BodyFitSettings,
    BodyModels,
    ContactInterval,
    JointSettings,
    ObjectEntry,
    SubjectEntry,
    digest,
)
from intercap_core.contact.detect import annotation_evidence, contact_probability
from intercap_core.contact.motion import region_motion
from intercap_core.contact.patches import contact_patches
from intercap_core.joint.body_data import BodyData
from intercap_core.joint.minimise import minimise
from intercap_core.joint.object_data import TrackedPoses
from intercap_core.joint.problem import Ground, Problem
from intercap_core.joint.state import State
from intercap_core.joint.time_offsets import OffsetPrior
from intercap_core.rigid.distance import DistanceField
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.rigid.pose_interpolation import bridge_poses
from intercap_core.schemas import BODY_FIT, CONTACT_REGIONS, JOINT, OBJECT_TRACK, SCENE

log = logging.getLogger(__name__)

# Contact is estimated, the energy descended, and so on: the first round moves the most.
_ROUNDS = (6, 4, 3)
_SETTLED = 0.1  # largest change of a contact probability after which nothing new is to be learnt
_RETIMED_S = 0.001  # a change of the cameras' time offsets that the fit has to follow
_UNTRACKED_SIGMA = 0.5  # of the object's position where the track is lost, metres


@dataclass(frozen=True)
class _Contact:
    """``probability`` (T, R) and the ``labels`` (T, R) of the annotation, -1 where none."""

    probability: np.ndarray
    labels: np.ndarray


def run(
    *,
    frames: Path,
    scene: Path,
    person: Path,
    object_track: Path,
    body_fit: Path,
    output: Path,
    object_: ObjectEntry,
    subject: SubjectEntry,
    body_models: BodyModels,
    settings: JointSettings,
    body_settings: BodyFitSettings,
    contact: Sequence[ContactInterval] | None = None,
    device: str = "cpu",
) -> None:
    """Write joint.h5 from the sequential fits.

    ``body_settings`` say what the body fit had fitted. ``contact`` are the annotated intervals,
    None where contact is to be found from the geometry. Raises UserError where an artefact or the
    mesh cannot be used.
    """
    mesh = ObjectMesh.load(object_)
    with (
        artefacts.read(body_fit, BODY_FIT) as body,
        artefacts.read(object_track, OBJECT_TRACK) as track,
        artefacts.read(scene, SCENE) as source,
    ):
        start, model = _start(body, track, body_models, device)
        joint_sigma = body["joint_sigma"].astype(float)
        failed, bridged, uncertain = body["failed"], body["bridged"], body["uncertain"]
        lost, disagree, ambiguous = track["lost"], track["disagree"], track["ambiguous"]
        tracked = TrackedPoses.from_track(
            start.rotation,
            start.translation,
            track["covariance"],
            lost,
            disagree | ambiguous,
            track["resting"],
            seen=(track["candidate"] >= 0) | np.isfinite(track["depth_residual"]),
            times=source["times"],
            time_offset=source["time_offset"],
        )
        still = track["resting"][1:] & track["resting"][:-1]
        object_sigma = np.sqrt(np.trace(track["covariance"][:, 3:, 3:], axis1=1, axis2=2) / 3)
        object_sigma = np.where(lost | ~np.isfinite(object_sigma), _UNTRACKED_SIGMA, object_sigma)
        attributes = {name: body.attributes[name] for name in ("sequence", "gender", "body_model")}
        data = BodyData.load(
            frames=frames,
            scene=scene,
            person=person,
            body_fit=body,
            model=model,
            state=start,
            settings=body_settings,
            pose_prior=load_pose_prior(body_models, model),
        )
        floor = (
            Ground(source["ground_point"], source["ground_normal"])
            if source.attributes["ground_found"]
            else None
        )
        fps = float(source.attributes["fps"])
        master = source.text("camera_names").index(str(source.attributes["master"]))
        known_offsets = OffsetPrior(source["time_offset"], source["time_offset_sigma"], master)
    patches = contact_patches(model)
    problem = Problem(
        model=model,
        mesh=mesh,
        field=DistanceField(mesh.vertices, mesh.faces, watertight=mesh.watertight),
        patches=patches,
        data=(data.add, tracked.add),
        probability=np.zeros((len(start), len(CONTACT_REGIONS))),
        floor=floor,
        fps=fps,
        settings=settings,
        start=start,
        body_known=~failed,
        object_known=~lost,
        object_still=still,
    )

    state, steps = start, 0
    before: dict[str, float] = {}
    found = _contact(problem, state, contact, joint_sigma, object_sigma)
    for rounds in _ROUNDS:
        problem.probability = found.probability
        data.refresh(state)
        retimed = data.take_offsets(data.estimate_offsets(known_offsets).offset)  # seconds
        problem.data = (data.add, tracked.at(data.time_offset).add)
        problem.refresh(state)
        if not before:
            before = problem.equations(state).energy
        minimum = minimise(problem.equations, state, max_steps=rounds)
        state, steps = minimum.state, steps + minimum.steps
        log.info("%d steps, energy %.4g", steps, minimum.equations.total)
        before_round, found = found, _contact(problem, state, contact, joint_sigma, object_sigma)
        change = np.abs(found.probability - before_round.probability).max()
        if minimum.converged and change < _SETTLED and retimed < _RETIMED_S:
            break
    after = minimum.equations.energy
    flagged, reasons = _flags(
        failed | bridged, uncertain, lost, disagree, ambiguous, problem, state
    )
    report = data.residuals(state)
    offsets = data.estimate_offsets(known_offsets)

    with artefacts.write(
        output,
        JOINT,
        settings_digest=digest(settings),
        subject=subject.subject,
        object=object_.name,
        iterations=steps,
        **attributes,
    ) as writer:
        _put_body(writer, model, state)
        writer.put("keypoint_residual", report.keypoint_px)
        writer.put("cloud_residual", report.cloud_m)
        writer.put("rotation", state.rotation)
        writer.put("translation", state.translation)
        writer.put("region_names", CONTACT_REGIONS)
        writer.put("contact_probability", found.probability)
        writer.put("contact_annotated", found.labels)
        writer.put("time_offset", offsets.offset)
        writer.put("time_offset_sigma", offsets.sigma)
        names = sorted(before.keys() | after.keys())
        writer.put("energy_names", names)
        writer.put("energy_before", [before.get(name, 0.0) for name in names])
        writer.put("energy_after", [after.get(name, 0.0) for name in names])
        writer.put("flagged", flagged)
        writer.put("flag_reason", reasons)


def _start(
    body: Artefact, track: Artefact, body_models: BodyModels, device: str
) -> tuple[State, BodyModel]:
    """The sequential fits as one state: the mean shape, lost object poses bridged."""
    names = ("global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose",
             "left_hand_pose", "right_hand_pose", "transl")  # fmt: skip
    vector = np.concatenate([body[name] for name in names], axis=1).astype(float)
    assert vector.shape[1] == TRANSL.stop
    betas = body["betas"].astype(float)
    good = ~body["failed"]
    shape = betas[good].mean(axis=0) if good.any() else betas.mean(axis=0)
    model = load_model(body_models, str(body.attributes["gender"]), body, device=device)
    rotation, translation = bridge_poses(track["rotation"], track["translation"], ~track["lost"])
    expression = body["expression"].astype(float)
    return State(vector, shape, expression, rotation, translation), model


def _contact(
    problem: Problem,
    state: State,
    intervals: Sequence[ContactInterval] | None,
    joint_sigma: np.ndarray,
    object_sigma: np.ndarray,
) -> _Contact:
    """Contact by region at ``state``: found, annotated, or none where both are switched off."""
    count = len(state)
    shape = (count, len(CONTACT_REGIONS))
    given, labels = np.zeros(shape), np.full(shape, -1, np.int8)
    if intervals is not None:
        given, labels = annotation_evidence(intervals, CONTACT_REGIONS, count)
    elif not problem.settings.detect_contact:
        return _Contact(np.zeros(shape), labels)
    points, near = problem.proximity(state)
    motion = region_motion(
        problem.patches,
        points[:, problem.skin.patch],
        near.at(problem.skin.patch),
        state.rotation,
        state.translation,
        joint_sigma,
        object_sigma,
        problem.fps,
    )
    return _Contact(contact_probability(motion, problem.fps, given=given), labels)


def _put_body(writer: artefacts.Writer, model: BodyModel, state: State) -> None:
    parameters = state.parameters(model)
    with torch.no_grad():
        joints = model(parameters, vertex_ids=np.array([0])).joints
    writer.put("betas", state.betas)
    for name in ("expression", "global_orient", "transl", "body_pose", "jaw_pose", "leye_pose",
                 "reye_pose", "left_hand_pose", "right_hand_pose"):  # fmt: skip
        writer.put(name, getattr(parameters, name).cpu().numpy())
    writer.put("joints", joints.cpu().numpy())


def _flags(
    filled: np.ndarray,
    uncertain: np.ndarray,
    lost: np.ndarray,
    disagree: np.ndarray,
    ambiguous: np.ndarray,
    problem: Problem,
    state: State,
) -> tuple[np.ndarray, list[str]]:
    """Which frames (T,) should not be trusted, and why."""
    _, near = problem.proximity(state)
    deep = near.distance.min(axis=1) < -0.03
    causes = (
        (filled, "body not seen well enough, filled in"),
        (uncertain, "body not determined by what was seen"),
        (lost, "object lost, filled in"),
        (disagree, "object passes disagree"),
        (ambiguous, "object pose ambiguous"),
        (deep, "body deep inside the object"),
    )
    reasons = ["; ".join(text for flags, text in causes if flags[t]) for t in range(len(state))]
    return np.array([bool(reason) for reason in reasons]), reasons
