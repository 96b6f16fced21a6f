"""The joint fit: alternates between estimating contact and minimising the energy of equation 6."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.annotation import ContactInterval
from intercap_core.config import JointSettings
from intercap_core.joint.cameras import CameraFit
from intercap_core.joint.contact.estimate import ContactEstimate, ContactEstimator
from intercap_core.joint.floor import FloorPlane, contradiction
from intercap_core.joint.inputs import JointInputs
from intercap_core.joint.minimise import limited, minimise
from intercap_core.joint.problem import JointProblem, build_terms
from intercap_core.joint.result import CARRIED, CONTRADICTED, Convergence, JointFit
from intercap_core.joint.state import State
from intercap_core.joint.terms.body_data import BodyData
from intercap_core.joint.terms.contact import Contact
from intercap_core.joint.terms.object_data import NoObject, ObjectData
from intercap_core.joint.terms.object_images import ObjectImagesData
from intercap_core.joint.terms.term import TermContext

# Largest number of accepted steps of each round: the first round moves most. Contact is estimated
# between rounds. Tuned on the studio.
ROUND_STEPS = (6, 4, 3)
# Duration of errors of masks and keypoints, seconds: the frames of that time are one observation of
# the cameras. Tuned on the studio.
ERROR_LASTING_S = 0.3
# Weight of the body's evidence of the cameras: a detector's errors follow view and pose, and
# clothing has an unknown thickness. Tuned on the studio.
BODY_SHARE = 0.05
# Changes after which another round has nothing to improve: of a contact probability (tuned on the
# studio), of time offsets, seconds (3 mm of a hand at 3 m/s), and of cameras, metres.
CONTACT_CONVERGED = 0.1
OFFSET_CHANGED_S = 0.001
CAMERAS_CHANGED_M = 0.0005
# Depth of skin in the object, or of the object in the body, that flags a frame, metres: far beyond
# what skin yields, so one of the two poses is wrong. Tuned on the studio.
FLAGGED_DEPTH = 0.03

log = logging.getLogger(__name__)

ObjectTerm = ObjectData | ObjectImagesData | NoObject
"""The term that stands for E_O."""


@dataclass(frozen=True, eq=False)
class Assembly:
    """The energy of a recording, and those of its terms that the fit updates between rounds."""

    problem: JointProblem
    """All terms."""
    body: BodyData
    """E_B."""
    object_: ObjectTerm
    """E_O."""
    contact: Contact | None
    """E_C; None without an object."""
    floor: FloorPlane | None
    """The floor that the terms use."""
    against_floor: str
    """Why the scene's floor is not used; "" if it is, or if there is none."""
    share: float
    """Share of an independent observation of the cameras that a frame is."""


def assemble(inputs: JointInputs, settings: JointSettings) -> Assembly:
    """Build all terms.

    Without images the object's track stands for E_O; without an object the body's terms remain. A
    floor that the sequential fits contradict is left out.
    """
    sequential, floor = inputs.sequential, inputs.floor
    against_floor = contradiction(inputs.geometry, sequential, floor) if floor else ""
    context = TermContext(
        geometry=inputs.geometry,
        settings=settings,
        start=sequential.state,
        trust=sequential.trust,
        fps=inputs.fps,
        floor=None if against_floor else floor,
        encoder=inputs.encoder,
        up=floor.normal if floor else None,
    )
    share = min(1.0, 1 / (inputs.fps * ERROR_LASTING_S))
    object_data: ObjectTerm = NoObject()
    if sequential.tracked is not None:
        object_data = (
            ObjectImagesData(sequential.tracked, inputs.images, share)
            if inputs.images
            else ObjectData(sequential.tracked)
        )
    terms = build_terms(context, (inputs.body_data, object_data))
    return Assembly(
        problem=JointProblem(terms, inputs.threads),
        body=inputs.body_data,
        object_=object_data,
        contact=context.find(Contact) if inputs.geometry.has_object else None,
        floor=context.floor,
        against_floor=against_floor,
        share=share,
    )


