"""The arguments of each stage, and the manifest of its output.

Both are derived from the signature of the stage's ``run``. A stage can therefore not depend on a
setting, table entry or annotation that its manifest does not record.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from intercap_core.annotation import Annotation
from intercap_core.config import BodyModels, Config
from intercap_core.entries import SequenceEntry
from intercap_core.formats.recordings.layouts import input_files
from intercap_core.formats.released import intercap_file
from intercap_core.inputs.files import referenced_files
from intercap_core.output.site.settings import changed
from intercap_core.pipeline.checksums import InputChecksums
from intercap_core.pipeline.code_digest import stage_code
from intercap_core.pipeline.provenance import Manifest, library_versions, processor, to_plain
from intercap_core.project import Project
from intercap_core.sequence_inputs import FitSettings
from intercap_core.stage_list import STAGES
from intercap_core.studio.mediapipe import DETECTOR_SCRIPT

STUDIO = "studio"
NOT_RECORDED = "not recorded"  # in place of the fingerprint of an artefact without a manifest
DATASET_READS = ("summary", "export")  # stages whose outputs those of all sequences are made from


def restrict_row(stage: str, row: SequenceEntry) -> SequenceEntry:
    """Return a copy of the row with the sequence's name and the columns that the stage declares.

    Access to any other column raises AttributeError.
    """
    declared = STAGES[stage]
    names = (*declared.columns, *declared.layout_columns.get(row.layout, ()))
    values = {name: getattr(row, name) for name in ("sequence", *names)}
    restricted = SequenceEntry.model_construct({*values}, **values)
    for name in restricted.__dict__.keys() - values.keys():  # columns with defaults
        del restricted.__dict__[name]
    return restricted


def arguments(
    project: Project, sequence: str, stage: str, annotation: Annotation
) -> dict[str, Any]:
    """Arguments of ``stages.<stage>.run`` except the artefacts and the output."""
    config, row = project.config, project.sequences[sequence]
    known: dict[str, Any] = {
        "settings": getattr(config, stage, None),  # not every stage has settings
        "fit_settings": FitSettings(config.joint, config.body_fit, config.object_track),
        "models": project.models(sequence),
        "sequence": restrict_row(stage, row),
        "object_": project.object_of(sequence),
        "subject": project.subjects[row.subject],
        "body_models": config.body_models,
        "results": row.results,
        "truth": row.truth,
        "frames_to_drop": annotation.drop_frames,
        "floor": annotation.floor,
        "starts": annotation.stated_starts,
        "poses": annotation.poses,
        "contact": annotation.contact,
        "subject_points": annotation.subject,
        "left_right": annotation.left_right,
    }
    return {name: known[name] for name in stage_code(stage).parameters if name in known}


def stage_manifest(
    project: Project,
    sequence: str,
    stage: str,
    annotation: Annotation,
    *,
    artefacts: Mapping[str, str],
    checksums: InputChecksums,
    before: Manifest | None = None,
) -> Manifest:
    """Manifest of the output that the stage would write now.

    Args:
        artefacts: fingerprint of each artefact that the stage reads, by stage, or by the name of
            :func:`reused_artefact`.
        before: an earlier manifest; saves reading large files whose size has changed.
    """
    given = _given(project, sequence, stage, annotation)
    machine = {"cpu": processor()}
    return _manifest(stage, sequence, given, artefacts, checksums, before, machine)


def reused_artefact(project: Project, sequence: str, stage: str) -> tuple[str, Path] | None:
    """Name in manifests, and path, of the other sequence's artefact that a stage opens too."""
    other = project.reused_sequence(sequence, stage)
    return None if other is None else (f"{stage} of {other}", project.artefact(other, stage))


def files_read(project: Project, sequence: str, stage: str) -> list[Path]:
    """The user's files and folders whose checksums the manifest of the stage's output holds."""
    given = _given(project, sequence, stage, Annotation())
    return [path for value in given.values() for path in _split_paths(value)[1].values()]


def _given(project: Project, sequence: str, stage: str, annotation: Annotation) -> dict[str, Any]:
    """Arguments as the manifest names them: groups of arguments one by one."""
    given = arguments(project, sequence, stage, annotation)
    if given.get("results") is not None:
        given["results"] = intercap_file(given["results"])  # the newest file of a folder
    for name in ("models", "fit_settings"):
        group = given.pop(name, None)
        given |= vars(group) if group is not None else {}
    if "body_models" in given:
        given["body_models"] = _body_files(project.config, given["subject"].gender)
    return given


def studio_manifest(project: Project, sequence: str, checksums: InputChecksums) -> Manifest:
    """Manifest of the virtual recording that the studio would write now.

    Raises KeyError if the studio does not make the sequence.
    """
    studio = project.config.studio
    if studio is None:
        raise KeyError(sequence)
    given: dict[str, Any] = {
        "settings": studio.model_copy(update={"captures": {}}),
        "capture": studio.captures[sequence],
        "object_": project.object_of(sequence),
    }
    if studio.captures[sequence].keypoints == "mediapipe" and DETECTOR_SCRIPT.is_file():
        given["detector"] = DETECTOR_SCRIPT
    return _manifest(STUDIO, sequence, given, {}, checksums, None, {"cpu": processor()})


