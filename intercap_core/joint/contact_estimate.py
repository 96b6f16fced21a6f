"""Contact of each region at a state of the joint fit: detected, annotated or switched off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.annotation import ContactInterval
from intercap_core.config import JointSettings
from intercap_core.joint.contact.annotated import (
    AnnotationIssue,
    annotation_evidence,
    find_issues,
    hold_exactly,
)
from intercap_core.joint.contact.detect import contact_probability, region_motion
from intercap_core.joint.inputs import JointInputs
from intercap_core.joint.state import State
from intercap_core.schemas import CONTACT_REGIONS


@dataclass(frozen=True)
class ContactEstimate:
    """Contact of R regions in T frames."""

    probability: np.ndarray  # (T, R); NaN without an object
    labels: np.ndarray  # (T, R) annotation: 1 touching, 0 free, -1 no label
    issues: Sequence[AnnotationIssue] = ()  # Annotated intervals that the fit contradicts

    def change(self, other: ContactEstimate) -> float:
        """Largest difference of a probability in each frame, 95th percentile; 0 without an object.
        """
        change = np.abs(self.probability - other.probability).max(axis=1)
        return float(np.nan_to_num(np.percentile(change, 95)))

    def doubtful_frames(self) -> list[tuple[np.ndarray, str]]:
        """Masks (T,) of frames that an annotation makes doubtful, each with its reason."""
        frames = np.arange(len(self.probability))
        return [
            (np.isin(frames, list(issue.frames)), issue.text)
            for issue in self.issues
            if issue.distrusted
        ]


def estimate_contact(
    inputs: JointInputs,
    settings: JointSettings,
    intervals: Sequence[ContactInterval] | None,
    state: State,
) -> ContactEstimate:
    """Estimate contact at ``state``.

    ``intervals`` are the annotated contacts. If they are None, contact is detected, or 0 everywhere
    if the setting ``detect_contact`` is off.
    """
    geometry, sequential = inputs.geometry, inputs.sequential
    shape = (len(state), len(CONTACT_REGIONS))
    labels = np.full(shape, -1, np.int8)
    if not geometry.has_object:
        return ContactEstimate(np.full(shape, np.nan), labels)
    if intervals is None and not settings.detect_contact:
        return ContactEstimate(np.zeros(shape), labels)
    posed, at_patch = geometry.at(state), geometry.skin.patch
    motion = region_motion(
        geometry.patches,
        posed.skin[:, at_patch],
        posed.proximity.at(at_patch),
        state.rotation,
        state.translation,
        sequential.joint_sigma,
        sequential.object_sigma,
        inputs.fps,
    )
    detected = contact_probability(motion, inputs.fps)
    if intervals is None:
        return ContactEstimate(detected, labels)
    given, labels = annotation_evidence(
        intervals, CONTACT_REGIONS, len(state), settings.annotation_uncertainty_frames
    )
    unseen = sequential.flags.filled | sequential.flags.lost
    return ContactEstimate(
        hold_exactly(contact_probability(motion, inputs.fps, given=given), given),
        labels,
        find_issues(intervals, CONTACT_REGIONS, given, detected, motion.distance, unseen),
    )