def fit(
    inputs: JointInputs, settings: JointSettings, intervals: Sequence[ContactInterval] | None
) -> JointFit:
    """Minimise equation 6 from the sequential fits.

    ``intervals`` are the annotated contacts; None to detect contact. A floor that the sequential
    fits contradict flags every frame.
    """
    alone = not inputs.geometry.has_object
    if settings.refine_cameras and not (settings.look_again or alone):
        log.warning("refine_cameras needs look_again: the cameras stay as the scene has them")
    assembly = assemble(inputs, settings)
    if assembly.against_floor:
        log.warning(
            "%s: every frame is flagged; look at the scene's ground", assembly.against_floor
        )
    cameras = inputs.cameras if (inputs.images or alone) and settings.refine_cameras else None
    estimator = ContactEstimator(
        inputs.geometry, inputs.sequential, assembly.floor, inputs.fps, settings, intervals
    )
    rounds = _Rounds(inputs, assembly, estimator)
    for number, max_steps in enumerate(ROUND_STEPS, 1):
        rounds.minimise(max_steps)
        if number == len(ROUND_STEPS):
            break
        if cameras is not None and not cameras.refused:
            rounds.correct_cameras(cameras)
        if rounds.convergence == Convergence.CONVERGED:
            break
    state, convergence = rounds.state, rounds.convergence
    stalled = rounds.stalled | (convergence == Convergence.STALLED)
    log.log(
        logging.WARNING if convergence == Convergence.STALLED else logging.INFO,
        "%s: %d steps accepted, %d refused, %d frames stalled",
        convergence.value,
        rounds.steps,
        rounds.refused,
        rounds.stalled.sum(),
    )
    body, images = assembly.body, assembly.object_
    against_images = np.zeros(len(state), bool)
    if isinstance(images, ObjectImagesData):
        against_images = images.contradicted(state)
    body.refresh(state)
    return JointFit(
        state=state,
        contact=rounds.estimate,
        time_offsets=body.estimate_offsets(inputs.prior),
        residuals=body.residuals(),
        energy_before=rounds.energy_before,
        energy_after=rounds.energy_after,
        steps=rounds.steps,
        refused=rounds.refused,
        convergence=convergence,
        flag_reasons=_flag_reasons(
            inputs, state, rounds.estimate, stalled, against_images, assembly.against_floor
        ),
        cameras_corrected=cameras is not None and not cameras.refused,
    )


