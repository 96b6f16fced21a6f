"""Rows of the tables of sequences and subjects, and entries of the objects file.

Relative paths are relative to the folder of the table.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import (
    Field,
    model_validator,
)

from intercap_core.config_types import (
    LayoutName,
    Metres,
    Model,
    Name,
    ObjectName,
    Position,
    Positive,
    SequenceName,
    Vector3,
)


class SequenceEntry(Model):
    """One row of sequences.tsv."""

    sequence: SequenceName
    """Name of the sequence; letters, digits, _ and - only."""
    subject: Name
    """Row of subjects.tsv."""
    object: Name | None = None
    """Key of objects.yaml; empty = a person without an object."""
    intent: Name | None = None
    """Instruction to the person, such as use or pass; empty = not stated. Used to group
    statistics."""
    recordings: Path
    """Folder of the recordings, with one file or folder per camera."""
    layout: LayoutName = "k4a"
    """Layout of the recordings: k4a = Azure Kinect files; ros = bags of ROS; intercap, behave =
    files of these releases; plain = images and videos. See docs/recordings.md."""
    topics: str | None = None
    """Topics of a bag to use if a camera has several streams of one kind, separated by spaces."""
    calibration: Path
    """File or folder of the camera calibration: the layout's own format (docs/recordings.md), or a
    file of Pose2Sim, Anipose, EasyMocap, COLMAP or nerfstudio."""
    calibration_scale: Positive | None = None
    """Metres per unit of the calibration, for formats without a fixed unit."""
    calibration_up: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None
    """Axis of the calibration's world frame that points up; empty = unknown."""
    calibration_floor: Metres | None = None
    """Height of the floor above the origin of the calibration's world frame, metres; only with
    calibration_up."""
    keypoints: Path | None = None
    """Folder of human keypoints: <camera>/<image>_keypoints.json (OpenPose), or <camera>.json or
    <camera>/<image>.json (COCO-WholeBody); see docs/detectors.md."""
    candidates: Path | None = None
    """Folder of <camera>.json files: instance segmentation in COCO's result format."""
    results: Path | None = None
    """Another program's results for this sequence, in the master camera's frame; they replace the
    joint fit in metrics and pages. InterCap's res.pkl or its folder, or BEHAVE's sequence folder
    with its registrations. See docs/releases.md."""
    truth: Path | None = None
    """Truth file of a virtual recording; read by the metrics only."""
    annotation: Path | None = None
    """Annotation file of this sequence; default: <sequence>.yaml in the folder of annotations, if
    it exists."""
    rig_from: SequenceName | None = None
    """Sequence of the same, unmoved cameras. Its refined camera poses and depth biases are the
    start and, with their covariance, the prior of the stage scene. See docs/usage.md, Reuse over a
    day."""
    shape_from: SequenceName | None = None
    """Sequence of the same subject in the same clothes. Its shape and coverings are the start and,
    with their covariance, the prior of the stage body_fit. See docs/usage.md, Reuse over a day."""

    @model_validator(mode="after")
    def _floor_needs_up(self) -> SequenceEntry:
        if self.calibration_floor is not None and self.calibration_up is None:
            raise ValueError(
                "calibration_floor is set without calibration_up, the axis of its measurement"
            )
        return self


class SubjectEntry(Model):
    """One row of subjects.tsv."""

    subject: Name
    """Name of the person."""
    gender: Literal["female", "male", "neutral"]
    """Body file, or shape prior of the open body; neutral = prior of all people."""
    height: Annotated[float, Field(ge=0.5, le=2.6)] | None = None
    """Height without shoes, metres, with a standard deviation of 2 cm; empty = unknown."""


class ContinuousSymmetry(Model):
    """Axis of rotational symmetry, as in BOP's models_info."""

    axis: Vector3
    """Unit axis in the mesh's frame."""
    offset: Position = (0.0, 0.0, 0.0)
    """Point on the axis, metres."""


class Symmetry(Model):
    """Transforms that do not change the object's appearance."""

    discrete: tuple[Annotated[tuple[float, ...], Field(min_length=16, max_length=16)], ...] = ()
    """4x4 transforms in row-major order, metres; the identity is implied."""
    continuous: tuple[ContinuousSymmetry, ...] = ()
    """Axes of rotational symmetry."""
    sphere: bool = False
    """Invariance to all rotations about the mesh's origin."""


class ObjectEntry(Model):
    """One entry of objects.yaml."""

    name: ObjectName
    """Key of the entry."""
    mesh: Path
    """Watertight mesh in metres (.ply or .obj)."""
    contact_vertices: Path | None = None
    """Vertices of likely contact: a JSON list of indices, a JSON object with the list and the
    checksum of its mesh, or a pickle as in InterCap's release."""
    symmetry: Symmetry = Symmetry()
    """Symmetry group."""
    labels: tuple[str, ...] = ()
    """Detector classes of this object (COCO names); empty = any."""
