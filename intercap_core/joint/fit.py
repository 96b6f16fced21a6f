"""The joint fit: rounds of minimising equation 6 (:mod:`.problem`) over all frames at once.

The cameras are corrected first, if the setting ``refine_cameras`` is on. Each round then minimises
with new contact probabilities and correspondences. Long recordings are fitted in windows of frames.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

import numpy as np

from intercap_core.annotation import ContactInterval
from intercap_core.config import JointSettings
from intercap_core.joint.assembly import Assembly, assemble
from intercap_core.joint.cameras import CameraEvidence, CameraFit
from intercap_core.joint.contact_estimate import AnnotatedContact, ContactEstimate, estimate_contact
from intercap_core.joint.fit_flags import FrameFaults, fit_flags
from intercap_core.joint.geometry import Geometry, PosedGeometry
from intercap_core.joint.inputs import JointInputs
from intercap_core.joint.minimise import limited, minimise
from intercap_core.joint.result import Convergence, JointFit
from intercap_core.joint.state import State
from intercap_core.joint.terms.body_data import BodyResiduals
from intercap_core.joint.windows import Window, join, split_frames
from intercap_core.memory import return_freed_memory

# Corrections of the cameras before the first round: with three the object's error is less than 0.01
# mm smaller, with one up to 0.11 mm larger (bench/RESULTS.md).
CAMERA_CORRECTIONS = 2
# Steps that the rounds accept at most. A second step in the later rounds changes errors by less
# than 0.03 mm, twice as many steps in the first by less than 0.1 mm (bench/RESULTS.md).
ROUND_STEPS = (6, 1, 1, 1)
# Displacement of body and object over a round, metres: a smaller one ends the fit. A seventh of the
# body's mean error and half of the object's, measured on the studio (bench/RESULTS.md).
UNCHANGED_M = 0.001

log = logging.getLogger(__name__)


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
    if inputs.against_floor:
        log.warning("%s: every frame is flagged; check the scene's ground", inputs.against_floor)
    state = inputs.sequential.state
    annotated = None
    if intervals is not None:
        uncertainty = settings.annotation_uncertainty_frames
        annotated = AnnotatedContact.of(intervals, len(state), uncertainty)
    windows = split_frames(len(state))

    @lru_cache(maxsize=int(len(windows) == 1))  # two windows would not fit into the memory
    def opened(start: int, stop: int) -> tuple[JointInputs, Assembly]:
        whole = stop - start == len(state)
        own = inputs if whole else inputs.window(slice(start, stop))
        return own, assemble(own, settings)

    cameras = inputs.cameras if (inputs.images or alone) and settings.refine_cameras else None
    for _ in range(CAMERA_CORRECTIONS if cameras else 0):
        assert cameras is not None
        if not cameras.refused:
            state = _correct_cameras(cameras, state, windows, lambda *at: opened(*at)[1])
    fits = []
    for number, window in enumerate(windows, 1):
        own, assembly = opened(window.used.start, window.used.stop)
        if len(windows) > 1:
            log.info("window %d of %d", number, len(windows))
        if cameras is not None:
            assembly.take_cameras(cameras.now)
        contact_at = partial(
            estimate_contact, own, settings, annotated and annotated.window(window.used)
        )
        fits.append(_fit_window(own, assembly, state.window(window.used), contact_at))
        del own, assembly, contact_at  # before the next window is opened
        return_freed_memory()
    corrected = cameras is not None and not cameras.refused
    return _joined(inputs, windows, fits, annotated, cameras_corrected=corrected)


def _correct_cameras(
    cameras: CameraFit,
    state: State,
    windows: Sequence[Window],
    opened: Callable[[int, int], Assembly],
) -> State:
    """Correct ``cameras`` by the residuals of the body and of images of the object.

    Returns ``state``, moved along with the cameras. ``opened`` gives the energy of the frames from
    one to another.
    """

    def evidence() -> Iterator[CameraEvidence]:
        for window in windows:
            at = window.kept
            assembly = opened(at.start, at.stop)
            assembly.take_cameras(cameras.now)
            for form in assembly.camera_evidence(state.window(at)):
                yield replace(form, frames=form.frames + at.start)
            del assembly, form  # before the next window is opened
            return_freed_memory()

    correction = cameras.solve(evidence(), len(state))
    if cameras.take(correction):
        log.info("cameras corrected by up to %.1f mm", 1e3 * correction.shift)
        return state.moved(limited(correction.along))
    log.warning(
        "body and object would move a camera by %.0f mm, far more than the scene's standard "
        "deviations: all cameras stay as in scene.h5; check their poses, the body and the object",
        1e3 * correction.shift,
    )
    return state


@dataclass
class _WindowFit:
    """Fit of a window of T frames after the rounds so far; see :class:`JointFit`."""

    state: State
    contact: ContactEstimate
    stalled: np.ndarray  # (T,) frames that no round moved, since each step raised the energy there
    energy_before: dict[str, np.ndarray] = field(default_factory=dict)  # (T,) by term
    energy_after: dict[str, np.ndarray] = field(default_factory=dict)  # (T,) by term
    steps: int = 0
    refused: int = 0
    last_step_m: float = 0.0
    last_decrease: float = 0.0
    unchanged: bool = False  # The last round hardly changed state and contact
    residuals: BodyResiduals = field(init=False)  # Of the final state
    faults: FrameFaults = field(init=False)  # Of the final state

    @property
    def convergence(self) -> Convergence:
        """Outcome so far."""
        if self.unchanged:
            return Convergence.CONVERGED
        if self.steps == 0 and self.refused > 0:
            return Convergence.STALLED
        return Convergence.ITERATION_LIMIT

    def minimise(
        self,
        assembly: Assembly,
        geometry: Geometry,
        contact_at: Callable[[State], ContactEstimate],
        max_steps: int,
    ) -> None:
        """Update correspondences, minimise, and estimate contact again."""
        before, contact = self.state, self.contact
        if assembly.contact is not None:
            assembly.contact.take_contact(contact.probability, contact.labels)
        assembly.problem.refresh(before)
        minimum = minimise(assembly.problem, before, max_steps=max_steps)
        self.state = minimum.state
        self.steps, self.refused = self.steps + minimum.steps, self.refused + minimum.refused
        self.energy_before = self.energy_before or minimum.energies_before
        self.energy_after = minimum.energies
        self.last_step_m = _displacement(geometry, minimum.previous, minimum.state)
        self.last_decrease = minimum.decrease
        self.stalled &= minimum.stalled
        log.info("%d steps, energy %.4g", self.steps, sum(map(np.sum, minimum.energies.values())))
        settled = minimum.converged or minimum.steps > 0  # not each step was refused
        self.contact = contact_at(self.state)
        changed_m = _displacement(geometry, before, self.state)
        # the limit of the contact probability is tuned on the studio
        contact_change = self.contact.change(contact)
        self.unchanged = settled and changed_m < UNCHANGED_M and contact_change < 0.1


def _fit_window(
    inputs: JointInputs,
    assembly: Assembly,
    start: State,
    contact_at: Callable[[State], ContactEstimate],
) -> _WindowFit:
    """Minimise the energy of a window from ``start``; ``contact_at`` estimates contact."""
    fit = _WindowFit(start, contact_at(start), np.ones(len(start), bool))
    for max_steps in ROUND_STEPS:
        fit.minimise(assembly, inputs.geometry, contact_at, max_steps)
        if fit.convergence == Convergence.CONVERGED:
            break
    log.log(
        logging.WARNING if fit.convergence == Convergence.STALLED else logging.INFO,
        "%s: %d steps accepted, %d refused, %d frames stalled",
        fit.convergence.value,
        fit.steps,
        fit.refused,
        fit.stalled.sum(),
    )
    stalled = fit.stalled | (fit.convergence == Convergence.STALLED)
    fit.faults = FrameFaults.of(inputs, fit.state, stalled, assembly.contradicted())
    assembly.body.compare(fit.state)
    fit.residuals = assembly.body.residuals()
    return fit


def _joined(
    inputs: JointInputs,
    windows: Sequence[Window],
    fits: Sequence[_WindowFit],
    annotated: AnnotatedContact | None,
    *,
    cameras_corrected: bool,
) -> JointFit:
    """Join the kept frames of all windows. Steps, and their sizes, are the largest of a window."""

    def joined(part: Callable[[_WindowFit], object]) -> dict[str, np.ndarray]:
        """Join the arrays (T, ...) among the attributes of a part of the fits."""
        parts = [vars(part(fit)) for fit in fits]
        return {name: join(windows, [values[name] for values in parts]) for name in parts[0]}

    def total(energies: Sequence[dict[str, np.ndarray]]) -> dict[str, float]:
        return {
            name: float(join(windows, [of.get(name, np.zeros(0)) for of in energies]).sum())
            for name in {name: None for of in energies for name in of}
        }

    first = fits[0].state
    state = first.joined([fit.state.window(w.inner) for fit, w in zip(fits, windows, strict=True)])
    contact = ContactEstimate(**joined(lambda fit: fit.contact))
    issues = []
    if annotated is not None and inputs.geometry.has_object:
        issues = annotated.issues(contact, inputs.sequential.flags)
    outcomes = {fit.convergence for fit in fits}
    return JointFit(
        state=state,
        contact=contact,
        issues=issues,
        residuals=BodyResiduals(**joined(lambda fit: fit.residuals)),
        energy_before=total([fit.energy_before for fit in fits]),
        energy_after=total([fit.energy_after for fit in fits]),
        steps=max(fit.steps for fit in fits),
        refused=max(fit.refused for fit in fits),
        convergence=outcomes.pop() if len(outcomes) == 1 else Convergence.ITERATION_LIMIT,
        flags=fit_flags(inputs, FrameFaults(**joined(lambda fit: fit.faults)), issues),
        cameras_corrected=cameras_corrected,
        last_step_m=max(fit.last_step_m for fit in fits),
        last_decrease=max(fit.last_decrease for fit in fits),
    )


def _displacement(geometry: Geometry, before: State, after: State) -> float:
    """Displacement of body and object between two states, metres.

    It is the larger of the skin's mean and of the object's centre in each frame, and the 95th
    percentile over frames.
    """
    skin = np.linalg.norm(geometry.at(after).skin - PosedGeometry(geometry, before).skin, axis=2)
    centre = np.linalg.norm(after.translation - before.translation, axis=1)
    return float(np.percentile(np.fmax(skin.mean(axis=1), centre), 95))
