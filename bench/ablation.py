"""Errors of the joint fit without each of its terms, or with another variant of a term.

    python -m bench.ablation [SETTINGS] [--sequences NAME ...] [--variants NAME ...]
        [--output results/ablation.json] [--folder results/ablation]

Stages `joint` and `metrics` are computed for each variant in ``VARIANTS`` from the artefacts of a
run of SETTINGS (default: those of `make evaluate-quick`, which must have run). Results that are up
to date by their content are reused, so an interrupted run continues. Prints a table, writes its
figures with keys ``<variant>.<measure>``, and the table as Markdown into the folder. No file of the
project is overwritten.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from bench.again import artefacts_of, check_run, compute_once, slug
from bench.command import exit_on_user_error
from intercap_core.commands.console import ListTable, standard_console
from intercap_core.config import JointSettings
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.joint.problem import TERMS
from intercap_core.project import Project, load_project

SETTINGS = Path("config/evaluation/quick.yaml")
STAGES = ("joint", "metrics")  # what is computed for each variant
SEQUENTIAL = "sequential only"
# Settings of `joint` that differ from the project's, by the variant's name.
VARIANTS: dict[str, dict[str, Any]] = {
    "everything": {},
    "without contact": {"contact_weight": 0.0},
    "without stick": {"stick_weight": 0.0},
    "without contact and stick": {"contact_weight": 0.0, "stick_weight": 0.0},
    "without planting": {"plant_weight": 0.0},
    "without smoothness": {"body_smoothness": 0.0, "object_smoothness": 0.0},
    "without penetration": {"penetration_weight": 0.0},
    "without ground": {"ground_weight": 0.0},
    "without drift": {"drift_weight": 0.0},
    "without cameras": {"refine_cameras": False},
    "without renewed images": {"look_again": False, "refine_cameras": False},
    "contact to annotated vertices": {"contact_to": "annotated"},
}
# Terms whose weight is in none of these variants.
VARIANTS |= {
    f"without {term.equation.symbol}": {name: 0.0}
    for term in TERMS
    for name in term.equation.settings
    if isinstance(JointSettings.model_fields[name].default, float)
    and not any(name in settings for settings in VARIANTS.values())
}


@dataclass(frozen=True)
class Measure:
    """Column of the table."""

    title: str
    """Of the column."""
    name: str
    joint: str = "joint"
    sequential: str = "body_fit"


MEASURES = (
    Measure("body PVE mm", "body_pve_mm"),
    Measure("hands in grasp mm", "hand_grasp_mpjpe_mm"),
    Measure("slip mm/s", "slip_mm_s"),
    Measure("planted mm/s", "planted_mm_s"),
    Measure("floor mm", "floor_mm"),
    Measure("acceleration body", "acceleration_body_mm"),
    Measure("hands", "acceleration_hands_mm"),
    Measure("object mm", "object_translation_mm", sequential="object_track"),
    Measure("p95", "object_translation_p95_mm", sequential="object_track"),
    Measure("contact by vertex", "contact_f1"),
    Measure("detected F1", "contact_detected_f1", sequential=""),
    Measure("penetration mm", "mean_mm", joint="penetration", sequential=""),
)
Figures = dict[str, float]
Paths = dict[str, dict[str, dict[str, Path]]]  # by variant, sequence and stage


def ablate(
    settings: Path, sequences: Sequence[str], variants: Sequence[str], folder: Path
) -> dict[str, Figures]:
    """Compute all variants; returns figures by variant, the last entry of the sequential fits.

    Raises UserError if a sequence or variant is unknown, or has no truth or artefacts.
    """
    plain = load_project(settings)
    names = list(sequences or plain.sequences)
    check_run(plain, names, STAGES, variants, VARIANTS)
    projects = {  # all before the first is computed, so that invalid settings fail at once
        variant: load_project(settings, {"joint": VARIANTS[variant]}) for variant in variants
    }
    paths: Paths = {}
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        console=Console(stderr=True),
    )  # fmt: skip
    with bar as progress:
        task = progress.add_task("", total=len(variants) * len(names))
        for variant in variants:
            paths[variant] = {}
            for name in names:
                progress.update(task, description=f"{variant}: {name}")
                begin = time.perf_counter()
                paths[variant][name] = _fit(projects[variant], name, folder / slug(variant))
                seconds = time.perf_counter() - begin
                progress.console.print(f"{variant}: {name}, {seconds:.0f} s", highlight=False)
                progress.advance(task)
    return {
        **{variant: _figures(found, sequential=False) for variant, found in paths.items()},
        SEQUENTIAL: _figures(next(iter(paths.values())), sequential=True),
    }


def _fit(project: Project, sequence: str, folder: Path) -> dict[str, Path]:
    """The sequence's artefacts with joint and metrics of this variant, computed where missing."""
    paths = artefacts_of(project, sequence)
    for stage in STAGES:
        output = folder / sequence / f"{stage}.h5"
        paths[stage] = compute_once(stage, project, sequence, paths, output)
    return paths


