"""Contact of each region at a state of the joint fit: detected, annotated or switched off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.annotation import ContactInterval
from intercap_core.config import JointSettings
from intercap_core.joint.contact.annotated import AnnotationIssue, annotation_evidence, find_issues
from intercap_core.joint.contact.detect import (
    RegionMotion,
    contact_probability,
    find_held,
    region_motion,
)
from intercap_core.joint.floor import FloorPlane
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.sequential import SequentialFits
from intercap_core.joint.state import State
from intercap_core.schemas import CONTACT_REGIONS


@dataclass(frozen=True)
class ContactEstimate:
    """Contact of R regions in T frames."""

    probability: np.ndarray
    """(T, R); NaN without an object."""
    labels: np.ndarray
    """(T, R) annotation: 1 touching, 0 free, -1 no label."""
    issues: Sequence[AnnotationIssue] = ()
    """Implausible annotated intervals."""

    def change(self, other: ContactEstimate) -> float:
        """Largest difference of a probability; 0 without an object."""
        return float(np.nanmax(np.abs(self.probability - other.probability), initial=0.0))

    def distrust(self) -> list[tuple[np.ndarray, str]]:
        """Masks (T,) of frames that an annotation makes doubtful, each with its reason."""
        frames = np.arange(len(self.probability))
        return [
            (np.isin(frames, list(issue.frames)), issue.text)
            for issue in self.issues
            if issue.distrusted
        ]


class ContactEstimator:
    """Estimates contact between the rounds of a joint fit."""

    def __init__(
        self,
        geometry: Geometry,
        sequential: SequentialFits,
        floor: FloorPlane | None,
        fps: float,
        settings: JointSettings,
        intervals: Sequence[ContactInterval] | None,
    ) -> None:
        """``intervals`` are the annotated contacts; None to detect contact."""
        self._geometry, self._sequential, self._floor = geometry, sequential, floor
        self._fps, self._settings, self._intervals = fps, settings, intervals
        self._unseen = sequential.flags.filled | sequential.flags.lost

    def at(self, state: State) -> ContactEstimate:
        """Contact of each region at ``state``."""
        shape = (len(state), len(CONTACT_REGIONS))
        if not self._geometry.has_object:
            return ContactEstimate(np.full(shape, np.nan), np.full(shape, -1, np.int8))
        if self._intervals is None and not self._settings.detect_contact:
            return ContactEstimate(np.zeros(shape), np.full(shape, -1, np.int8))
        motion, held_in = self._observe(state), self._held(state)
        if self._intervals is None:
            probability = contact_probability(motion, self._fps, held=held_in)
            return ContactEstimate(probability, np.full(shape, -1, np.int8))
        given, labels = annotation_evidence(
            self._intervals,
            CONTACT_REGIONS,
            len(state),
            self._settings.annotation_uncertainty_frames,
        )
        probability = contact_probability(motion, self._fps, given=given, held=held_in)
        issues = find_issues(self._intervals, CONTACT_REGIONS, motion.distance, self._unseen)
        return ContactEstimate(probability, labels, issues)

    def _observe(self, state: State) -> RegionMotion:
        posed, at_patch = self._geometry.at(state), self._geometry.skin.patch
        return region_motion(
            self._geometry.patches,
            posed.skin[:, at_patch],
            posed.proximity.at(at_patch),
            state.rotation,
            state.translation,
            self._sequential.joint_sigma,
            self._sequential.object_sigma,
            self._fps,
        )

    def _held(self, state: State) -> np.ndarray | None:
        """Mask (T,) of frames in which something holds the object; None without a floor."""
        if self._floor is None:
            return None
        vertices = self._geometry.at(state).object_vertices
        # clipped at 0 like the residuals of E_G', so that no frame counts as lifted
        height = np.minimum(self._floor.heights(vertices), 0.0).min(axis=1)
        centre = self._geometry.at(state).moments[0].mean(axis=1)
        held = find_held(centre, height, self._floor.normal, self._fps)
        return held & ~self._sequential.flags.lost
