"""The joint fit: alternates between estimating contact and minimising the energy, until neither
changes.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.config import ContactInterval, JointSettings
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.joint.cameras import CameraFit
from intercap_core.joint.contact.estimate import ContactEstimate, ContactEstimator
from intercap_core.joint.floor import Ground, contradiction
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.inputs import JointInputs
from intercap_core.joint.minimise import limited, minimise
from intercap_core.joint.problem import Problem, joint_terms
from intercap_core.joint.result import CARRIED, CONTRADICTED
from intercap_core.joint.sequential import Flags
from intercap_core.joint.state import State
from intercap_core.joint.terms.body_data import BodyData, Residuals
from intercap_core.joint.terms.contact import Contact
from intercap_core.joint.terms.object_data import NoObject, ObjectData
from intercap_core.joint.terms.object_images import ObjectImagesData
from intercap_core.joint.time_offsets import OffsetPrior, TimeOffsets

# Errors of masks and keypoints last about so long, seconds: what the frames of that time say of the
# cameras is one observation. Tuned on the studio.
ERROR_LASTING_S = 0.3
# What the body says of the cameras beside that: a detector's errors follow view and pose, and
# clothing is of unknown thickness. Tuned on the studio.
BODY_SHARE = 0.05
# Changes of offsets above this call for another round, seconds: 3 mm of that hand's motion.
OFFSET_CHANGED_S = 0.001
# Corrections of cameras below this are not worth another round, metres.
CAMERAS_CHANGED_M = 0.0005
# Most accepted steps of each round; contact is estimated anew between rounds, and the first moves
# the most. Tuned on the studio.
ROUND_STEPS = (6, 4, 3)
# Largest change of a contact probability after which another round has nothing new to work with.
# Tuned on the studio.
CONTACT_CONVERGED = 0.1
# A frame with skin deeper than this inside the object, or the other way round, is flagged, metres:
# far beyond what skin yields, so one of the two poses is wrong. Tuned on the studio.
FLAGGED_DEPTH = 0.03

log = logging.getLogger(__name__)
ObjectTerm = ObjectData | ObjectImagesData | NoObject  # what stands for E_O


@dataclass(frozen=True)
class JointFit:
    """The refined state, with contact, time offsets and residuals there, the energy by term before
    and after, the numbers of ``steps`` and of ``refused`` ones, whether it ``converged``, and the
    reasons (T,) not to trust a frame, "" = none; whether the ``cameras`` were corrected."""

    state: State
    contact: ContactEstimate
    time_offsets: TimeOffsets
    residuals: Residuals
    energy_before: dict[str, float]
    energy_after: dict[str, float]
    steps: int
    refused: int
    converged: bool
    flag_reasons: list[str]
    cameras: bool


@dataclass(frozen=True, eq=False)
class Assembly:
    """The ``problem`` of equation 6, with those of its terms that are told what to hold fixed;
    ``against_floor`` says why the floor was left out, "" = it was not."""

    problem: Problem
    body: BodyData
    object_: ObjectTerm
    contact: Contact | None
    floor: Ground | None
    against_floor: str
    share: float


def assemble(inputs: JointInputs, settings: JointSettings) -> Assembly:
    """All terms over ``inputs``. Without images the object's track stands for them; without an
    object only the body's terms are left. A floor that the sequential fits contradict is left
    out."""
    sequential, floor = inputs.sequential, inputs.floor
    against_floor = contradiction(inputs.geometry, sequential, floor) if floor else ""
    if against_floor:
        floor = None
    share = min(1.0, 1 / (inputs.fps * ERROR_LASTING_S))
    object_data: ObjectTerm = NoObject()
    contact = None
    if sequential.tracked is not None:
        contact = Contact(inputs.geometry, settings.contact_weight)
        object_data = (
            ObjectImagesData(sequential.tracked, inputs.images, share)
            if inputs.images
            else ObjectData(sequential.tracked)
        )
    problem = Problem(
        joint_terms(
            inputs.geometry,
            settings,
            sequential.state,
            data=(inputs.body_data, object_data),
            contact=contact,
            floor=floor,
            fps=inputs.fps,
            trust=sequential.trust,
            motion=inputs.motion,
        ),
        inputs.threads,
    )
    return Assembly(problem, inputs.body_data, object_data, contact, floor, against_floor, share)


def fit(
    inputs: JointInputs, settings: JointSettings, intervals: Sequence[ContactInterval] | None
) -> JointFit:
    """Minimise equation 6 from the sequential fits.

    ``intervals`` are the annotated contacts, None where contact is to be detected. A floor that
    the sequential fits contradict flags every frame.
    """
    geometry, sequential, body_data = inputs.geometry, inputs.sequential, inputs.body_data
    state = sequential.state
    alone = not geometry.has_object
    if settings.refine_cameras and not (settings.look_again or alone):
        log.warning("refine_cameras needs look_again: the cameras stay as the scene has them")
    assembly = assemble(inputs, settings)
    problem, object_data, contact = assembly.problem, assembly.object_, assembly.contact
    floor, against_floor, share = assembly.floor, assembly.against_floor, assembly.share
    if against_floor:
        log.warning("%s: every frame is flagged; look at the scene's ground", against_floor)
    cameras = inputs.cameras if (inputs.images or alone) and settings.refine_cameras else None
    fps, prior = inputs.fps, inputs.prior
    estimator = ContactEstimator(geometry, sequential, floor, fps, settings, intervals)
    rounds = _Rounds(problem, body_data, object_data, contact, estimator, prior, state)
    for number, max_steps in enumerate(ROUND_STEPS, 1):
        rounds.minimise(max_steps)
        if number == len(ROUND_STEPS):
            break
        if cameras is not None and not cameras.refused and not isinstance(object_data, ObjectData):
            rounds.settle(cameras, object_data, share)
        if rounds.settled:
            break
    state, steps, refused = rounds.state, rounds.steps, rounds.refused
    stuck = steps == 0 and refused > 0 and not rounds.settled
    against_images = np.zeros(len(state), bool)
    if isinstance(object_data, ObjectImagesData):
        against_images = object_data.contradicted(state)
    log.log(
        logging.WARNING if stuck else logging.INFO,
        "%d steps taken, %d refused, %d frames held, %s",
        steps,
        refused,
        rounds.held.sum(),
        "settled" if rounds.settled else "ended before it settled",
    )
    body_data.refresh(state)
    residuals = body_data.residuals()
    return JointFit(
        state=state,
        contact=rounds.estimate,
        time_offsets=body_data.estimate_offsets(prior),
        residuals=residuals,
        energy_before=rounds.energy_before,
        energy_after=rounds.energy_after,
        steps=steps,
        refused=refused,
        converged=rounds.settled,
        flag_reasons=_flag_reasons(
            geometry,
            state,
            sequential.flags,
            rounds.estimate,
            rounds.held | stuck,
            against_floor,
            against_images,
            problem.threads,
        ),
        cameras=cameras is not None and not cameras.refused,
    )


class _Rounds:
    """What the alternation has come to: the ``state`` with contact's ``estimate`` there, the energy
    by term before and after, the numbers of ``steps`` and of ``refused`` ones, and the frames (T,)
    that were ``held`` in every round."""

    def __init__(
        self,
        problem: Problem,
        body_data: BodyData,
        object_data: ObjectTerm,
        contact: Contact | None,
        estimator: ContactEstimator,
        prior: OffsetPrior,
        state: State,
    ) -> None:
        self._problem, self._body, self._object = problem, body_data, object_data
        self._contact, self._estimator, self._prior = contact, estimator, prior
        self.state, self.estimate = state, estimator.at(state)
        self.steps = self.refused = 0
        self.held = np.ones(len(state), bool)
        self.energy_before: dict[str, float] = {}
        self.energy_after: dict[str, float] = {}
        self._still = False  # neither state, contact nor time offsets change any more
        self._camera_change = 0.0

    @property
    def settled(self) -> bool:
        """Whether another round would change nothing."""
        return self._still and self._camera_change < CAMERAS_CHANGED_M

    def minimise(self, max_steps: int) -> None:
        """One round: time offsets and images at the state, at most so many steps, contact anew."""
        if self._contact is not None:
            self._contact.take_contact(self.estimate.probability, self.estimate.labels)
        self._body.refresh(self.state)
        offsets = self._body.estimate_offsets(self._prior).offset
        offset_change = self._body.take_offsets(offsets)
        self._object.take_offsets(self._body.time_offset)
        self._problem.refresh(self.state, but=self._body)
        minimum = minimise(self._problem.equations, self.state, max_steps=max_steps)
        self.state = minimum.state
        self.steps, self.refused = self.steps + minimum.steps, self.refused + minimum.refused
        self.energy_before = self.energy_before or minimum.energy_before
        self.energy_after = minimum.equations.energy
        self.held &= minimum.held
        log.info("%d steps, energy %.4g", self.steps, minimum.equations.total)
        converged = minimum.converged
        del minimum  # its equations are most of the memory
        previous, self.estimate = self.estimate, self._estimator.at(self.state)
        contact_change = self.estimate.change(previous)
        self._still = bool(
            converged and contact_change < CONTACT_CONVERGED and offset_change < OFFSET_CHANGED_S
        )

    def settle(self, cameras: CameraFit, images: ObjectImagesData | NoObject, share: float) -> None:
        """Correct the ``cameras`` by body and, where there is an object, ``images``; a frame is so
        large a ``share`` of an independent observation."""
        shown = [self._body.sights(self.state, BODY_SHARE * share)]
        if isinstance(images, ObjectImagesData):
            shown.append(images.sights(self.state))
        found = cameras.settle(shown)
        if cameras.take(found):
            self._camera_change = found.shift
            log.info("cameras corrected by up to %.1f mm", 1e3 * found.shift)
            self.state = self.state.moved(limited(found.along))
        self._body.take_cameras(cameras.now)
        if isinstance(images, ObjectImagesData):
            images.take_cameras(cameras.now)
        if cameras.refused:
            # what the cameras were until now was fitted to: at least one more round
            self._camera_change, self._still = 0.0, False
            log.warning(
                "body and object would move a camera by %.0f mm, far beyond what the scene "
                "leaves open: all cameras stay as the scene has them; look at their poses, the "
                "body and the object",
                1e3 * found.shift,
            )


def _flag_reasons(
    geometry: Geometry,
    state: State,
    flags: Flags,
    estimate: ContactEstimate,
    stuck: np.ndarray,
    against_floor: str,
    against_images: np.ndarray,
    threads: ThreadPool,
) -> list[str]:
    """Why each frame (T,) should not be trusted; "" where it can be. ``stuck`` (T,): no step
    lowered its energy; ``against_images`` (T,): they contradict the object's final pose."""
    nowhere = np.zeros(len(state), bool)
    deep = sunk = nowhere
    lost = "object found in no frame"
    if geometry.has_object:
        posed = geometry.at(state)
        deep = posed.proximity.distance.min(axis=1) < -FLAGGED_DEPTH
        sunk = posed.object_depth(threads) > FLAGGED_DEPTH
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
        (stuck, "no step of the joint fit lowered its energy"),
        (against_images, CONTRADICTED),
        (np.full(len(state), bool(against_floor)), against_floor),
    )
    return ["; ".join(text for frames, text in causes if frames[t]) for t in range(len(state))]