def _figures(paths: Mapping[str, Mapping[str, Path]], *, sequential: bool) -> Figures:
    from bench.evaluate.sequences import areas

    found = areas([SequenceMetrics.read(by_stage["metrics"]) for by_stage in paths.values()])
    return {
        measure.name if measure.joint == "joint" else f"{measure.joint}_{measure.name}": value
        for measure in MEASURES
        if (area := measure.sequential if sequential else measure.joint)
        and (value := found[area].get(measure.name)) is not None
    }


def rows(figures: Mapping[str, Figures]) -> list[list[str]]:
    """Cells of the table, one row per variant, "–" where a figure is unknown."""
    keys = [m.name if m.joint == "joint" else f"{m.joint}_{m.name}" for m in MEASURES]
    return [
        [variant, *(_number(found[key]) if key in found else "–" for key in keys)]
        for variant, found in figures.items()
    ]


def _number(value: float) -> str:
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


def markdown(figures: Mapping[str, Figures], settings: Path, sequences: Sequence[str]) -> str:
    """A section for bench/RESULTS.md, without its heading's date and commit."""
    titles = ["variant", *(measure.title for measure in MEASURES)]
    lines = [
        "## What each term of the joint fit is worth",
        f"`python -m bench.ablation {settings}`, {', '.join(sequences)}. Accelerations are errors,",
        "mm a frame^2 at 30 fps; contact is F1; penetration is the joint fit's:",
        "",
        f"| {' | '.join(titles)} |",
        f"|{'---|' * len(titles)}",
        *(f"| {' | '.join(row)} |" for row in rows(figures)),
    ]
    return "\n".join(lines) + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line, compute, and write table and figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("settings", type=Path, nargs="?", default=SETTINGS)
    parser.add_argument("--sequences", nargs="+", metavar="NAME", help="default: all of SETTINGS")
    parser.add_argument(
        "--variants", nargs="+", metavar="NAME", help=f"default: all, {', '.join(VARIANTS)}"
    )
    parser.add_argument("--output", type=Path, default=Path("results/ablation.json"))
    parser.add_argument("--folder", type=Path, default=Path("results/ablation"))
    options = parser.parse_args(arguments)
    with exit_on_user_error():
        names = options.sequences or list(load_project(options.settings).sequences)
        variants = options.variants or list(VARIANTS)
        figures = ablate(options.settings, names, variants, options.folder)
    table = ListTable("variant", *(measure.title for measure in MEASURES))
    for row in rows(figures):
        table.add_row(*row)
    console = standard_console()
    console.print(table)
    section = options.folder / "RESULTS.md"
    section.write_text(markdown(figures, options.settings, names), encoding="utf-8")
    flat = {
        f"{slug(variant)}.{key}": round(value, 4)
        for variant, found in figures.items()
        for key, value in found.items()
    }
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(flat, indent=1) + "\n", encoding="utf-8")
    for path in (options.output, section):
        print(path)


if __name__ == "__main__":
    main()
