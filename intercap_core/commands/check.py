"""Faults of single sequences: what would fail in the first minutes of a run, found before it."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from intercap_core.config import Annotation, DetectionsSettings, FramesSettings, SequenceEntry
from intercap_core.errors import UserError
from intercap_core.project import Project, tidy

if TYPE_CHECKING:
    from intercap_core.commands.check_recordings import Looked
    from intercap_core.formats.recordings.source import RecordingLayout

LABELS_TOLD = 8  # labels that a note names


@dataclass(frozen=True)
class Fault:
    """What is wrong with one sequence, or with a file that belongs to none ("")."""

    sequence: str
    message: str

    def __str__(self) -> str:
        return f"sequence {self.sequence!r}: {self.message}" if self.sequence else self.message


def check_bodies(project: Project) -> None:
    """Open the body files and the priors of pose and motion that the settings name.

    Raises UserError where one cannot be opened: every sequence would fail by it, hours later.
    """
    lemo = project.config.joint.lemo_files
    if lemo is not None:
        from intercap_core.body.lemo import MotionEncoder

        MotionEncoder.load(*lemo)
    models = project.config.body_models
    genders = {project.subjects[row.subject].gender for row in project.sequences.values()}
    files = sorted({path for gender in genders if (path := models.of(gender)) is not None})
    if not files and models.vposer is None:
        return  # without importing what opens them
    from intercap_core.body.artefact import load_pose_prior
    from intercap_core.body.model import BodyModel
    from intercap_core.body.plausible import check_body

    for path in files:
        check_body(BodyModel.load(path))
    if models.vposer is not None:
        load_pose_prior(models, BodyModel.load())


def check_detector(project: Project) -> list[Fault]:
    """Open the models that the settings name; notes of objects that segmentation does not know.

    Raises UserError where one cannot be run here.
    """
    settings = project.config.detections
    if settings.keypoint_model is not None:
        from intercap_core.formats.detections.models.onnx_pose import PoseModel

        PoseModel.load(settings)
    if settings.segmentation_model is None:
        return []
    from intercap_core.formats.detections.models.onnx_segmentation import Segmenter

    classes = Segmenter.load(settings).classes
    return [
        Fault(
            "",
            f"{settings.segmentation_model}: none of its {len(classes)} classes "
            f"({_told(classes)}) is a label of object {name!r} "
            f"({', '.join(project.objects[name].labels)}); add the label to objects.yaml, or name "
            "the model's classes in detections.segmentation_labels",
        )
        for name in project.objects_named()
        if project.objects[name].labels and not {*project.objects[name].labels} & {*classes}
    ]


def _told(labels: list[str]) -> str:
    more = f" and {len(labels) - LABELS_TOLD} more" if len(labels) > LABELS_TOLD else ""
    return ", ".join(labels[:LABELS_TOLD]) + more


@dataclass
class Findings:
    """Faults of all sequences, what a run survives, and each good recording in one line."""

    faults: list[Fault] = field(default_factory=list)
    notes: list[Fault] = field(default_factory=list)
    summaries: list[Fault] = field(default_factory=list)


def faults_of_sequences(project: Project) -> list[Fault]:
    """The faults alone of :func:`check_sequences`."""
    return check_sequences(project).faults


def check_sequences(project: Project) -> Findings:
    """Check what every sequence needs: annotation, files, mesh, poses, a look at its recordings.

    Recordings that the studio is to make are not missed, but it must be able to make them. Of
    images a few are read.
    """
    found = Findings()
    meshes = {name: _look_at_mesh(project, name, found) for name in project.objects_named()}
    faults = found.faults
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
        looked = _look_at_files(row, project.config.frames)
        faults += [Fault(name, message) for message in looked.faults]
        found.notes += [Fault(name, message) for message in looked.notes]
        found.summaries += [Fault(name, looked.summary)] if looked.summary else []
    return found


def fault_of_cameras(project: Project, name: str, annotation: Annotation) -> str | None:
    """Say which entry of the annotation is of no camera of the recordings, where those can be
    looked at and no frames have been read of them; what else is wrong with them is told elsewhere.
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
    """Say what a run survives and hardly anybody means: cameras without recording or detections.

    Recordings that the studio makes are not looked at, nor are those that cannot be used at all.
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
    from intercap_core.formats.detections.candidate_files import has_candidates
    from intercap_core.formats.detections.keypoint_files import has_keypoints
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
            f"{', '.join(absent)}: add these recordings, or correct their names, if there are any"
        )
    recorded = [name for name in known if name in layout.names]
    beside = row.layout == "behave"
    settings = project.config.detections
    segmented = settings.segmentation_model is not None
    modelled = segmented or settings.keypoint_model is not None
    nothing = row.keypoints is None and row.candidates is None and not beside and not modelled
    if nothing and recorded:
        notes.append(
            "its row names neither keypoints nor candidates, without which only the frames can be "
            "computed; run the detectors and add the columns"
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
        notes += _notes_of_keypoints(settings, folder, layout, having)
    if row.candidates is not None and row.candidates.is_dir():
        folder = row.candidates
        having = [name for name in recorded if has_candidates(folder, name, row.layout)]
        without = [name for name in recorded if name not in having and not segmented]
        notes += [f"{folder} has no {name}.json; add this camera's candidates" for name in without]
        notes += _notes_of_candidates(project, row, layout, having)
    return notes


def _notes_of_keypoints(
    settings: DetectionsSettings,
    folder: Path,
    layout: RecordingLayout,
    cameras: list[str],
) -> list[str]:
    """What a look at the first people of each camera shows: their form, place and confidence."""
    from intercap_core.formats.detections.keypoint_files import look_at_keypoints

    notes: list[str] = []
    for name in cameras:
        size = _colour_size(layout, name)
        if size is not None:
            full = settings.keypoint_full_confidence
            notes += look_at_keypoints(folder, name, size=size, full_confidence=full)
    return notes


def _colour_size(layout: RecordingLayout, camera: str) -> tuple[int, int] | None:
    """Width and height of a camera's images, None = told as a fault elsewhere."""
    try:
        with layout.open(camera) as recording:
            return recording.camera.colour.width, recording.camera.colour.height
    except UserError:
        return None


