"""Errors of the joint fit without each of its terms, or with another variant of a term.

    python -m bench.ablation [SETTINGS] [--sequences NAME ...] [--variants NAME ...]
        [--output results/ablation.json] [--folder results/ablation]

Stages `joint` and `metrics` are computed for each variant in ``VARIANTS`` from the artefacts of a
run of SETTINGS (default: those of `make evaluate-quick`, which must have run). Results that are up
to date by their content are reused, so an interrupted run continues. Prints a table, and writes its
figures with keys ``<variant>.<measure>``. No file of the project is overwritten.

Accelerations are errors, mm a frame^2 at 30 fps; contact is F1; penetration is the joint fit's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.progress import track

from bench.again import artefacts_of, check_run, compute_once, slug, variants_parser
from bench.command import exit_on_user_error, replace_figures
from bench.evaluate.part import number
from intercap_core.commands.console import ListTable, standard_console
from intercap_core.config import JointSettings
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.joint.problem import TERMS
from intercap_core.project import Project, load_project

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


class Measure(NamedTuple):
    """Column of the table."""

    title: str
    """Of the column."""
    name: str
    joint: str = "joint"
    """Area of the figure after the joint fit."""
    sequential: str = "body_fit"
    """Area of the figure of the sequential fits; "" = none."""

    @property
    def key(self) -> str:
        """Key of the figure, without its variant."""
        return self.name if self.joint == "joint" else f"{self.joint}_{self.name}"


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
    found: dict[str, list[SequenceMetrics]] = {variant: [] for variant in variants}
    jobs = [(variant, name) for variant in variants for name in names]
    for variant, name in track(jobs, "variants"):
        paths = _fit(projects[variant], name, folder / slug(variant))
        found[variant].append(SequenceMetrics.read(paths["metrics"]))
    return {
        **{variant: _figures(metrics, sequential=False) for variant, metrics in found.items()},
        SEQUENTIAL: _figures(next(iter(found.values())), sequential=True),
    }


def _fit(project: Project, sequence: str, folder: Path) -> dict[str, Path]:
    """The sequence's artefacts with joint and metrics of this variant, computed where missing."""
    paths = artefacts_of(project, sequence)
    for stage in STAGES:
        output = folder / sequence / f"{stage}.h5"
        paths[stage] = compute_once(stage, project, sequence, paths, output)
    return paths


def _figures(metrics: Sequence[SequenceMetrics], *, sequential: bool) -> Figures:
    from bench.evaluate.sequences import areas

    found = areas(metrics)
    return {
        measure.key: value
        for measure in MEASURES
        if (area := measure.sequential if sequential else measure.joint)
        and (value := found[area].get(measure.name)) is not None
    }


def print_table(figures: Mapping[str, Figures]) -> None:
    """Print one row per variant; cells of unknown figures are empty."""
    table = ListTable("variant", *(measure.title for measure in MEASURES))
    for variant, found in figures.items():
        table.add_row(variant, *(number(found.get(measure.key), 2) for measure in MEASURES))
    standard_console().print(table)


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line, compute, and write table and figures."""
    options = variants_parser(__doc__, VARIANTS, "ablation").parse_args(arguments)
    with exit_on_user_error():
        figures = ablate(options.settings, options.sequences, options.variants, options.folder)
    print_table(figures)
    flat = {
        f"{slug(variant)}.{key}": round(value, 4)
        for variant, found in figures.items()
        for key, value in found.items()
    }
    replace_figures(options.output, flat, ("",))
    print(options.output)


if __name__ == "__main__":
    main()
