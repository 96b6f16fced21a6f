"""`intercap check`: find faults of settings, tables and recordings before a run does."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from logging.handlers import BufferingHandler
from pathlib import Path

from intercap_core.annotation import Annotation
from intercap_core.config import ExportSettings
from intercap_core.errors import UserError
from intercap_core.inputs.files import describe_unread, list_files, name_some
from intercap_core.project import Project, read_project, tidy


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
    for check in _body_checks(project):
        check()


def _body_checks(project: Project) -> list[Callable[[], object]]:
    """A check for each body file and prior that exists; missing files are faults already."""
    models, lemo = project.config.body_models, project.config.joint.lemo_files or ()
    genders = {project.subjects[name].gender for name in project.subjects_named()}
    files = sorted({path for gender in genders if (path := models.of(gender)) is not None})
    if not files and not lemo and models.vposer is None:
        return []  # without the import of torch
    from intercap_core.body.artefact import load_pose_prior
    from intercap_core.body.lemo import MotionEncoder
    from intercap_core.body.model import BodyModel, check_body

    def check_file(path: Path) -> None:
        check_body(BodyModel.load(path))

    checks: list[Callable[[], object]]
    checks = [partial(check_file, path) for path in files if path.is_file()]
    if models.vposer is not None and models.vposer.is_file():
        checks.append(lambda: load_pose_prior(models, BodyModel.load()))
    if lemo and all(path.is_file() for path in lemo):
        checks.append(lambda: MotionEncoder.load(*lemo))
    return checks


def check_keypoint_model(project: Project) -> None:
    """Open the keypoint model; raises UserError if it cannot run on this machine."""
    settings = project.config.detections
    if settings.keypoint_model is not None and settings.keypoint_model.is_file():
        from intercap_core.formats.detections.onnx_pose import PoseModel

        PoseModel.load(settings)


def check_segmentation_model(project: Project) -> list[Fault]:
    """Open the segmentation model; returns objects that are none of its classes.

    Raises UserError if the model cannot run on this machine.
    """
    settings = project.config.detections
    if settings.segmentation_model is None or not settings.segmentation_model.is_file():
        return []
    from intercap_core.formats.detections.onnx_segmentation import Segmenter

    classes = Segmenter.load(settings).classes
    return [
        Fault(
            "",
            f"{settings.segmentation_model}: none of its {len(classes)} classes "
            f"({name_some(classes, 8)}) is a label of object {name!r} "
            f"({', '.join(project.objects[name].labels)}); add the label to objects.yaml, or name "
            "the model's classes in detections.segmentation_labels",
        )
        for name in project.objects_named()
        if project.objects[name].labels and not {*project.objects[name].labels} & {*classes}
    ]


def check_export_formats(project: Project) -> None:
    """Raise UserError if the library of a requested export format is not installed."""
    requested = project.config.export.formats
    if set(requested) <= set(ExportSettings().formats):
        return  # without the import of torch
    from intercap_core.output.export.registry import formats

    for name in requested:
        formats()[name].require_library()


@dataclass
class Findings:
    """Findings on a project."""

    faults: list[Fault] = field(default_factory=list)
    """Faults that would end a run of the sequence or, without a sequence, of the project. Those
    that others may follow from come first."""
    notes: list[Fault] = field(default_factory=list)
    """Probable mistakes that do not end a run."""
    summaries: list[Fault] = field(default_factory=list)
    """One line per usable recording."""
    sequences: int = 0
    """Number of the sequences in the table."""
    ready: int = 0
    """Number of the sequences that can run."""


def check_project(settings: Path) -> Findings:
    """Check settings, tables, the files that they name, and all sequences, in one pass."""
    project, faults = read_project(settings)
    findings = Findings([Fault("", message) for message in faults])
    findings.sequences = len(project.listed - set(project.config.exclude))
    detectors = [
        lambda: check_keypoint_model(project),
        lambda: findings.notes.extend(check_segmentation_model(project)),
        lambda: check_export_formats(project),
    ]
    for check in (*_body_checks(project), *detectors):
        try:
            check()
        except UserError as error:
            if str(error) not in faults:
                findings.faults.append(Fault("", str(error)))
    findings.faults += [Fault("", message) for message in fault_of_results(project)]
    found = check_sequences(project)
    refused = bool(findings.faults)
    findings.faults += sorted(found.faults, key=lambda fault: bool(fault.sequence))
    findings.notes += found.notes
    findings.summaries += found.summaries
    faulty = {fault.sequence for fault in findings.faults} - {""}
    findings.ready = 0 if refused else findings.sequences - len(faulty)
    return findings


def fault_of_results(project: Project) -> list[str]:
    """Error message if files cannot be written to the folder of results; [] otherwise."""
    place = next(path for path in (project.results, *project.results.absolute().parents)
                 if path.exists())  # fmt: skip
    try:
        with tempfile.TemporaryFile(dir=place):
            return []
    except OSError as error:
        return [
            f"{project.results}: the folder of results cannot be written ({place}: "
            f"{error.strerror}); change its permissions, or name another folder in 'results' of "
            f"{project.path}"
        ]


def check_sequences(project: Project) -> Findings:
    """Check annotation, files, mesh, camera poses and recordings of every sequence.

    Reads a few images and detections per recording. For virtual recordings, checks that the studio
    can make them.
    """
    from intercap_core.commands.check_recordings import check_row

    findings = Findings()
    meshes = {name: _check_mesh(project, name, findings) for name in project.objects_named()}
    faults = findings.faults
    _check_annotations(project, findings)
    for name, row in project.sequences.items():
        try:
            annotation = project.annotation(name)
            problem = fault_of_cameras(project, name, annotation)
            if problem:
                path = project.annotation_path(name)
                raise UserError(f"{path}: {problem}; correct the entry")
        except UserError as error:
            faults.append(Fault(name, str(error)))
        mesh = meshes.get(row.object or "")
        if mesh is not None:
            faults.append(Fault(name, mesh))
        studio = project.config.studio
        if studio is not None and name in studio.captures:
            from intercap_core.studio.stage import check_capture

            try:
                check_capture(studio.captures[name], studio, row.object)
            except UserError as error:
                faults.append(Fault(name, f"{project.path}: {error}"))
            continue
        found = check_row(project, row)
        faults += [Fault(name, message) for message in found.faults]
        findings.notes += [Fault(name, message) for message in found.notes]
        findings.summaries += [Fault(name, found.summary)] if found.summary else []
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


def _check_annotations(project: Project, findings: Findings) -> None:
    """Add a fault for each YAML file that no sequence reads, and notes on other files."""
    folder = tidy(project.path.parent / project.config.annotations)
    known = {folder / f"{name}.yaml" for name in project.listed}
    known |= {project.annotation_path(name) for name in project.sequences}
    unread = [path for path in list_files(folder) if path not in known and path.parent == folder]
    yaml = [path for path in unread if path.suffix.lower() in (".yaml", ".yml")]
    findings.faults += [
        Fault("", f"{path}: no sequence has this annotation's name; rename it to <sequence>.yaml")
        for path in yaml
    ]
    advice = "an annotation is <sequence>.yaml; rename or remove them"
    others = (path for path in unread if path not in yaml)
    findings.notes += [Fault("", note) for note in describe_unread(folder, others, advice)]


def _check_mesh(project: Project, name: str, findings: Findings) -> str | None:
    """Error message if an object's mesh cannot be used; warnings on a usable one become notes."""
    from intercap_core.evaluation.physics.judge import without_volume
    from intercap_core.geometry.rigid import mesh

    warnings = BufferingHandler(capacity=1000)
    mesh.log.addHandler(warnings)
    mesh.log.propagate = False
    try:
        loaded = mesh.ObjectMesh.load(project.objects[name])
    except UserError as error:
        return str(error)
    finally:
        mesh.log.removeHandler(warnings)
        mesh.log.propagate = True
    findings.notes += [Fault("", record.getMessage()) for record in warnings.buffer]
    if why := without_volume(loaded):
        findings.notes.append(Fault("", f"{why}: metrics leaves out its physics"))
    return None
