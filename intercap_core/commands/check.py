"""`intercap check`: find faults of settings, tables and recordings before a run does."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from intercap_core.annotation import Annotation
from intercap_core.config import FramesSettings
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.project import Project, tidy

if TYPE_CHECKING:
    from intercap_core.commands.check_recordings import RecordingFindings
    from intercap_core.formats.recordings.source import RecordingLayout


@dataclass(frozen=True)
class Fault:
    """A finding on one sequence or on the project: a fault, a note or a summary."""

    sequence: str
    """Name of the sequence; "" for a finding on the project."""
    message: str
    """Text that names file, finding, expectation and next step."""

    def __str__(self) -> str:
        return f"sequence {self.sequence!r}: {self.message}" if self.sequence else self.message


def check_bodies(project: Project) -> None:
    """Open the body files and the pose and motion priors that the settings name.

    Raises UserError if one of them cannot be opened.
    """
    lemo = project.config.joint.lemo_files
    if lemo is not None:
        from intercap_core.body.lemo import MotionEncoder

        MotionEncoder.load(*lemo)
    models = project.config.body_models
    genders = {project.subjects[row.subject].gender for row in project.sequences.values()}
    files = sorted({path for gender in genders if (path := models.of(gender)) is not None})
    if not files and models.vposer is None:
        return  # without importing torch
    from intercap_core.body.artefact import load_pose_prior
    from intercap_core.body.model import BodyModel, check_body

    for path in files:
        check_body(BodyModel.load(path))
    if models.vposer is not None:
        load_pose_prior(models, BodyModel.load())


def check_detector(project: Project) -> list[Fault]:
    """Open the detectors that the settings name; returns objects without a matching class.

    Raises UserError if a model cannot run on this machine.
    """
    settings = project.config.detections
    if settings.keypoint_model is not None:
        from intercap_core.formats.detections.onnx_pose import PoseModel

        PoseModel.load(settings)
    if settings.segmentation_model is None:
        return []
    from intercap_core.formats.detections.onnx_segmentation import Segmenter

    classes = Segmenter.load(settings).classes
    return [
        Fault(
            "",
            f"{settings.segmentation_model}: none of its {len(classes)} classes "
            f"({_list_labels(classes)}) is a label of object {name!r} "
            f"({', '.join(project.objects[name].labels)}); add the label to objects.yaml, or name "
            "the model's classes in detections.segmentation_labels",
        )
        for name in project.objects_named()
        if project.objects[name].labels and not {*project.objects[name].labels} & {*classes}
    ]


def _list_labels(labels: list[str]) -> str:
    more = f" and {len(labels) - 8} more" if len(labels) > 8 else ""
    return ", ".join(labels[:8]) + more


@dataclass
class Findings:
    """Findings on all sequences."""

    faults: list[Fault] = field(default_factory=list)
    """Faults that would end a run of the sequence."""
    notes: list[Fault] = field(default_factory=list)
    """Probable mistakes that do not end a run."""
    summaries: list[Fault] = field(default_factory=list)
    """One line per usable recording."""


def faults_of_sequences(project: Project) -> list[Fault]:
    """The faults that :func:`check_sequences` finds, without its notes."""
    return check_sequences(project).faults


def check_sequences(project: Project) -> Findings:
    """Check annotation, files, mesh, camera poses and recordings of every sequence.

    Reads a few images per recording. For virtual recordings, checks that the studio can make them.
    """
    findings = Findings()
    meshes = {name: _check_mesh(project, name, findings) for name in project.objects_named()}
    faults = findings.faults
    faults += _annotations_without_sequence(project)
    for name, row in project.sequences.items():
        try:
            annotation = project.annotation(name)
            problem = fault_of_cameras(project, name, annotation)
            if problem:
                path = project.annotation_path(name)
                raise UserError(f"{path}: {problem}; correct the entry")
        except UserError as error:
            faults.append(Fault(name, str(error)))
        mesh = None if row.object is None else meshes[row.object]
        if mesh is not None:
            faults.append(Fault(name, mesh))
        if project.recordings_made(name) is not None:
            faults += [Fault(name, message) for message in _faults_of_capture(project, name)]
            continue
        recording = _check_files(row, project.config.frames)
        faults += [Fault(name, message) for message in recording.faults]
        findings.notes += [Fault(name, message) for message in recording.notes]
        findings.summaries += [Fault(name, recording.summary)] if recording.summary else []
    return findings


def fault_of_cameras(project: Project, name: str, annotation: Annotation) -> str | None:
    """Error message about an annotation entry for a camera that the recordings lack.

    None if there is no such entry, or if the recordings are virtual or cannot be opened.
    """
    from intercap_core.formats.recordings.layouts import open_layout

    row = project.sequences[name]
    if not annotation.names_cameras or project.recordings_made(name) is not None:
        return None
    try:
        extrinsics = open_layout(row).extrinsics
    except (UserError, OSError):
        return None
    return annotation.check_cameras(list(extrinsics.master_from_colour), extrinsics.master)


def notes_of_sequences(project: Project) -> list[Fault]:
    """Notes on cameras without recording or detections, which do not end a run.

    Skips virtual recordings and those that cannot be used at all.
    """
    return [
        Fault(name, message)
        for name, row in project.sequences.items()
        if project.recordings_made(name) is None
        and row.recordings.is_dir()
        and row.calibration.exists()
        for message in _notes_of_cameras(project, row)
    ]


def _notes_of_cameras(project: Project, row: SequenceEntry) -> list[str]:
    """Notes on cameras without recordings, keypoints or candidates, and on the files' contents."""
    from intercap_core.formats.detections.candidate_files import has_candidates
    from intercap_core.formats.detections.keypoint_files import has_keypoints, preview_keypoints
    from intercap_core.formats.recordings.layouts import open_layout

    try:
        layout = open_layout(row)
    except UserError:
        return []
    known = list(layout.extrinsics.master_from_colour)
    notes = []
    absent = [name for name in known if name not in layout.names]
    if absent and layout.names:
        notes.append(
            f"{row.recordings} records {', '.join(layout.names)}; {row.calibration} also has "
            f"{', '.join(absent)}: add their recordings or correct the file names if they exist"
        )
    recorded = [name for name in known if name in layout.names]
    in_recordings = row.layout == "behave"
    settings = project.config.detections
    segmented = settings.segmentation_model is not None
    has_model = segmented or settings.keypoint_model is not None
    has_files = row.keypoints is not None or row.candidates is not None or in_recordings
    if recorded and not has_files and not has_model:
        notes.append(
            "its row names neither keypoints nor candidates, so only the frames can be computed; "
            "run the detectors and add the columns"
        )
    if row.keypoints is not None and row.keypoints.is_dir():
        folder = row.keypoints
        without = [n for n in recorded if not has_keypoints(folder, n)]
        if settings.keypoint_model is None:
            notes += [
                f"{folder} has no folder {name} and no {name}.json; add this camera's keypoints"
                for name in without
            ]
        having = [name for name in recorded if name not in without]
        full = settings.keypoint_full_confidence
        for name in having:
            size = _colour_size(layout, name)
            if size is not None:
                notes += preview_keypoints(folder, name, size=size, full_confidence=full)
    if row.candidates is not None and row.candidates.is_dir():
        folder = row.candidates
        having = [name for name in recorded if has_candidates(folder, name, row.layout)]
        without = [name for name in recorded if name not in having and not segmented]
        notes += [f"{folder} has no {name}.json; add this camera's candidates" for name in without]
        notes += _notes_of_candidates(project, row, layout, having)
    return notes


