"""What a stage is given, and what is recorded of it: one list for both, so that no stage depends on
anything that its record does not have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from intercap_core.config import Annotation, BodyModels, Config, SequenceEntry
from intercap_core.formats.recordings.behave import find_intrinsics_folder
from intercap_core.formats.recordings.layouts import input_files
from intercap_core.formats.released.file_names import intercap_file
from intercap_core.output.site.settings import changed
from intercap_core.pipeline.code_cache import stage_code
from intercap_core.pipeline.contents import Contents
from intercap_core.pipeline.record import Record, libraries, plain, processor
from intercap_core.project import Project
from intercap_core.sequence_inputs import FitSettings

# Columns of a sequence's row that a stage may read; reading another one is an error.
COLUMNS: dict[str, tuple[str, ...]] = {
    "frames": (
        "layout", "recordings", "calibration", "calibration_scale", "calibration_up",
        "calibration_floor",
    ),
    "detections": (
        "layout", "recordings", "calibration", "calibration_scale", "keypoints", "candidates",
    ),
    "summary": ("intent",),
    "page": ("intent",),
}  # fmt: skip
_OF_BEHAVE = ("object",)  # the stage detections finds BEHAVE's files by the object's name
STUDIO = "studio"


def row_of(stage: str, row: SequenceEntry) -> SequenceEntry:
    """The row with its name and those columns alone that the stage may read; of others it has no
    attribute."""
    names = COLUMNS.get(stage, ())
    if stage == "detections" and row.layout == "behave":
        names += _OF_BEHAVE
    kept = {name: getattr(row, name) for name in ("sequence", *names)}
    narrow = SequenceEntry.model_construct({*kept}, **kept)
    for name in narrow.__dict__.keys() - kept.keys():  # which have their defaults
        del narrow.__dict__[name]
    return narrow


def arguments(
    project: Project, sequence: str, stage: str, annotation: Annotation
) -> dict[str, Any]:
    """What ``stages.<stage>.run`` is called with, but for artefacts and the output."""
    config, row = project.config, project.sequences[sequence]
    known: dict[str, Any] = {
        "settings": getattr(config, stage, None),  # not every stage has any
        "fit_settings": FitSettings(config.joint, config.body_fit, config.object_track),
        "models": project.models(sequence),
        "sequence": row_of(stage, row),
        "object_": project.object_of(sequence),
        "subject": project.subjects[row.subject],
        "body_models": config.body_models,
        "device": config.device,
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


def takes_paths(stage: str) -> bool:
    """Whether the stage gets its artefacts as :class:`SequencePaths`, not as single arguments."""
    return "paths" in stage_code(stage).parameters


def record(
    project: Project,
    sequence: str,
    stage: str,
    annotation: Annotation,
    *,
    artefacts: Mapping[str, str],
    contents: Contents,
    before: Record | None = None,
) -> Record:
    """What the stage's output would be made from now.

    ``artefacts``: the identity of each artefact that it reads; ``before``: an earlier record, which
    saves reading large files whose size tells that they are others.
    """
    given = arguments(project, sequence, stage, annotation)
    device = given.pop("device", "cpu")
    if given.get("results") is not None:
        given["results"] = intercap_file(given["results"])  # of a folder its newest
    for name in ("models", "fit_settings"):
        group = given.pop(name, None)
        given |= vars(group) if group is not None else {}
    if "body_models" in given:
        given["body_models"] = _body_files(project.config, given["subject"].gender)
    return _record(
        stage, sequence, given, artefacts, contents, before, {"device": device, "cpu": processor()}
    )


def studio_record(project: Project, sequence: str, contents: Contents) -> Record:
    """What a virtual recording would be made from now; what is already there of it is not read.

    Raises KeyError where the studio does not make the sequence.
    """
    studio = project.config.studio
    if studio is None:
        raise KeyError(sequence)
    given = {
        "settings": studio.model_copy(update={"captures": {}}),
        "capture": studio.captures[sequence],
        "object_": project.object_of(sequence),
    }
    return _record(STUDIO, sequence, given, {}, contents, None, {"cpu": processor()})


def dataset_record(
    project: Project, summaries: Mapping[str, str], failed: Mapping[str, str]
) -> Record:
    """What tables, card and the site's first page would be made from now; ``summaries`` has the
    identity of each sequence's summary."""
    given = {
        "settings": project.config.card,
        "formats": project.config.export.formats,
        "body_models": project.config.body_models.model_dump(mode="json"),
        "objects": {
            name: project.objects[name].model_dump(mode="json", exclude={"mesh"})
            for name in project.objects_named()
        },
        "failed": dict(failed),
        "changed": changed(project.config),
    }
    code = stage_code("dataset").digests
    return Record("dataset", "", plain(given), {}, dict(summaries), code, libraries())


def _record(
    stage: str,
    sequence: str,
    given: Mapping[str, Any],
    artefacts: Mapping[str, str],
    contents: Contents,
    before: Record | None,
    machine: Mapping[str, str],
) -> Record:
    values: dict[str, Any] = {}
    files: dict[str, dict[str, str]] = {}
    for name, value in given.items():
        told, paths = _told(value)
        values[name] = plain(told)
        known = before.files.get(name, {}) if before is not None else {}
        if paths:
            files[name] = {
                key: contents.digest(path, was=known.get(key)) for key, path in paths.items()
            }
    code = stage_code(stage).digests
    return Record(stage, sequence, values, files, dict(artefacts), code, libraries(), dict(machine))


def _told(value: Any) -> tuple[Any, dict[str, Path]]:
    """A value without its paths, and the paths by names that tell nothing of where they lie."""
    if isinstance(value, Path):
        return None, {value.name: value}
    if isinstance(value, SequenceEntry):
        return _row_told(value)
    if isinstance(value, BaseModel):
        named = {name: entry for name, entry in value if isinstance(entry, Path)}
        paths = {
            f"{name}/{path.name}": path
            for name, entry in named.items()
            for path in (entry, *_beside(entry))
        }
        return value.model_dump(mode="json", exclude=set(named)), paths
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_told(entry)[0] for entry in value], {}
    return value, {}


def _row_told(row: SequenceEntry) -> tuple[dict[str, Any], dict[str, Path]]:
    """A row's columns; its recordings by the files that the layout has."""
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
        lenses = find_intrinsics_folder(row.calibration)
        paths |= {lenses.name: lenses} if lenses is not None else {}
    return values, paths


def _beside(path: Path) -> list[Path]:
    """Files that are read with another one: a mesh's materials and texture, a body's maps."""
    names = (f"{path.stem}.mtl", f"{path.stem}.png", f"{path.stem}.jpg", f"{path.stem}_maps.json")
    return [one for name in names if (one := path.with_name(name)).is_file()]


def _body_files(config: Config, gender: str) -> BodyModels:
    """The body file that somebody of this gender is fitted with, and the pose prior."""
    models = config.body_models
    return BodyModels(
        neutral=models.of(gender), vposer=models.vposer, vposer_version=models.vposer_version
    )
