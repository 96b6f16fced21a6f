"""`intercap evaluate`: virtual recordings against truth, as tables and as flat JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from intercap_core.commands.run import run_workflow
from intercap_core.errors import UserError
from intercap_core.evaluation import bodies as body_evaluation
from intercap_core.evaluation.captures import evaluate_captures, print_captures
from intercap_core.evaluation.objects import evaluate_objects, print_objects
from intercap_core.metrics import figures
from intercap_core.metrics.figures import SequenceMetrics
from intercap_core.project import Project, load_project
from intercap_core.stage_list import ESTIMATES

PLAIN, ANNOTATED = "no annotations", "annotated"


def evaluate(
    settings: Path | None,
    captures: Sequence[Path],
    objects: Sequence[Path],
    bodies: Sequence[Path],
    output: Path,
    *,
    cores: int = 0,
) -> int:
    """Bring the evaluation captures up to date, print the tables and write ``output``.

    ``settings`` are of recordings that are taken to the end, ``captures`` of those that are taken
    to the scene alone, ``objects`` of those that are taken to the object's track, ``bodies`` to the
    body's fit. ``output`` is flat JSON with keys ``area.measure``: areas of annotated recordings
    end in ``_annotated``, those of ``captures`` have their dataset's name, that of ``objects`` is
    ``object``, that of ``bodies`` is ``body``. Returns the workflow's exit status; sequences that
    failed are left out of the figures and named. Raises UserError where a project's settings are
    wrong, or none of its sequences has a result.
    """
    # faults are told before any work
    projects, tracked, fitted = (
        [load_project(path) for path in paths] for paths in (captures, objects, bodies)
    )
    status, flat = 0, dict[str, float]()
    if settings is not None:
        status, flat = _evaluate_sequences(settings, cores)
    found = [evaluate_captures(project, cores=cores) for project in projects]
    for captured in found:
        status = status or captured.status
        flat |= _flattened(captured.area, captured.figures)
    if found:
        print_captures(found)
    tracks = [evaluate_objects(project, cores=cores) for project in tracked]
    for track in tracks:
        status = status or track.status
        flat |= {key: _rounded(value) for key, value in track.flat().items()}
    if tracks:
        print_objects(tracks)
    fits = [body_evaluation.evaluate_bodies(project, cores=cores) for project in fitted]
    flat |= {key: _rounded(value) for key, value in body_evaluation.flat(fits).items()}
    for fit in fits:
        status = status or fit.status
    if fits:
        body_evaluation.print_bodies(fits)
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps(flat, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    print(output)
    return status


def _evaluate_sequences(settings: Path, cores: int) -> tuple[int, dict[str, float]]:
    project = load_project(settings)
    status = run_workflow(settings, cores=cores)
    groups = measured_groups(project)
    tables = {name: areas(sequences) for name, sequences in groups.items() if sequences}
    if not tables:
        raise UserError(f"{settings}: no sequence has metrics; look into {project.logs}")
    flat: dict[str, float] = {}
    for group, found in tables.items():
        for area, measures in found.items():
            flat |= _flattened(f"{area}{'' if group == PLAIN else '_annotated'}", measures)
    print_tables(tables, {name: len(sequences) for name, sequences in groups.items()})
    return status, flat


def _flattened(area: str, measures: dict[str, float]) -> dict[str, float]:
    return {
        f"{area}.{measure}": _rounded(value)
        for measure, value in measures.items()
        if math.isfinite(value)
    }


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def measured_groups(project: Project) -> dict[str, list[SequenceMetrics]]:
    """The sequences that have metrics, apart by whether they are annotated."""
    groups: dict[str, list[SequenceMetrics]] = {PLAIN: [], ANNOTATED: []}
    for name in project.sequences:
        path = project.artefact(name, "metrics")
        if path.is_file():
            annotated = project.annotation_made(name) or project.annotation_path(name).exists()
            groups[ANNOTATED if annotated else PLAIN].append(SequenceMetrics.read(path))
    return groups


def areas(sequences: Sequence[SequenceMetrics]) -> dict[str, dict[str, float]]:
    """Every figure of a group of sequences by area: the stages, and what is not one stage's."""
    found = {stage: figures.truth_figures(sequences, stage) for stage in ESTIMATES}
    for stage in ESTIMATES:
        sweep = figures.contact_sweep(sequences, stage)
        found[stage].update({f"contact_f1_at_{mm:g}mm": value for mm, value in sweep.items()})
    return {
        **found,
        "penetration": figures.penetration_figures(sequences),
        "vertex_to_cloud": figures.cloud_figures(sequences),
        "vertex_to_cloud_floor": figures.floor_figures(sequences),
        "extrinsics": figures.extrinsics_figures(sequences),
        "flags": figures.flag_figures(sequences),
    }


def print_tables(tables: dict[str, dict[str, dict[str, float]]], counts: dict[str, int]) -> None:
    """One table for the three stages side by side, one for the rest; a column for each group."""
    console = Console()
    groups = list(tables)
    for group in groups:
        found = tables[group]
        table = Table("measure", *ESTIMATES, box=None)
        table.title = f"against truth, {group} ({counts[group]} sequences)"
        measures = list(dict.fromkeys(m for stage in ESTIMATES for m in found[stage]))
        for measure in measures:
            cells = [_number(found[stage].get(measure)) for stage in ESTIMATES]
            table.add_row(measure, *cells)
        console.print(table)
    table = Table("after joint", *groups, box=None, title="all frames")
    for area in tables[groups[0]]:
        if area in ESTIMATES:
            continue
        names = list(dict.fromkeys(m for group in groups for m in tables[group][area]))
        for name in names:
            table.add_row(
                f"{area}.{name}", *(_number(tables[group][area].get(name)) for group in groups)
            )
    console.print(table)


def _number(value: float | None) -> str:
    return "" if value is None or not math.isfinite(value) else f"{value:.3f}"