def _notes_of_candidates(
    project: Project,
    row: SequenceEntry,
    layout: RecordingLayout,
    cameras: list[str],
) -> list[str]:
    """What a look at the first results of each camera shows: their form, size and labels."""
    from intercap_core.formats.detections.candidate_files import look_at_candidates
    from intercap_core.formats.detections.class_names import class_names

    assert row.candidates is not None
    settings = project.config.detections
    notes: list[str] = []
    labels: set[str] = set()
    for name in cameras:
        size = _colour_size(layout, name)
        if size is None:
            continue
        seen = look_at_candidates(
            row.candidates, name, size=size, names=class_names(settings.category_names)
        )
        notes += seen.notes
        labels |= seen.labels
    entry = project.object_of(row.sequence)
    expected = () if entry is None else entry.labels
    if labels and expected and not labels & {*expected}:
        found = sorted(label or "no label" for label in labels)
        notes.append(
            f"{row.candidates}: the first results are labelled {_told(found)}, none of which "
            f"object {row.object!r} expects ({', '.join(expected)}); add its labels to "
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


def _look_at_mesh(project: Project, name: str, found: Findings) -> str | None:
    """Why an object's mesh cannot be used; what is said of one that can is noted."""
    from intercap_core.geometry.rigid import mesh

    said = _Kept()
    mesh.log.addHandler(said)
    mesh.log.propagate = False
    try:
        mesh.ObjectMesh.load(project.objects[name])
    except UserError as error:
        return str(error)
    finally:
        mesh.log.removeHandler(said)
        mesh.log.propagate = True
    found.notes += [Fault("", text) for text in said.texts]
    return None


class _Kept(logging.Handler):
    """Keeps what is logged."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the record's words."""
        self.texts.append(record.getMessage())


def _faults_of_capture(project: Project, name: str) -> list[str]:
    from intercap_core.studio.stage import check_capture

    settings = project.config.studio
    assert settings is not None
    try:
        check_capture(settings.captures[name], settings, project.sequences[name].object)
    except UserError as error:
        return [f"{project.path}: {error}"]
    return []


def _look_at_files(row: SequenceEntry, settings: FramesSettings) -> Looked:
    from intercap_core.commands.check_recordings import Looked

    faults = []
    for column in ("calibration", "keypoints", "candidates", "results", "truth"):
        path = getattr(row, column)
        if path is not None and not path.exists():
            faults.append(f"column {column} says {path}, which is not there")
    if row.truth is not None and row.truth.exists():
        faults += faults_of_truth(row.truth)
    if not row.recordings.is_dir():
        return Looked(faults=[f"there is no folder {row.recordings} of recordings", *faults])
    looked = _look_at_recordings(row, settings) if row.calibration.exists() else Looked()
    looked.faults[:0] = faults
    return looked


def faults_of_truth(path: Path) -> list[str]:
    """Why a file that the table names as truth is none."""
    from intercap_core import artefacts
    from intercap_core.schemas import TRUTH

    try:
        with artefacts.read(path, TRUTH):
            return []
    except UserError as error:
        return [f"column truth says a file that holds none: {error}"]


def _look_at_recordings(row: SequenceEntry, settings: FramesSettings) -> Looked:
    from intercap_core.commands.check_recordings import Looked, look_at_recordings
    from intercap_core.formats.recordings.layouts import open_layout

    try:
        layout = open_layout(row)
    except UserError as error:
        return Looked(faults=[str(error)])
    if not layout.names:
        return Looked(
            faults=[f"{row.recordings} holds no camera's recording in the layout {row.layout}"]
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
    looked = look_at_recordings(row, layout, posed, without_depth=not settings.depth)
    looked.faults[:0] = faults
    return looked
