"""Faults of single sequences: what would fail in the first minutes of a run, found before it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from intercap_core.config import DetectionsSettings, SequenceEntry
from intercap_core.errors import UserError
from intercap_core.project import Project, tidy

if TYPE_CHECKING:
    from intercap_core.capture.source import Layout

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
        from intercap_core.detections.models.onnx_pose import PoseModel

        PoseModel.load(settings)
    if settings.segmentation_model is None:
        return []
    from intercap_core.detections.models.onnx_segmentation import Segmenter

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


def faults_of_sequences(project: Project) -> list[Fault]:
    """Check what every sequence needs: annotation, files, mesh, poses, the heads of recordings.

    Recordings that the studio is to make are not missed, but it must be able to make them; images
    are not read.
    """
    meshes = {name: _fault_of_mesh(project, name) for name in project.objects_named()}
    faults = _annotations_without_sequence(project)
    for name, row in project.sequences.items():
        try:
            project.annotation(name)
        except UserError as error:
            faults.append(Fault(name, str(error)))
        mesh = None if row.object is None else meshes[row.object]
        if mesh is not None:
            faults.append(Fault(name, mesh))
        if project.recordings_made(name) is not None:
            faults += [Fault(name, message) for message in _faults_of_capture(project, name)]
            continue
        cameras = project.config.frames.cameras
        faults += [Fault(name, message) for message in _faults_of_files(row, cameras)]
    return faults


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
    from intercap_core.capture.layouts import open_layout
    from intercap_core.detections.candidate_files import has_candidates
    from intercap_core.detections.keypoint_files import has_keypoints

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
    layout: Layout,
    cameras: list[str],
) -> list[str]:
    """What a look at the first people of each camera shows: their form, place and confidence."""
    from intercap_core.detections.keypoint_check import look_at_keypoints

    notes: list[str] = []
    for name in cameras:
        size = _colour_size(layout, name)
        if size is not None:
            full = settings.keypoint_full_confidence
            notes += look_at_keypoints(folder, name, size=size, full_confidence=full)
    return notes


def _colour_size(layout: Layout, camera: str) -> tuple[int, int] | None:
    """Width and height of a camera's images, None = told as a fault elsewhere."""
    try:
        with layout.open(camera) as recording:
            return recording.camera.colour.width, recording.camera.colour.height
    except UserError:
        return None


def _notes_of_candidates(
    project: Project,
    row: SequenceEntry,
    layout: Layout,
    cameras: list[str],
) -> list[str]:
    """What a look at the first results of each camera shows: their form, size and labels."""
    from intercap_core.detections.candidate_check import look_at_candidates
    from intercap_core.detections.converters.label_maps import class_names

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


def _fault_of_mesh(project: Project, name: str) -> str | None:
    from intercap_core.rigid.mesh import ObjectMesh

    try:
        ObjectMesh.load(project.objects[name])
    except UserError as error:
        return str(error)
    return None


def _faults_of_capture(project: Project, name: str) -> list[str]:
    from intercap_core.studio.stage import check_capture

    settings = project.config.studio
    assert settings is not None
    try:
        check_capture(settings.captures[name], settings, project.sequences[name].object)
    except UserError as error:
        return [f"{project.path}: {error}"]
    return []


def _faults_of_files(row: SequenceEntry, cameras: tuple[str, ...]) -> list[str]:
    faults = []
    for column in ("calibration", "keypoints", "candidates", "truth"):
        path = getattr(row, column)
        if path is not None and not path.exists():
            faults.append(f"column {column} says {path}, which is not there")
    if not row.recordings.is_dir():
        return [f"there is no folder {row.recordings} of recordings", *faults]
    return faults + (_faults_of_recordings(row, cameras) if row.calibration.exists() else [])


def _faults_of_recordings(row: SequenceEntry, cameras: tuple[str, ...]) -> list[str]:
    from intercap_core.capture.layouts import open_layout

    try:
        layout = open_layout(row)
    except UserError as error:
        return [str(error)]
    if not layout.names:
        return [f"{row.recordings} holds no camera's recording in the layout {row.layout}"]
    known = list(layout.extrinsics.master_from_colour)
    faults = [
        f"the setting frames.cameras names {name!r}, {row.recordings} has {', '.join(layout.names)}"
        for name in cameras
        if name not in known and name not in layout.names
    ]
    for name in layout.names:
        if cameras and name not in cameras:
            continue
        if name not in known:
            faults.append(
                f"{row.calibration}: has no pose of {name}, which {row.recordings} records; add "
                "the camera"
            )
            continue
        try:
            with layout.open(name):
                pass
        except UserError as error:
            faults.append(str(error))
    return faults
