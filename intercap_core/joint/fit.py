"""The joint fit: rounds of minimising equation 6 (:mod:`.problem`) over all frames at once.

Each round corrects the cameras if the setting ``refine_cameras`` is on. It then minimises with new
contact probabilities and correspondences.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from intercap_core.annotation import ContactInterval
from intercap_core.config import JointSettings
from intercap_core.flags import OF_BODY, OF_OBJECT, PARTS, Cause, Flags
from intercap_core.joint.cameras import CameraFit
from intercap_core.joint.contact_estimate import ContactEstimate, estimate_contact
from intercap_core.joint.geometry import Geometry, PosedGeometry
from intercap_core.joint.inputs import JointInputs
from intercap_core.joint.minimise import limited, minimise
from intercap_core.joint.problem import JointProblem, build_terms
from intercap_core.joint.result import (
    BODY_INSIDE,
    CARRIED,
    CONTRADICTED,
    OBJECT_INSIDE,
    Convergence,
    JointFit,
)
from intercap_core.joint.state import State
from intercap_core.joint.terms.body_data import BodyData
from intercap_core.joint.terms.contact import Contact
from intercap_core.joint.terms.object_data import NoObject, ObjectData
from intercap_core.joint.terms.object_images import ObjectImagesData
from intercap_core.joint.terms.term import TermContext

# Steps that the rounds accept at most. A second step in the later rounds changes errors by less
# than 0.03 mm, twice as many steps in the first by less than 0.1 mm (bench/RESULTS.md).
ROUND_STEPS = (6, 1, 1, 1)
# Displacement of body and object over a round, metres: a smaller one ends the fit. A seventh of the
# body's mean error and half of the object's, measured on the studio (bench/RESULTS.md).
UNCHANGED_M = 0.001

log = logging.getLogger(__name__)

ObjectTerm = ObjectData | ObjectImagesData | NoObject
"""The term that stands for E_O."""


@dataclass(frozen=True, eq=False)
class Assembly:
    """The energy of a recording, and those of its terms that the fit updates between rounds."""

    problem: JointProblem  # All terms
    body: BodyData  # E_B
    object_: ObjectTerm  # E_O
    contact: Contact | None  # E_C; None without an object
    share: float  # Weight of a frame in the correction of the cameras


def assemble(inputs: JointInputs, settings: JointSettings) -> Assembly:
    """Build all terms. A floor that the sequential fits contradict is left out.

    E_O compares images, or uses the object track if there are no images. Without an object only
    the body's terms remain.
    """
    sequential, floor = inputs.sequential, inputs.floor
    context = TermContext(
        geometry=inputs.geometry,
        settings=settings,
        start=sequential.state,
        trust=sequential.trust,
        fps=inputs.fps,
        floor=None if inputs.against_floor else floor,
        encoder=inputs.encoder,
        up=floor.normal if floor else None,
    )
    share = min(1.0, 1 / (inputs.fps * 0.3))  # errors of masks and keypoints last 0.3 s; tuned
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
        share=share,
    )


def fit(
    inputs: JointInputs, settings: JointSettings, intervals: Sequence[ContactInterval] | None
) -> JointFit:
    """Minimise equation 6 from the sequential fits.

    There are up to four rounds (``ROUND_STEPS``). The fit has converged if body and object moved
    by less than ``UNCHANGED_M`` since the last round and contact is unchanged.
    ``intervals`` are the annotated contacts; None to detect contact. If the sequential fits
    contradict the floor, it is not used, and every frame is flagged.
    """
    alone = not inputs.geometry.has_object
    if settings.refine_cameras and not (settings.look_again or alone):
        log.warning("refine_cameras needs look_again: the cameras stay as in scene.h5")
    assembly = assemble(inputs, settings)
    if inputs.against_floor:
        log.warning("%s: every frame is flagged; check the scene's ground", inputs.against_floor)
    cameras = inputs.cameras if (inputs.images or alone) and settings.refine_cameras else None
    rounds = _Rounds(inputs, assembly, partial(estimate_contact, inputs, settings, intervals))
    for max_steps in ROUND_STEPS:
        if cameras is not None and not cameras.refused:
            rounds.correct_cameras(cameras)
        rounds.minimise(max_steps)
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
        against_images = images.contradicted()
    body.refresh(state)
    return JointFit(
        state=state,
        contact=rounds.estimate,
        residuals=body.residuals(),
        energy_before=rounds.energy_before,
        energy_after=rounds.energy_after,
        steps=rounds.steps,
        refused=rounds.refused,
        convergence=convergence,
        flags=_flags(inputs, state, rounds.estimate, stalled, against_images),
        cameras_corrected=cameras is not None and not cameras.refused,
        last_step_m=rounds.last_step_m,
        last_decrease=rounds.last_decrease,
    )


class _Rounds:
    """State, contact and statistics of the rounds so far; see :class:`JointFit` for the fields.

    ``stalled`` (T,) are frames that no round moved, since each step raised the energy there.
    """

    def __init__(
        self,
        inputs: JointInputs,
        assembly: Assembly,
        contact_at: Callable[[State], ContactEstimate],
    ) -> None:
        self._assembly, self._contact_at = assembly, contact_at
        self._geometry = inputs.geometry
        self.state = inputs.sequential.state
        self.estimate = contact_at(self.state)
        self.steps = self.refused = 0
        self.stalled = np.ones(len(self.state), bool)
        self.energy_before: dict[str, float] = {}
        self.energy_after: dict[str, float] = {}
        self.last_step_m = self.last_decrease = 0.0
        self._last = self.state  # at the end of the last round
        self._unchanged = False  # the last round hardly changed state and contact
        self._is_new = True  # no term has been refreshed

    @property
    def convergence(self) -> Convergence:
        """Outcome so far."""
        if self._unchanged:
            return Convergence.CONVERGED
        if self.steps == 0 and self.refused > 0:
            return Convergence.STALLED
        return Convergence.ITERATION_LIMIT

    def minimise(self, max_steps: int) -> None:
        """Update correspondences, minimise, and estimate contact again."""
        assembly = self._assembly
        if assembly.contact is not None:
            assembly.contact.take_contact(self.estimate.probability, self.estimate.labels)
        assembly.problem.refresh(self.state)
        minimum = minimise(assembly.problem, self.state, max_steps=max_steps)
        self.state = minimum.state
        self.steps, self.refused = self.steps + minimum.steps, self.refused + minimum.refused
        self.energy_before = self.energy_before or minimum.energy_before
        self.energy_after = minimum.energies.energy
        self.last_step_m = _displacement(self._geometry, minimum.previous, minimum.state)
        self.last_decrease = minimum.decrease
        self.stalled &= minimum.stalled
        log.info("%d steps, energy %.4g", self.steps, minimum.energies.total)
        settled = minimum.converged or minimum.steps > 0  # not each step was refused
        previous, self.estimate = self.estimate, self._contact_at(self.state)
        changed_m = _displacement(self._geometry, self._last, self.state)
        self._last = self.state
        contact_change = self.estimate.change(previous)
        # the limit of the contact probability is tuned on the studio
        self._unchanged = settled and changed_m < UNCHANGED_M and contact_change < 0.1

    def correct_cameras(self, cameras: CameraFit) -> None:
        """Correct ``cameras`` by the residuals of the body and of images of the object."""
        body, images = self._assembly.body, self._assembly.object_
        share = self._assembly.share
        every = round(1 / share)  # one of the frames with the same errors represents them
        if self._is_new:
            body.refresh(self.state)
            if isinstance(images, ObjectImagesData):
                images.refresh(self.state, every)
            self._is_new = False
        # the body weighs a twentieth (tuned): errors of keypoints and clothing depend on the view
        # and the pose, and so resemble errors of a camera
        evidence = [body.camera_evidence(self.state, 0.05 * share, every)]
        if isinstance(images, ObjectImagesData):
            evidence.append(images.camera_evidence(self.state))
        correction = cameras.solve(evidence, len(self.state))
        if cameras.take(correction):
            log.info("cameras corrected by up to %.1f mm", 1e3 * correction.shift)
            self.state = self.state.moved(limited(correction.along))
        body.take_cameras(cameras.now)
        if isinstance(images, ObjectImagesData):
            images.take_cameras(cameras.now)
        if cameras.refused:
            log.warning(
                "body and object would move a camera by %.0f mm, far more than the scene's "
                "standard deviations: all cameras stay as in scene.h5; check their poses, the "
                "body and the object",
                1e3 * correction.shift,
            )


def _displacement(geometry: Geometry, before: State, after: State) -> float:
    """Displacement of body and object between two states, metres.

    It is the larger of the skin's mean and of the object's centre in each frame, and the 95th
    percentile over frames.
    """
    skin = np.linalg.norm(geometry.at(after).skin - PosedGeometry(geometry, before).skin, axis=2)
    centre = np.linalg.norm(after.translation - before.translation, axis=1)
    return float(np.percentile(np.fmax(skin.mean(axis=1), centre), 95))


def _flags(
    inputs: JointInputs,
    state: State,
    estimate: ContactEstimate,
    stalled: np.ndarray,
    against_images: np.ndarray,
) -> Flags:
    """Flags of all frames. Only poses that were measured are flagged for penetration.

    Args:
        stalled: (T,) frames that no step moved.
        against_images: (T,) frames whose images contradict the object's final pose.
    """
    flags, every = inputs.sequential.flags, np.ones(len(state), bool)
    deep = sunk = ~every
    lost = "object found in no frame"
    if inputs.geometry.has_object:
        posed = inputs.geometry.at(state)
        limit = 0.03  # metres, far more than skin yields: one pose is wrong; tuned on the studio
        deep = posed.proximity.distance.min(axis=1) < -limit
        sunk = posed.object_depth(inputs.threads) > limit
        lost = "object lost, filled in"
    causes: list[Cause] = [
        (flags.filled, "body not seen well enough, filled in", OF_BODY),
        (flags.uncertain, "body not determined by what was seen", OF_BODY),
        (flags.hands[:, 0], "left hand not determined by what was seen", ["hands"]),
        (flags.hands[:, 1], "right hand not determined by what was seen", ["hands"]),
        (flags.lost, lost, OF_OBJECT),
        (flags.ambiguous & flags.carried, CARRIED, OF_OBJECT),
        (flags.ambiguous & ~flags.carried, "object pose ambiguous", OF_OBJECT),
    ]
    for inside, reason in ((deep, BODY_INSIDE), (sunk, OBJECT_INSIDE)):
        causes += [
            (inside & ~flags.lost, reason, OF_BODY),
            (inside & ~flags.filled, reason, OF_OBJECT),
        ]
    causes += [
        *((frames, reason, ["contact"]) for frames, reason in estimate.doubtful_frames()),
        (stalled, "no step of the joint fit lowered its energy", PARTS),
        (against_images, CONTRADICTED, OF_OBJECT),
        (every & bool(inputs.against_floor), inputs.against_floor, PARTS),
    ]
    has_object = inputs.geometry.has_object or bool(flags.lost.any())
    return Flags.of(len(state), causes, has_object=has_object)