def _colour_size(layout: RecordingLayout, camera: str) -> tuple[int, int] | None:
    """Width and height of a camera's images; None if its recording cannot be opened."""
    try:
        with layout.open(camera) as recording:
            return recording.camera.colour.width, recording.camera.colour.height
    except UserError:
        return None


def _notes_of_candidates(
    project: Project, row: SequenceEntry, layout: RecordingLayout, cameras: list[str]
) -> list[str]:
    """Notes on format, size and labels of the first candidates of each camera."""
    from intercap_core.formats.detections.candidate_files import preview_candidates
    from intercap_core.formats.detections.class_names import class_names

    assert row.candidates is not None
    settings = project.config.detections
    notes: list[str] = []
    labels: set[str] = set()
    for name in cameras:
        size = _colour_size(layout, name)
        if size is None:
            continue
        preview = preview_candidates(
            row.candidates, name, size=size, names=class_names(settings.category_names)
        )
        notes += preview.notes
        labels |= preview.labels
    entry = project.object_of(row.sequence)
    expected = () if entry is None else entry.labels
    if labels and expected and not labels & {*expected}:
        named = sorted(label or "no label" for label in labels)
        notes.append(
            f"{row.candidates}: the labels of the first results are {_list_labels(named)}; "
            f"object {row.object!r} expects {', '.join(expected)}; add its labels to "
            "objects.yaml, or set detections.category_names"
        )
    return notes


