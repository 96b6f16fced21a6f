"""What the parts of an evaluation have in common: recordings taken to a stage and measured."""

from __future__ import annotations

import hashlib
import math
import os
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, is_dataclass
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Generic, TypeVar, get_type_hints

import numpy as np
from rich.console import Console
from rich.table import Table

from intercap_core.errors import UserError
from intercap_core.inputs import safe_pickle
from intercap_core.pipeline.code_digest import code_digest
from intercap_core.project import Project, load_project

Errors = TypeVar("Errors")
Figures = dict[str, float]
Targets = Sequence[tuple[str, Project]]  # the last stage of each project
Columns = Mapping[str, tuple[str, int]]  # of a table: heading to a figure's key and its digits

SPREAD = "_spread"
COUNTS = (
    "frames", "captures", "slips_true", "slips_missed", "slips_false", "object_worse_count",
)  # fmt: skip
EXTREME = "worst"


@dataclass(frozen=True, eq=False)
class Measured(Generic[Errors]):
    """The errors of every recording of one project, and the recordings that did not get there.

    ``rig`` says in words what the settings leave of the recordings, where that matters.
    """

    dataset: str
    errors: Sequence[Errors]
    missing: Sequence[str] = ()
    rig: str = ""


@dataclass(frozen=True)
class EvaluationPart(Generic[Errors]):
    """One part of the evaluation.

    ``measure`` (project, sequence) compares the artefact of ``stage`` with the truth; it reads the
    artefacts ``reads`` beside it, and ``code`` is the module (below ``intercap_core``) whose digest
    stands for what it computes. ``kept`` is the dataclass of errors that are stored because
    measuring takes long; None where they are read at once. ``flat`` gives the keys ``area.measure``
    of all projects, ``print_tables`` prints them, ``rig`` describes a project's settings;
    ``has`` (project, sequence) says whether a recording has what is measured. ``last`` (project) is
    the stage to which a project's recordings are taken where that is beyond ``stage``, ``timed``
    (project, sequence) measures how long something takes, once an evaluation.
    """

    name: str
    stage: str
    reads: tuple[str, ...]
    measure: Callable[[Project, str], Errors]
    flat: Callable[[Sequence[Measured[Errors]]], Figures]
    print_tables: Callable[[Sequence[Measured[Errors]]], None]
    rig: Callable[[Project], str] = lambda _: ""
    kept: type[Errors] | None = None
    has: Callable[[Project, str], bool] = lambda _project, _sequence: True
    last: Callable[[Project], str | None] = lambda _: None
    timed: Callable[[Project, str], Figures] | None = None

    def targets(self, projects: Sequence[Project]) -> Targets:
        """Each project with the stage that its recordings are taken to."""
        return [(self.last(project) or self.stage, project) for project in projects]

    def time_one(self, projects: Sequence[Project]) -> Figures:
        """What ``timed`` says of the first recording that has come to the stage; empty without."""
        there = (
            (project, name)
            for project in projects
            for name in project.sequences
            if project.artefact(name, self.stage).is_file()
        )
        first = next(there, None)
        return {} if self.timed is None or first is None else self.timed(*first)

    def measure_all(self, projects: Sequence[Project], *, workers: int) -> list[Measured[Errors]]:
        """Measure every recording whose artefact is there, several at a time.

        Raises UserError where no sequence of a project has come to the stage.
        """
        counted = [[n for n in project.sequences if self.has(project, n)] for project in projects]
        there = [
            [name for name in names if project.artefact(name, self.stage).is_file()]
            for project, names in zip(projects, counted, strict=True)
        ]
        for project, names in zip(projects, there, strict=True):
            if not names:
                raise UserError(
                    f"{project.path}: no sequence has a {self.stage}; look into {project.logs}"
                )
        module = import_module(f"intercap_core.commands.evaluate.{self.name}")
        jobs = [
            (module.__name__, project.path, name)
            for project, names in zip(projects, there, strict=True)
            for name in names
        ]
        context = get_context("spawn")  # numerical libraries keep threads that a fork would lose
        with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context) as pool:
            errors: Iterator[Any] = iter(list(pool.map(_measure_one, *zip(*jobs, strict=True))))
        return [
            Measured(
                project.config.dataset,
                [next(errors) for _ in names],
                [name for name in wanted if name not in names],
                self.rig(project),
            )
            for project, wanted, names in zip(projects, counted, there, strict=True)
        ]


def _measure_one(module: str, settings: Path, sequence: str) -> object:
    part: EvaluationPart[object] = import_module(module).PART
    return measured_once(part, load_project(settings), sequence)


