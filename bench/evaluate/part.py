"""Common code of the parts of an evaluation: measure recordings, combine their figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from intercap_core.errors import UserError
from intercap_core.project import Project, load_project

Errors = TypeVar("Errors")
Figures = dict[str, float]
Targets = Sequence[tuple[str, Project]]  # last stage and project

SPREAD = "_spread"  # suffix of the standard error of a figure
COMPARED = "compared_"  # prefix of figures over the recordings that variants share
# Figures without a standard error, like those whose key contains "worst"
COUNTS = (
    "frames", "captures", "slips_true", "slips_missed", "slips_false", "object_worse_count",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Measured(Generic[Errors]):
    """Errors of the recordings of one project."""

    dataset: str
    """Name of the project's dataset."""
    errors: Sequence[Errors]
    """Errors of each recording that has an artefact of the stage."""
    missing: Sequence[str] = ()
    """Names of the recordings without one."""
    names: Sequence[str] = ()
    """Names of the recordings of ``errors``."""


@dataclass(frozen=True, kw_only=True)
class EvaluationPart(Generic[Errors]):
    """One part of the evaluation: how its recordings are computed, measured and reported."""

    name: str
    """Name of the module in this package."""
    stage: str
    """Stage whose artefact is compared with the truth."""
    settings: Sequence[Path]
    """Settings files that are evaluated by default."""
    budget_minutes: float
    """Minutes on two cores that the part may add to `make evaluate`, for its recordings and the
    stages that no earlier part computes. Their sum is 83 minutes."""
    measure: Callable[[Project, str], Errors]
    """Measures the errors of (project, sequence)."""
    flat: Callable[[Sequence[Measured[Errors]]], Figures]
    """Returns the figures of all projects, keys ``area.measure``."""
    columns: Sequence[str]
    """Figures of single recordings that are printed: ``measure``, or ``area.measure`` if several
    areas have the measure."""
    areas: Sequence[str] = ()
    """Areas whose datasets have variants, see :func:`variant`."""
    problems: Callable[[Errors], Sequence[str]] = lambda _: ()
    """Returns the reasons why figures of a recording are missing."""
    has: Callable[[Project, str], bool] = lambda _project, _sequence: True
    """Whether (project, sequence) has the measured quantity."""
    last: Callable[[Project], str | None] = lambda _: None
    """Last stage of a project's workflow if it is later than ``stage``."""
    timed: Callable[[Project, str], Figures] | None = None
    """Measures durations of (project, sequence), once per evaluation."""

    def targets(self, projects: Sequence[Project]) -> Targets:
        """The last stage of each project's workflow."""
        return [(self.last(project) or self.stage, project) for project in projects]

    def time_one(self, projects: Sequence[Project]) -> Figures:
        """Figures of ``timed`` for the first recording with an artefact; empty if there is none."""
        recordings = (
            (project, name)
            for project in projects
            for name in project.sequences
            if project.artefact(name, self.stage).is_file()
        )
        first = next(recordings, None)
        return {} if self.timed is None or first is None else self.timed(*first)

    def measure_all(self, projects: Sequence[Project], *, workers: int) -> list[Measured[Errors]]:
        """Measure every recording that has an artefact of the stage, in parallel processes.

        Raises UserError if no sequence of a project has one.
        """
        wanted = [[n for n in project.sequences if self.has(project, n)] for project in projects]
        names = [
            [name for name in own if project.artefact(name, self.stage).is_file()]
            for project, own in zip(projects, wanted, strict=True)
        ]
        jobs = []
        for project, own in zip(projects, names, strict=True):
            if not own:
                raise UserError(
                    f"{project.path}: no sequence has an artefact of stage {self.stage!r}; "
                    f"see the logs in {project.logs}"
                )
            jobs += [(self.name, project.path, name) for name in own]
        context = get_context("spawn")  # a fork would lose the threads of numerical libraries
        with ProcessPoolExecutor(min(workers, len(jobs)), mp_context=context) as pool:
            errors = iter(list(pool.map(_measure_recording, *zip(*jobs, strict=True))))
        return [
            Measured(
                project.config.dataset,
                [next(errors) for _ in own],
                [name for name in all_names if name not in own],
                own,
            )
            for project, all_names, own in zip(projects, wanted, names, strict=True)
        ]


def _measure_recording(part: str, settings: Path, sequence: str) -> Any:
    module = import_module(f"bench.evaluate.{part}")
    return measure_recording(module.PART, load_project(settings), sequence)


def measure_recording(part: EvaluationPart[Errors], project: Project, sequence: str) -> Errors:
    """Errors of one recording. Raises UserError if its truth is missing."""
    truth = truth_of(project, sequence)
    if not truth.is_file():
        raise UserError(
            f"{truth}: the truth of {sequence!r} is missing, but its {part.stage} artefact exists; "
            f"remove {project.results / sequence} and start again: both will be recomputed"
        )
    return part.measure(project, sequence)


def config_files(folder: str, *names: str) -> tuple[Path, ...]:
    """Settings files ``config/<folder>/<name>.yaml``."""
    return tuple(Path("config", folder, f"{name}.yaml") for name in names)


def truth_of(project: Project, sequence: str) -> Path:
    """File with the truth of a recording; every evaluated one has it (:func:`require_truth`)."""
    truth = project.sequences[sequence].truth
    assert truth is not None
    return truth


def require_truth(project: Project) -> None:
    """Raise UserError if a sequence has no truth."""
    for name, row in project.sequences.items():
        if row.truth is None:
            raise UserError(
                f"{project.path}: sequence {name!r} has no truth to be evaluated against; remove "
                "it, or add its truth to the table of sequences"
            )


def variant(dataset: str, *areas: str) -> str:
    """Prefix of the figures of a dataset that varies the conditions of another one.

    "noise2_" for the dataset object_noise2 in the area object, "" for the dataset object.
    """
    for area in areas:
        if dataset == area or dataset.startswith(f"{area}_"):
            dataset = dataset.removeprefix(area)
            break
    name = dataset.strip("_")
    return f"{name}_" if name else ""


def grouped(recordings: Sequence[Errors], name: str) -> dict[str, list[Errors]]:
    """The recordings by the value of their attribute ``name``, sorted."""
    values = sorted({getattr(recording, name) for recording in recordings})
    return {value: [r for r in recordings if getattr(r, name) == value] for value in values}


def keyed(prefix: str, figures: Mapping[str, float]) -> Figures:
    """The figures with ``prefix`` before each key."""
    return {f"{prefix}{key}": value for key, value in figures.items()}


def with_spread(
    figures: Callable[[Sequence[Errors]], Mapping[str, float]], recordings: Sequence[Errors]
) -> Figures:
    """Figures over the recordings and their standard errors, keys ``<figure>_spread``.

    The standard error is the sample standard deviation of the recordings' own figures over the
    square root of their number. Counts, extremes and figures of one recording have none.
    """
    samples: dict[str, list[float]] = {}
    for recording in recordings:
        for key, value in figures([recording]).items():
            name = key.rpartition(".")[2]
            if math.isfinite(value) and name not in COUNTS and "worst" not in name:
                samples.setdefault(key, []).append(value)
    return dict(figures(recordings)) | {
        f"{key}{SPREAD}": float(np.array(values).std(ddof=1) / np.sqrt(len(values)))
        for key, values in samples.items()
        if len(values) > 1
    }


def number(value: float | None, digits: int) -> str:
    """Text of a table's cell; empty for an unknown figure."""
    return "" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
