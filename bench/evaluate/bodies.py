"""Part ``bodies`` of `intercap dev evaluate`: body fits compared with truth.

The reference is the dataset named ``object`` (or ``body``). Datasets such as ``object_noise2`` and
``body_two_view`` are its variants.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rich.console import Console
from rich.table import Table

from bench.evaluate import body_errors
from bench.evaluate.body_errors import BodyErrors
from bench.evaluate.part import (
    EvaluationPart,
    Figures,
    Measured,
    add_rows,
    config_files,
    keyed,
    number,
    truth_of,
    variant,
    with_spread,
)
from intercap_core.commands.console import ListTable, standard_console
from intercap_core.config import Config
from intercap_core.project import Project

Bodies = Measured[BodyErrors]
AREA = "body"
OTHER_AREAS = ("object",)  # datasets whose recordings are measured here too
# Heading of each column, key of its figure and digits. "floor" is the distance of the true body to
# the cloud, the noise floor of the column before; "norm." is the error over its stated deviation.
_COLUMNS = {
    "PVE": ("pve_mm", 1), "p95": ("pve_p95_mm", 1), "seen": ("pve_visible_mm", 1),
    "MPJPE": ("mpjpe_mm", 1), "hands": ("hand_mpjpe_mm", 1), "grasp": ("hand_grasp_mpjpe_mm", 1),
    "wrist": ("hand_wrist_mpjpe_mm", 1), "face": ("face_mm", 1), "form": ("face_aligned_mm", 1),
    "to mesh": ("cloud_to_mesh_mm", 1), "floor": ("cloud_to_mesh_floor_mm", 1),
    "to cloud": ("mesh_to_cloud_visible_mm", 1), "floor ": ("mesh_to_cloud_visible_floor_mm", 1),
    "norm.": ("normalised_median", 2), "hands ": ("normalised_hand_median", 2),
    "flagged": ("flagged_share", 3), "bad": ("bad_frames_share", 3),
}  # fmt: skip
_FLAGS = ("bad_frames_share", "bad_frames_recall", "bad_frames_precision")


def measure(project: Project, sequence: str) -> BodyErrors:
    """Errors of one recording's body after ``body_fit``."""
    return body_errors.measure(
        project.paths(sequence),
        truth_of(project, sequence),
        project.config.body_models,
        project.subjects[project.sequences[sequence].subject].gender,
    )


def rig_of(config: Config) -> str:
    """Description of the cameras and depth that the settings select, and of the shape's fit."""
    cameras = config.frames.cameras
    words = [f"{len(cameras)} views" if len(cameras) > 1 else "1 view" if cameras else "all views"]
    if not config.frames.depth:
        words.append("no depth")
    if config.body_fit.shape == "per_frame":
        words.append("one shape per frame")
    return ", ".join(words)


class _Projects(NamedTuple):
    """The evaluated projects, by their recordings."""

    reference: Bodies | None
    """The project that is not a variant."""
    separate: list[Bodies]
    """The reference and the variants with recordings of their own."""
    reduced: list[Bodies]
    """Variants that use recordings of the reference with fewer views or less data."""
    compared: list[BodyErrors]
    """Errors of the reference in the recordings of ``reduced``."""


def _sort(evaluations: Sequence[Bodies]) -> _Projects:
    """Sort the projects by whether they have the recordings of the reference."""
    reference = next((e for e in evaluations if not _variant(e)), None)
    known = {e.truth for e in reference.errors} if reference else set()
    separate: list[Bodies] = []
    reduced: list[Bodies] = []
    for project in evaluations:
        own = project is reference or not {e.truth for e in project.errors} <= known
        (separate if own else reduced).append(project)
    shared = {e.truth for project in reduced for e in project.errors}
    compared = [e for e in reference.errors if e.truth in shared] if reference else []
    return _Projects(reference, separate, reduced, compared)


def _variant(evaluation: Bodies) -> str:
    return variant(evaluation.dataset, AREA, *OTHER_AREAS)


def flat(evaluations: Sequence[Bodies]) -> Figures:
    """Keys ``body.pve_mm``, ``body.cup_drink.pve_mm``, ``body.noise2_pve_mm``.

    Recall and precision of the flags without a variant's prefix are over all projects, because a
    single project may have no bad frames. ``body.compared_...`` are figures of the project without
    a variant, over the recordings that variants also evaluate.
    """
    found: Figures = {}
    projects = _sort(evaluations)
    for evaluation in evaluations:
        start = _variant(evaluation)
        found[f"{AREA}.{start}recordings"] = float(len(evaluation.errors))
        found |= keyed(f"{AREA}.{start}", with_spread(body_errors.figures, evaluation.errors))
        if evaluation is projects.reference:
            for name, (mean, _, _) in body_errors.by_joint(evaluation.errors).items():
                found[f"{AREA}.joint_{name}_mm"] = mean
        if evaluation in projects.separate:
            for name, recordings in body_errors.by_interaction(evaluation.errors).items():
                found |= keyed(f"{AREA}.{name}.{start}", body_errors.figures(recordings))
    if projects.compared:
        compared = with_spread(body_errors.figures, projects.compared)
        found |= keyed(f"{AREA}.compared_", compared)
    if projects.reference is not None:
        every = body_errors.flag_figures([e for some in evaluations for e in some.errors])
        for key in _FLAGS:
            found.pop(f"{AREA}.{key}", None)
        found |= keyed(f"{AREA}.", {key: every[key] for key in _FLAGS if key in every})
    return found


