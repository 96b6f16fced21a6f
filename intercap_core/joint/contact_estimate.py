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
from intercap_core.joint.sequential import SequentialFlags
from intercap_core.joint.state import State
from intercap_core.schemas import CONTACT_REGIONS


@dataclass(frozen=True)
class AnnotatedContact:
    """Annotated contacts of T frames; see :func:`.annotated.annotation_evidence`."""

    intervals: Sequence[ContactInterval]  # Of the whole recording
    evidence: np.ndarray  # (T, R) log odds
    labels: np.ndarray  # (T, R) 1 touching, 0 free, -1 no label

    @classmethod
    def of(
        cls, intervals: Sequence[ContactInterval], frames: int, uncertainty: int
    ) -> AnnotatedContact:
        """The annotation of a recording of ``frames`` frames; ``uncertainty`` of ends in frames."""
        return cls(intervals, *annotation_evidence(intervals, CONTACT_REGIONS, frames, uncertainty))

    def window(self, frames: slice) -> AnnotatedContact:
        """The annotation of some frames."""
        return AnnotatedContact(self.intervals, self.evidence[frames], self.labels[frames])

    def issues(self, estimate: ContactEstimate, flags: SequentialFlags) -> list[AnnotationIssue]:
        """Annotated intervals of the whole recording that ``estimate`` contradicts."""
        unseen = flags.filled | flags.lost
        evidence, detected, distance = self.evidence, estimate.detected, estimate.distance
        return find_issues(self.intervals, CONTACT_REGIONS, evidence, detected, distance, unseen)


@dataclass(frozen=True)
class ContactEstimate:
    """Contact of R regions in T frames. Without an object all but the labels are NaN."""

    probability: np.ndarray  # (T, R)
    labels: np.ndarray  # (T, R) annotation: 1 touching, 0 free, -1 no label
    detected: np.ndarray  # (T, R) probability by the geometry alone
    distance: np.ndarray  # (T, R) of each region to the object, metres

    def change(self, other: ContactEstimate) -> float:
        """Largest difference of a probability, 95th percentile over frames; 0 if unknown."""
        change = np.abs(self.probability - other.probability).max(axis=1)
        return float(np.nan_to_num(np.percentile(change, 95)))


def estimate_contact(
    inputs: JointInputs, settings: JointSettings, annotated: AnnotatedContact | None, state: State
) -> ContactEstimate:
    """Estimate contact at ``state``.

    If ``annotated`` is None, contact is detected, or 0 everywhere if the setting
    ``detect_contact`` is off.
    """
    geometry, sequential = inputs.geometry, inputs.sequential
    shape = (len(state), len(CONTACT_REGIONS))
    labels, unknown = np.full(shape, -1, np.int8), np.full(shape, np.nan)
    if not geometry.has_object:
        return ContactEstimate(unknown, labels, unknown, unknown)
    if annotated is None and not settings.detect_contact:
        return ContactEstimate(np.zeros(shape), labels, unknown, unknown)
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
    if annotated is None:
        return ContactEstimate(detected, labels, detected, motion.distance)
    given = annotated.evidence
    probability = hold_exactly(contact_probability(motion, inputs.fps, given=given), given)
    return ContactEstimate(probability, annotated.labels, detected, motion.distance)