class _Rounds:
    """The alternation between minimisation and estimates of contact, time offsets and cameras.

    Attributes:
        state: present state.
        estimate: contact at this state.
        steps: number of accepted steps of all rounds.
        refused: number of refused steps of all rounds.
        stalled: (T,) frames that no round moved, since each step raised the energy there.
        energy_before: energy by term at the start.
        energy_after: energy by term at the end of the last round.
    """

    def __init__(
        self, inputs: JointInputs, assembly: Assembly, estimator: ContactEstimator
    ) -> None:
        self._assembly, self._estimator, self._prior = assembly, estimator, inputs.prior
        self.state = inputs.sequential.state
        self.estimate = estimator.at(self.state)
        self.steps = self.refused = 0
        self.stalled = np.ones(len(self.state), bool)
        self.energy_before: dict[str, float] = {}
        self.energy_after: dict[str, float] = {}
        self._unchanged = False  # the last round hardly changed state, contact and time offsets
        self._camera_shift = 0.0  # of the last correction, metres

    @property
    def convergence(self) -> Convergence:
        """Outcome so far."""
        if self._unchanged and self._camera_shift < CAMERAS_CHANGED_M:
            return Convergence.CONVERGED
        if self.steps == 0 and self.refused > 0:
            return Convergence.STALLED
        return Convergence.ITERATION_LIMIT

    def minimise(self, max_steps: int) -> None:
        """Do one round.

        Update time offsets and correspondences at the state, take at most ``max_steps`` steps, and
        estimate contact again.
        """
        assembly, body = self._assembly, self._assembly.body
        if assembly.contact is not None:
            assembly.contact.take_contact(self.estimate.probability, self.estimate.labels)
        body.refresh(self.state)
        offset_change = body.take_offsets(body.estimate_offsets(self._prior).offset)
        assembly.object_.take_offsets(body.time_offset)
        assembly.problem.refresh(self.state, but=body)
        minimum = minimise(assembly.problem.equations, self.state, max_steps=max_steps)
        self.state = minimum.state
        self.steps, self.refused = self.steps + minimum.steps, self.refused + minimum.refused
        self.energy_before = self.energy_before or minimum.energy_before
        self.energy_after = minimum.equations.energy
        self.stalled &= minimum.stalled
        log.info("%d steps, energy %.4g", self.steps, minimum.equations.total)
        converged = minimum.converged
        del minimum  # its equations are most of the memory
        previous, self.estimate = self.estimate, self._estimator.at(self.state)
        contact_change = self.estimate.change(previous)
        self._unchanged = bool(
            converged and contact_change < CONTACT_CONVERGED and offset_change < OFFSET_CHANGED_S
        )

    def correct_cameras(self, cameras: CameraFit) -> None:
        """Correct ``cameras`` by the evidence of the body and, if there are images of it, the
        object."""
        body, images = self._assembly.body, self._assembly.object_
        evidence = [body.camera_evidence(self.state, BODY_SHARE * self._assembly.share)]
        if isinstance(images, ObjectImagesData):
            evidence.append(images.camera_evidence(self.state))
        correction = cameras.solve(evidence)
        if cameras.take(correction):
            self._camera_shift = correction.shift
            log.info("cameras corrected by up to %.1f mm", 1e3 * correction.shift)
            self.state = self.state.moved(limited(correction.along))
        body.take_cameras(cameras.now)
        if isinstance(images, ObjectImagesData):
            images.take_cameras(cameras.now)
        if cameras.refused:
            # the state was fitted to the cameras before: at least one more round
            self._camera_shift, self._unchanged = 0.0, False
            log.warning(
                "body and object would move a camera by %.0f mm, far beyond what the scene "
                "leaves open: all cameras stay as the scene has them; look at their poses, the "
                "body and the object",
                1e3 * correction.shift,
            )


def _flag_reasons(
    inputs: JointInputs,
    state: State,
    estimate: ContactEstimate,
    stalled: np.ndarray,
    against_images: np.ndarray,
    against_floor: str,
) -> list[str]:
    """Reasons (T,) not to trust a frame; "" if there is none.

    Args:
        stalled: (T,) frames that no step moved.
        against_images: (T,) frames whose images contradict the object's final pose.
        against_floor: why the floor is not used.
    """
    flags = inputs.sequential.flags
    deep = sunk = np.zeros(len(state), bool)
    lost = "object found in no frame"
    if inputs.geometry.has_object:
        posed = inputs.geometry.at(state)
        deep = posed.proximity.distance.min(axis=1) < -FLAGGED_DEPTH
        sunk = posed.object_depth(inputs.threads) > FLAGGED_DEPTH
        lost = "object lost, filled in"
    causes = (
        (flags.filled, "body not seen well enough, filled in"),
        (flags.uncertain, "body not determined by what was seen"),
        (flags.lost, lost),
        (flags.ambiguous & flags.carried, CARRIED),
        (flags.ambiguous & ~flags.carried, "object pose ambiguous"),
        (deep, "body deep inside the object"),
        (sunk, "object deep inside the body"),
        *estimate.distrust(),
        (stalled, "no step of the joint fit lowered its energy"),
        (against_images, CONTRADICTED),
        (np.full(len(state), bool(against_floor)), against_floor),
    )
    return ["; ".join(text for frames, text in causes if frames[t]) for t in range(len(state))]
