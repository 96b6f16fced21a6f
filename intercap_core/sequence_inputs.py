"""Inputs of one sequence that several stages take: artefacts, models and settings of the fits."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from intercap_core.config import BodyFitSettings, BodyModels, JointSettings, ObjectTrackSettings
from intercap_core.entries import ObjectEntry, SubjectEntry

NOT_AN_INPUT = Path("not-an-input.h5")
"""Path of an artefact that the caller did not supply; opening it fails."""


@dataclass(frozen=True, kw_only=True)
class SequencePaths:
    """Paths of one sequence's artefacts, named after the stage that writes each.

    A stage gets the artefacts that it declares in ``Stage.reads``; all others are
    ``NOT_AN_INPUT``.
    """

    frames: Path = NOT_AN_INPUT
    """Synchronised frame sets with images."""
    detections: Path = NOT_AN_INPUT
    """2D keypoints and segmentation candidates."""
    scene: Path = NOT_AN_INPUT
    """Camera poses, ground plane and background depth."""
    person: Path = NOT_AN_INPUT
    """Keypoints and masks of the subject."""
    object_track: Path = NOT_AN_INPUT
    """Object poses of the sequential fit."""
    body_fit: Path = NOT_AN_INPUT
    """Body parameters of the sequential fit."""
    joint: Path = NOT_AN_INPUT
    """Body, object and contact of the joint fit."""
    metrics: Path = NOT_AN_INPUT
    """Distances, errors and flags."""

    def by_stage(self) -> dict[str, Path]:
        """The supplied paths by stage, in the order in which the stages run."""
        return {name: path for name, path in vars(self).items() if path != NOT_AN_INPUT}


@dataclass(frozen=True)
class SequenceModels:
    """The models that are fitted to one sequence."""

    object_: ObjectEntry | None
    """Entry of the object with its mesh; None for a person without an object."""
    subject: SubjectEntry
    """Row of the subject, which names the gender."""
    body_models: BodyModels
    """Body files by gender, and the pose prior."""

    @property
    def gender(self) -> str:
        """Gender of the subject's body model."""
        return self.subject.gender


@dataclass(frozen=True)
class FitSettings:
    """Settings of the three fits. The joint fit repeats parts of both sequential fits."""

    joint: JointSettings
    """Settings of the joint fit."""
    body_fit: BodyFitSettings
    """Settings of the body fit, whose residuals the joint fit uses again."""
    object_track: ObjectTrackSettings
    """Settings of the object track: comparison of rendered and observed images."""
