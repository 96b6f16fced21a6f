"""The joint fit: alternates between estimating contact and minimising the energy, until neither
changes."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.config import ContactInterval, JointSettings
from intercap_core.joint.cameras import CameraFit
from intercap_core.joint.constants import (
    BODY_SHARE,
    CAMERAS_CHANGED_M,
    CONTACT_CONVERGED,
    ERROR_LASTING_S,
    FLAGGED_DEPTH,
    OFFSET_CHANGED_S,
    ROUND_STEPS,
)
from intercap_core.joint.contact_estimate import ContactEstimate, ContactEstimator
from intercap_core.joint.floor import contradiction
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.minimise import limited, minimise
from intercap_core.joint.object_images import ObjectImages
from intercap_core.joint.problem import Problem, joint_terms
from intercap_core.joint.sequential import Flags, SequentialFits
from intercap_core.joint.state import State
from intercap_core.joint.terms.body_data import BodyData, Residuals
from intercap_core.joint.terms.contact import Contact
from intercap_core.joint.terms.ground import Ground
from intercap_core.joint.terms.object_data import ObjectData
from intercap_core.joint.terms.object_images import ObjectImagesData
from intercap_core.joint.terms.term import Term
from intercap_core.joint.time_offsets import OffsetPrior, TimeOffsets
from intercap_core.solve.thread_pool import ThreadPool

log = logging.getLogger(__name__)


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


def fit(
    geometry: Geometry,
    sequential: SequentialFits,
    body_data: BodyData,
    *,
    floor: Ground | None,
    fps: float,
    prior: OffsetPrior,
    settings: JointSettings,
    intervals: Sequence[ContactInterval] | None,
    images: ObjectImages | None = None,
    cameras: CameraFit | None = None,
    motion: Term | None = None,
    threads: ThreadPool | None = None,
) -> JointFit:
    """Minimise equation 6 from the sequential fits.

    ``intervals`` are the annotated contacts, None where contact is to be detected. Without
    ``images`` the object's track stands for them; without ``cameras`` these stay as they are. A
    ``floor`` that the sequential fits contradict is left out, which flags every frame. ``motion``
    is a learned E_S; ``threads`` make rows of the equations, None is one.
    """
    state = sequential.state
    against_floor = contradiction(geometry, sequential, floor) if floor else ""
    if against_floor:
        log.warning("%s: every frame is flagged; look at the scene's ground", against_floor)
        floor = None
    share = min(1.0, 1 / (fps * ERROR_LASTING_S))
    object_data: ObjectData | ObjectImagesData = (
        ObjectImagesData(sequential.tracked, images, share)
        if images
        else ObjectData(sequential.tracked)
    )
    contact = Contact(geometry, settings.contact_weight)
    problem = Problem(
        joint_terms(
            geometry,
            settings,
            state,
            data=(body_data, object_data),
            contact=contact,
            floor=floor,
            fps=fps,
            trust=sequential.trust,
            motion=motion,
        ),
        threads or ThreadPool(),
    )

    estimator = ContactEstimator(geometry, sequential, floor, fps, settings, intervals)
    steps, refused, settled, camera_change = 0, 0, False, 0.0
    energy_before: dict[str, float] | None = None
    energy_after: dict[str, float] = {}
    held = np.ones(len(state), bool)
    estimate = estimator.at(state)
    for number, max_steps in enumerate(ROUND_STEPS, 1):
        contact.take_probability(estimate.probability)
        body_data.refresh(state)
        offset_change = body_data.take_offsets(body_data.estimate_offsets(prior).offset)
        object_data.take_offsets(body_data.time_offset)
        problem.refresh(state, but=body_data)
        minimum = minimise(problem.equations, state, max_steps=max_steps)
        state, steps, refused = minimum.state, steps + minimum.steps, refused + minimum.refused
        energy_before = energy_before or minimum.energy_before
        energy_after, held = minimum.equations.energy, held & minimum.held
        log.info("%d steps, energy %.4g", steps, minimum.equations.total)
        converged = minimum.converged
        del minimum  # its equations are most of the memory
        previous, estimate = estimate, estimator.at(state)
        contact_change = np.abs(estimate.probability - previous.probability).max()
        settled = (
            converged and contact_change < CONTACT_CONVERGED and offset_change < OFFSET_CHANGED_S
        )
        if number == len(ROUND_STEPS):
            break
        if cameras is not None and isinstance(object_data, ObjectImagesData):
            shown = body_data.sights(state, BODY_SHARE * share), object_data.sights(state)
            found = cameras.settle(shown)
            if cameras.take(found):
                camera_change = found.shift
                log.info("cameras corrected by up to %.1f mm", 1e3 * found.shift)
                state = state.moved(limited(found.along))
            body_data.take_cameras(cameras.now)
            object_data.take_cameras(cameras.now)
            if cameras.refused:
                # what the cameras were until now was fitted to: at least one more round
                cameras, camera_change, settled = None, 0.0, False
                log.warning(
                    "body and object would move a camera by %.0f mm, far beyond what the scene "
                    "leaves open: all cameras stay as the scene has them; look at their poses, the "
                    "body and the object",
                    1e3 * found.shift,
                )
        if settled and camera_change < CAMERAS_CHANGED_M:
            break
    settled = settled and camera_change < CAMERAS_CHANGED_M
    stuck = steps == 0 and refused > 0 and not settled
    against_images = np.zeros(len(state), bool)
    if isinstance(object_data, ObjectImagesData):
        against_images = object_data.contradicted(state)
    log.log(
        logging.WARNING if stuck else logging.INFO,
        "%d steps taken, %d refused, %d frames held, %s",
        steps,
        refused,
        held.sum(),
        "settled" if settled else "ended before it settled",
    )
    residuals = body_data.residuals(state)
    return JointFit(
        state=state,
        contact=estimate,
        time_offsets=body_data.estimate_offsets(prior),
        residuals=residuals,
        energy_before=energy_before or {},
        energy_after=energy_after,
        steps=steps,
        refused=refused,
        converged=settled,
        flag_reasons=_flag_reasons(
            geometry,
            state,
            sequential.flags,
            estimate,
            held | stuck,
            against_floor,
            against_images,
            problem.threads,
        ),
        cameras=cameras is not None,
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
    posed = geometry.at(state)
    deep = posed.proximity.distance.min(axis=1) < -FLAGGED_DEPTH
    causes = (
        (flags.filled, "body not seen well enough, filled in"),
        (flags.uncertain, "body not determined by what was seen"),
        (flags.lost, "object lost, filled in"),
        (flags.ambiguous, "object pose ambiguous"),
        (deep, "body deep inside the object"),
        (posed.object_depth(threads) > FLAGGED_DEPTH, "object deep inside the body"),
        *estimate.distrust(),
        (stuck, "no step of the joint fit lowered its energy"),
        (against_images, "the images contradict the object's pose"),
        (np.full(len(state), bool(against_floor)), against_floor),
    )
    return ["; ".join(text for frames, text in causes if frames[t]) for t in range(len(state))]
