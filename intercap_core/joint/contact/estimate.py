"""Contact by region at a state of the joint fit: detected, annotated or switched off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.config import ContactInterval, JointSettings
from intercap_core.joint.contact.annotated import Oddity, annotation_evidence, oddities
from intercap_core.joint.contact.detect import (
    RegionMotion,
    contact_probability,
    held,
    region_motion,
)
from intercap_core.joint.floor import Ground
from intercap_core.joint.geometry import Geometry
from intercap_core.joint.sequential import SequentialFits
from intercap_core.joint.state import State
from intercap_core.schemas import CONTACT_REGIONS


@dataclass(frozen=True)
class ContactEstimate:
    """``probability`` (T, R), NaN without an object, the ``labels`` (T, R) of the annotation, -1
    where none, and what is odd about the annotation."""

    probability: np.ndarray
    labels: np.ndarray
    oddities: Sequence[Oddity] = ()

    def change(self, other: ContactEstimate) -> float:
        """The largest difference of probabilities; 0 without an object."""
        return float(np.nanmax(np.abs(self.probability - other.probability), initial=0.0))

    def distrust(self) -> list[tuple[np.ndarray, str]]:
        """Frames (T,) that an annotation makes doubtful, each with the reason in words."""
        frames = np.arange(len(self.probability))
        return [
            (np.isin(frames, list(odd.frames)), odd.text) for odd in self.oddities if odd.distrusted
        ]


class ContactEstimator:
    """Estimates contact between the rounds of a joint fit.

    ``intervals`` are the annotated contacts, None where contact is to be detected.
    """

    def __init__(
        self,
        geometry: Geometry,
        sequential: SequentialFits,
        floor: Ground | None,
        fps: float,
        settings: JointSettings,
        intervals: Sequence[ContactInterval] | None,
    ) -> None:
        self._geometry, self._sequential, self._floor = geometry, sequential, floor
        self._fps, self._settings, self._intervals = fps, settings, intervals
        self._unseen = sequential.flags.filled | sequential.flags.lost

    def at(self, state: State) -> ContactEstimate:
        """Contact by region at ``state``."""
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
        odd = oddities(self._intervals, CONTACT_REGIONS, motion.distance, self._unseen)
        return ContactEstimate(probability, labels, odd)

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
        """Frames (T,) in which something holds the object; None where no floor says what is up."""
        if self._floor is None:
            return None
        vertices = self._geometry.at(state).object_vertices
        height = np.minimum(self._floor.heights(vertices), 0.0).min(axis=1)
        centre = self._geometry.at(state).moments[0].mean(axis=1)
        off = held(centre, height, self._floor.normal, self._fps)
        return off & ~self._sequential.flags.lost