def dataset_manifest(
    project: Project, made: Mapping[str, Mapping[str, str]], failed: Mapping[str, str]
) -> Manifest:
    """Manifest of the outputs of all sequences: tables, card, merged exports and first page.

    Args:
        made: fingerprint by stage and sequence of the outputs of ``DATASET_READS``.
        failed: reason by excluded sequence.
    """
    given = {
        "settings": project.config.card,
        "formats": project.config.export.formats,
        "body_models": _without_folders(project.config.body_models),
        "objects": {
            name: _without_folders(project.objects[name]) for name in project.objects_named()
        },
        "failed": dict(failed),
        "changed": changed(project.config),
    }
    read = {
        f"{stage} of {name}": fingerprint
        for stage, of in made.items()
        for name, fingerprint in of.items()
    }
    merged = stage_code("merged exports").digests
    code = {
        **stage_code("dataset").digests,
        **{f"merged exports, {package}": digest for package, digest in merged.items()},
    }
    return Manifest("dataset", "", to_plain(given), {}, read, code, library_versions())


def _manifest(
    stage: str,
    sequence: str,
    given: Mapping[str, Any],
    artefacts: Mapping[str, str],
    checksums: InputChecksums,
    before: Manifest | None,
    machine: Mapping[str, str],
) -> Manifest:
    """Manifest of an output; paths in ``given`` become checksums of the files."""
    values: dict[str, Any] = {}
    files: dict[str, dict[str, str]] = {}
    for name, value in given.items():
        content, paths = _split_paths(value)
        values[name] = to_plain(content)
        known = before.files.get(name, {}) if before is not None else {}
        if paths:
            files[name] = {
                key: checksums.digest(path, was=known.get(key)) for key, path in paths.items()
            }
    return Manifest(
        stage=stage,
        sequence=sequence,
        given=values,
        files=files,
        artefacts=dict(artefacts),
        code=stage_code(stage).digests,
        libraries=library_versions(stage),
        machine=dict(machine),
    )


def _split_paths(value: Any) -> tuple[Any, dict[str, Path]]:
    """A value without its paths, and the paths by names that do not depend on their folder."""
    if isinstance(value, Path):
        return None, {value.name: value}
    if isinstance(value, SequenceEntry):
        return _split_row(value)
    if isinstance(value, BaseModel):
        named = {name: entry for name, entry in value if isinstance(entry, Path)}
        paths = {
            f"{name}/{os.path.relpath(path, entry.parent)}": path
            for name, entry in named.items()
            for path in (entry, *_companion_files(entry))
        }
        return value.model_dump(mode="json", exclude=set(named)), paths
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_split_paths(entry)[0] for entry in value], {}
    return value, {}


def _without_folders(entry: BaseModel) -> dict[str, Any]:
    """Values of an entry; of paths only the names, so that a moved project stays up to date."""
    names = {name: value.name for name, value in entry if isinstance(value, Path)}
    return entry.model_dump(mode="json", exclude=set(names)) | names


def _split_row(row: SequenceEntry) -> tuple[dict[str, Any], dict[str, Path]]:
    """Columns of a row, and its files; recordings by the files of their layout."""
    values, paths = {}, {}
    for name in sorted(row.model_fields_set):
        value = getattr(row, name)
        if name == "recordings":
            for path in input_files(row):
                relative = path.relative_to(row.recordings)
                paths[f"{name}/{relative.as_posix()}"] = path
        elif isinstance(value, Path):
            paths[f"{name}/{value.name}"] = value
        else:
            values[name] = value
    if "calibration" in row.model_fields_set and row.layout == "behave":
        # imports the readers of images and videos
        from intercap_core.formats.recordings.behave import find_intrinsics_folder

        lenses = find_intrinsics_folder(row.calibration)
        paths |= {lenses.name: lenses} if lenses is not None else {}
    return values, paths


def _companion_files(path: Path) -> list[Path]:
    """Files read together with another: those that it names, textures of a mesh, maps of a body."""
    names = (f"{path.stem}.mtl", f"{path.stem}.png", f"{path.stem}.jpg", f"{path.stem}_maps.json")
    files = [file for name in names if (file := path.with_name(name)).is_file()]
    for file in (path, *files):
        if file.is_file():
            status = file.stat()
            stamp = (status.st_size, status.st_mtime_ns, path.parent.stat().st_mtime_ns)
            files += _referenced(file, stamp)
    return sorted({file for file in files if file != path})


@functools.cache
def _referenced(path: Path, stamp: tuple[int, ...]) -> list[Path]:
    """``referenced_files``, cached by ``stamp``: size and date of the file, date of its folder."""
    return referenced_files(path)


def _body_files(config: Config, gender: str) -> BodyModels:
    """The body file for a gender, and the pose prior."""
    models = config.body_models
    return BodyModels(
        neutral=models.of(gender), vposer=models.vposer, vposer_version=models.vposer_version
    )