def _annotations_without_sequence(project: Project) -> list[Fault]:
    folder = tidy(project.path.parent / project.config.annotations)
    known = {folder / f"{name}.yaml" for name in (*project.sequences, *project.config.exclude)}
    known |= {project.annotation_path(name) for name in project.sequences}
    return [
        Fault("", f"{path}: no sequence has this annotation's name; rename it to <sequence>.yaml")
        for path in sorted(folder.glob("*.y*ml"))
        if path not in known
    ]


def _check_mesh(project: Project, name: str, findings: Findings) -> str | None:
    """Error message if an object's mesh cannot be used; warnings on a usable one become notes."""
    from intercap_core.geometry.rigid import mesh

    warnings = _LogTexts()
    mesh.log.addHandler(warnings)
    mesh.log.propagate = False
    try:
        mesh.ObjectMesh.load(project.objects[name])
    except UserError as error:
        return str(error)
    finally:
        mesh.log.removeHandler(warnings)
        mesh.log.propagate = True
    findings.notes += [Fault("", text) for text in warnings.texts]
    return None


class _LogTexts(logging.Handler):
    """Collects the texts of log records."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Append the record's text."""
        self.texts.append(record.getMessage())


def _faults_of_capture(project: Project, name: str) -> list[str]:
    """Error message if the studio cannot make the recording; [] otherwise."""
    from intercap_core.studio.stage import check_capture

    settings = project.config.studio
    assert settings is not None
    try:
        check_capture(settings.captures[name], settings, project.sequences[name].object)
    except UserError as error:
        return [f"{project.path}: {error}"]
    return []


def _check_files(row: SequenceEntry, settings: FramesSettings) -> RecordingFindings:
    """Check that the files of a row exist, then its recordings."""
    from intercap_core.commands.check_recordings import RecordingFindings

    faults = []
    for column in ("calibration", "keypoints", "candidates", "results", "truth"):
        path = getattr(row, column)
        if path is not None and not path.exists():
            faults.append(f"column {column} names {path}, which does not exist")
    if row.truth is not None and row.truth.exists():
        faults += faults_of_truth(row.truth)
    if not row.recordings.is_dir():
        return RecordingFindings(
            faults=[f"column recordings names {row.recordings}, which is not a folder", *faults]
        )
    if not row.calibration.exists():
        return RecordingFindings(faults=faults)
    findings = _check_recordings(row, settings)
    findings.faults[:0] = faults
    return findings


def faults_of_truth(path: Path) -> list[str]:
    """Error message if a file in the column truth is no truth file; [] otherwise."""
    from intercap_core import artefacts
    from intercap_core.schemas import TRUTH

    try:
        with artefacts.read(path, TRUTH):
            return []
    except UserError as error:
        return [f"column truth names a file without truth: {error}"]


def _check_recordings(row: SequenceEntry, settings: FramesSettings) -> RecordingFindings:
    """Check the names and poses of a row's cameras, then the recordings of those with a pose."""
    from intercap_core.commands.check_recordings import RecordingFindings, check_recordings
    from intercap_core.formats.recordings.layouts import open_layout

    try:
        layout = open_layout(row)
    except UserError as error:
        return RecordingFindings(faults=[str(error)])
    if not layout.names:
        return RecordingFindings(
            faults=[f"{row.recordings} contains no recording in the layout {row.layout}"]
        )
    cameras = settings.cameras
    known = list(layout.extrinsics.master_from_colour)
    faults = [
        f"the setting frames.cameras names {name!r}, {row.recordings} has {', '.join(layout.names)}"
        for name in cameras
        if name not in known and name not in layout.names
    ]
    used = [name for name in layout.names if not cameras or name in cameras]
    faults += [
        f"{row.calibration}: has no pose of {name}, which {row.recordings} records; add the camera"
        for name in used
        if name not in known
    ]
    posed = [name for name in used if name in known]
    findings = check_recordings(row, layout, posed, without_depth=not settings.depth)
    findings.faults[:0] = faults
    return findings
