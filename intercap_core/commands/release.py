"""`intercap release`: list a dataset's files with their checksums, and verify a released folder."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from intercap_core import schemas
from intercap_core.errors import UserError
from intercap_core.evaluation.summary import SequenceSummary
from intercap_core.inputs.files import name_some
from intercap_core.output.release import manifest
from intercap_core.output.release.datasheet import statements
from intercap_core.output.site.measures import made_by_stage
from intercap_core.pipeline.code_digest import code_digest
from intercap_core.pipeline.plan import OutputStatus, Plan
from intercap_core.project import Project, tidy
from intercap_core.stage_list import SEQUENCE_STAGES, STAGES
from intercap_core.versions import versions

log = logging.getLogger(__name__)

TABLES = ("sequences", "subjects", "objects")  # settings that name them
_PRINTED = 20  # paths of each kind of difference


def write_release(project: Project, kinds: Sequence[str]) -> Path:
    """List the files of all results; returns the path of the list.

    Warns if results come from several versions or settings, and of statements that the datasheet
    lacks. Raises UserError if an output of a
    sequence, or of the dataset, is damaged or missing.
    """
    _check_complete(project)
    names = list(project.sequences)
    summaries = [SequenceSummary.read(project.artefact(name, "summary")) for name in names]
    made = _made(summaries)
    for stage, found in made.items():
        if len(found) > 1:
            few = min(found, key=lambda version: len(version["sequences"]))
            log.warning(
                "stage %s is of %d versions or settings: %s differ from the others; run the "
                "project again before you release it",
                stage, len(found), ", ".join(few["sequences"][:_PRINTED]),
            )  # fmt: skip
    config = project.config
    entries = manifest.write(
        project.results,
        {
            "dataset": config.dataset,
            "version": config.card.version,
            "licence": config.card.licence,
            "sequences": sorted(names),
            "software": dict(versions()),
            "schemas": {name: getattr(schemas, name.upper()).version for name in SEQUENCE_STAGES},
            "code": {name: code_digest(f"stages.{name}") for name in STAGES},
            "made_by": made,
            "settings": _without_folders(config.model_dump(mode="json", exclude={"studio"})),
            "inputs": _inputs(project, names),
        },
        kinds=kinds,
        sequences=names,
        threads=os.cpu_count() or 1,
    )
    total = sum(entry.bytes for entry in entries)
    path = project.results / manifest.MANIFEST
    log.info("%d files, %.1f MB", len(entries), total / 1e6)
    virtual = all(summary.metrics.has_truth for summary in summaries)
    stated = statements(config.card, virtual=virtual)
    missing = [f"card.{statement}" for statement, text in stated.items() if not text]
    if missing:
        log.warning("datasheet.md has placeholders: set %s in %s", ", ".join(missing), project.path)
    return path


def check_release(folder: Path) -> bool:
    """Print how a folder differs from its list; True if nothing is missing or changed."""
    count, found = manifest.check(folder, threads=os.cpu_count() or 1)
    for what, paths in found.items():
        for path in paths[:_PRINTED]:
            print(f"{what}: {path}")
        if len(paths) > _PRINTED:
            print(f"{what}: {len(paths) - _PRINTED} more")
    wrong = len(found["missing"]) + len(found["changed"])
    print(f"{folder}: {count - wrong} of {count} files are as released")
    return not wrong


def _check_complete(project: Project) -> None:
    """Raise UserError that names the sequences with damaged or missing outputs."""
    broken, plan = {}, Plan(project)
    for name, by_stage in plan.all_faults().items():
        faults = [*by_stage.values()]
        last = project.artefact(name, "summary") if name else project.site / "index.html"
        if not faults and not last.exists():
            faults = [f"{last}: is missing; run again"]
        if faults:
            broken[name or "the dataset"] = faults
    if not broken and plan.dataset.status is OutputStatus.stale:
        raise UserError(
            f"{project.results}: tables, card and merged exports are of other sequences, settings "
            "or results than the project's; nothing is released: run the project again"
        )
    if not broken:
        return
    for name, found in broken.items():
        log.warning("%s: %s", name, "; ".join(found))
    names = sorted(broken)
    raise UserError(
        f"{project.results}: outputs of {name_some(names, _PRINTED)} are damaged or "
        f"missing, such as {broken[names[0]][0].partition(';')[0]}; nothing is released: run the "
        "project again, or name the sequences in 'exclude'"
    )


def _made(summaries: Sequence[SequenceSummary]) -> dict[str, list[dict[str, Any]]]:
    """By stage: each version and settings digest, with its sequences."""
    return {
        stage: [
            {"version": version, "settings": digest, "sequences": names}
            for version, digest, names in entries
        ]
        for stage, entries in made_by_stage(summaries).items()
    }


def _without_folders(values: Any) -> Any:
    """Settings with absolute paths replaced by file names."""
    if isinstance(values, dict):
        return {key: _without_folders(value) for key, value in values.items()}
    if isinstance(values, str) and values.startswith("/"):
        return Path(values).name
    return values


def _inputs(project: Project, names: Sequence[str]) -> dict[str, str]:
    """SHA-256 of the tables and of the sequences' annotations, by file name."""
    config, folder = project.config, project.path.parent
    tables = {name: tidy(folder / getattr(config, name)) for name in TABLES}
    files = {f"{name}{path.suffix}": path for name, path in tables.items()}
    files |= {f"annotations/{name}.yaml": project.annotation_path(name) for name in names}
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in files.items()
        if path.is_file()
    }