def measured_once(part: EvaluationPart[Errors], project: Project, sequence: str) -> Errors:
    """Measure one recording, or take its errors from the last time that all inputs were the same.

    The errors lie beside the artefacts, named by the digest of what they were computed from: the
    files, the project's tables and settings, and the code.
    """
    truth = project.sequences[sequence].truth
    assert truth is not None
    if not truth.is_file():
        raise UserError(
            f"{truth}: the truth of {sequence!r} is missing, though its {part.stage} is there; "
            f"remove {project.results / sequence} and start again: both are made anew"
        )
    if part.kept is None:
        return part.measure(project, sequence)
    state = hashlib.sha256(code_digest(f"commands.evaluate.{part.name}").encode())
    row = project.sequences[sequence]
    entry, subject = project.object_of(sequence), project.subjects[row.subject]
    for told in (*filter(None, [entry]), subject, project.config.body_models):
        state.update(told.model_dump_json().encode())
    files = [project.artefact(sequence, stage) for stage in (*part.reads, part.stage)]
    for path in (*files, truth, *([entry.mesh] if entry else [])):
        with open(path, "rb") as file:
            state.update(hashlib.file_digest(file, "sha256").digest())
    folder = project.results / sequence / "evaluation"
    path = folder / f"{part.name}-{state.hexdigest()[:24]}.pickle"
    if path.is_file():
        return _dataclass_of(part.kept, safe_pickle.load(path))
    errors = part.measure(project, sequence)
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob(f"{part.name}-*.pickle"):
        old.unlink()
    partial = path.with_suffix(f".{os.getpid()}")
    partial.write_bytes(pickle.dumps(_plain(errors)))
    partial.replace(path)  # a killed run leaves no half-written file under the final name
    return errors


def _plain(value: Any) -> Any:
    """Dataclasses as dictionaries and paths as text, so that no pickle names a class."""
    if is_dataclass(value):
        return {field.name: _plain(getattr(value, field.name)) for field in fields(value)}
    return str(value) if isinstance(value, Path) else value


def _dataclass_of(kind: Any, values: dict[str, Any]) -> Any:
    """The inverse of :func:`_plain`."""
    hints = get_type_hints(kind)
    made = {
        name: _dataclass_of(hints[name], value)
        if is_dataclass(hints[name])
        else Path(value)
        if hints[name] is Path
        else value
        for name, value in values.items()
    }
    return kind(**made)


def require_truth(project: Project) -> None:
    """Raises UserError where a sequence has no truth to be held to."""
    for name, row in project.sequences.items():
        if row.truth is None:
            raise UserError(
                f"{project.path}: sequence {name!r} has no truth to be evaluated against; leave "
                "it out, or name its truth in the table"
            )


def variant(dataset: str, *areas: str) -> str:
    """What stands before a measure's name: "noise2_" of object_noise2 in the area object."""
    for area in areas:
        if dataset == area or dataset.startswith(f"{area}_"):
            dataset = dataset.removeprefix(area)
            break
    name = dataset.strip("_")
    return f"{name}_" if name else ""


def keyed(prefix: str, figures: Mapping[str, float]) -> Figures:
    """The figures with this before each key."""
    return {f"{prefix}{key}": value for key, value in figures.items()}


def spread(
    figures: Callable[[Sequence[Errors]], Mapping[str, float]], recordings: Sequence[Errors]
) -> Figures:
    """Standard error of each figure over the recordings, keys ``<figure>_spread``.

    Every recording's figure is taken on its own; their sample deviation over the square root of
    their number. Counts and extremes have none, nor has a figure that fewer than two recordings
    have.
    """
    alone = [figures([recording]) for recording in recordings]
    found: Figures = {}
    for key in dict.fromkeys(key for one in alone for key in one):
        values = np.array([one[key] for one in alone if math.isfinite(one.get(key, math.nan))])
        if len(values) > 1 and key not in COUNTS and EXTREME not in key:
            found[f"{key}{SPREAD}"] = float(values.std(ddof=1) / np.sqrt(len(values)))
    return found


def add_rows(
    table: Table,
    name: str,
    figures: Mapping[str, float],
    columns: Columns,
    spreads: Mapping[str, float] | None = None,
    cells: Sequence[str] = (),
) -> None:
    """A row of ``figures``, after ``cells``; below it their spreads where any are given."""
    row = (number(figures.get(key), digits) for key, digits in columns.values())
    table.add_row(name, *cells, *row)
    if spreads:
        row = (number(spreads.get(key + SPREAD), digits) for key, digits in columns.values())
        table.add_row("  +-", *("" for _ in cells), *row)


def console_of(width: int) -> Console:
    """A console for tables of this width: one that is cut when piped is of no use."""
    console = Console()
    console.width = max(console.width, width)
    return console


def number(value: float | None, digits: int) -> str:
    """A cell of a table; empty where the figure is not known."""
    return "" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