def print_bodies(evaluations: Sequence[Bodies]) -> None:
    """Print tables by interaction, by rig, by joint, and of each recording's worst frame."""
    console = standard_console()
    projects = _sort(evaluations)
    for found in projects.separate:
        _print_interactions(console, found)
    if projects.compared:
        _print_rigs(console, projects)
    _print_joints(console, projects.separate)
    _print_worst(console, evaluations)
    every = [e for found in evaluations for e in found.errors]
    flags = body_errors.flag_figures(every)
    print(
        f"bad frames in all: {sum(int(e.bad.sum()) for e in every)} of "
        f"{sum(len(e.bad) for e in every)}; flags' recall "
        f"{number(flags.get('bad_frames_recall'), 2) or '-'}, precision "
        f"{number(flags.get('bad_frames_precision'), 2) or '-'}"
    )


def _print_interactions(console: Console, found: Bodies) -> None:
    table = ListTable("interaction", "frames", *_COLUMNS)
    table.title = f"{found.dataset}: bodies against truth, mm, after body_fit"
    for name, errors in body_errors.by_interaction(found.errors).items():
        figures = body_errors.figures(errors)
        add_rows(table, name, figures, _COLUMNS, [number(figures["frames"], 0)])
    _add_row(table, "all", found.errors)
    for name in found.missing:
        table.add_row(f"{name}: no fit")
    console.print(table)


def _print_rigs(console: Console, projects: _Projects) -> None:
    assert projects.reference is not None
    table = ListTable("rig", "frames", *_COLUMNS)
    table.title = f"the same {len(projects.compared)} recordings with less"
    _add_row(table, projects.reference.rig, projects.compared)
    for found in projects.reduced:
        _add_row(table, found.rig, found.errors)
        for name in found.missing:
            table.add_row(f"{found.rig}: {name}: no fit")
    console.print(table)


def _add_row(table: Table, name: str, errors: Sequence[BodyErrors]) -> None:
    figures = with_spread(body_errors.figures, errors)
    add_rows(table, name, figures, _COLUMNS, [number(figures.get("frames"), 0)])


def _print_joints(console: Console, evaluations: Sequence[Bodies]) -> None:
    """Print mean, 95th percentile and normalised error of each joint, for each project."""
    table = ListTable("joint", title="body joints: mean and p95, mm; median normalised error")
    columns = [body_errors.by_joint(found.errors) for found in evaluations]
    for found in evaluations:
        for head in (found.dataset, "p95", "norm."):
            table.add_column(head)
    for joint in body_errors.BODY_JOINT_NAMES:
        cells = [
            number(value, digits)
            for column in columns
            for value, digits in zip(column[joint], (1, 1, 2), strict=True)
        ]
        table.add_row(joint, *cells)
    console.print(table)


def _print_worst(console: Console, evaluations: Sequence[Bodies]) -> None:
    table = ListTable(
        "recording", "rig", "frame", "PVE", "MPJPE", "worst joint", "mm", "hands", "flagged",
        title="each recording's worst frame",
    )  # fmt: skip
    for found in evaluations:
        for e in found.errors:
            t = e.worst
            joint = int(e.joints[t].argmax())
            table.add_row(
                f"{found.dataset}/{e.sequence}",
                found.rig,
                str(t),
                number(1e3 * e.pve[t], 1),
                number(1e3 * float(e.joints[t].mean()), 1),
                body_errors.BODY_JOINT_NAMES[joint],
                number(1e3 * float(e.joints[t, joint]), 1),
                " ".join(number(1e3 * float(hand), 0) for hand in e.hands[t]),
                "yes" if e.flagged[t] else "",
            )
    console.print(table)


PART = EvaluationPart(
    name="bodies",
    stage="body_fit",
    settings=(
        *config_files("object", "config", "noise_2", "family_b"),
        *config_files(
            "body", "per_frame_shape", "rgb_only", "four_view", "two_view", "two_view_rgb_only",
            "one_view",
        ),
    ),
    budget_minutes=5.2,
    measure=measure,
    flat=flat,
    print_tables=print_bodies,
    rig=lambda project: rig_of(project.config),
)  # fmt: skip
