"""Part ``bodies`` of `intercap evaluate`: body fits compared with truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.table import Table

from intercap_core.commands.evaluate.part import (
    EvaluationPart,
    Measured,
    add_rows,
    console_of,
    keyed,
    number,
    spread,
    truth_of,
    variant,
)
from intercap_core.config import Config
from intercap_core.evaluation import body_errors
from intercap_core.evaluation.body_errors import BodyErrors
from intercap_core.evaluation.figures import Figures
from intercap_core.project import Project

Bodies = Measured[BodyErrors]
AREA = "body"
OTHER_AREAS = ("object",)  # datasets whose recordings are measured here too
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


def _start(evaluation: Bodies) -> str:
    """Prefix of the keys of a project's figures."""
    return variant(evaluation.dataset, AREA, *OTHER_AREAS)


def rig_of(config: Config) -> str:
    """Description of the cameras and depth that the settings select, and of the shape's fit."""
    cameras = config.frames.cameras
    words = [f"{len(cameras)} views" if len(cameras) > 1 else "1 view" if cameras else "all views"]
    if not config.frames.depth:
        words.append("no depth")
    if config.body_fit.shape == "per_frame":
        words.append("one shape per frame")
    return ", ".join(words)


def flat(evaluations: Sequence[Bodies]) -> dict[str, float]:
    """Keys ``body.pve_mm``, ``body.cup_drink.pve_mm``, ``body.noise2_pve_mm``.

    Recall and precision of the flags without a variant's prefix are over all projects, because a
    single project may have no bad frames. ``body.compared_...`` are figures of the project without
    a variant, over the recordings that variants also evaluate.
    """
    found: dict[str, float] = {}
    for evaluation in evaluations:
        start = _start(evaluation)
        found[f"{AREA}.{start}recordings"] = float(len(evaluation.errors))
        found |= _keys("", start, _with_spread(evaluation.errors))
        if evaluation is _reference(evaluations):
            for name, (mean, _, _) in body_errors.by_joint(evaluation.errors).items():
                found[f"{AREA}.joint_{name}_mm"] = mean
        if evaluation in _apart(evaluations):
            for name, recordings in body_errors.by_interaction(evaluation.errors).items():
                found |= _keys(f"{name}.", start, body_errors.figures(recordings))
    compared = _compared(evaluations)
    if compared:
        found |= _keys("", "compared_", _with_spread(compared))
    if _reference(evaluations) is not None:
        every = body_errors.flag_figures([e for found_ in evaluations for e in found_.errors])
        for key in _FLAGS:
            found.pop(f"{AREA}.{key}", None)
        found |= _keys("", "", {key: every[key] for key in _FLAGS if key in every})
    return found


def _with_spread(errors: Sequence[BodyErrors]) -> Figures:
    return body_errors.figures(errors) | spread(body_errors.figures, errors)


def _keys(group: str, start: str, figures: Mapping[str, float]) -> dict[str, float]:
    return keyed(f"{AREA}.{group}{start}", figures)


def _reference(evaluations: Sequence[Bodies]) -> Bodies | None:
    """The project that is not a variant; None if there is none."""
    return next((e for e in evaluations if not _start(e)), None)


def _apart(evaluations: Sequence[Bodies]) -> list[Bodies]:
    """Projects with their own recordings, that is not the reference's with fewer views or data."""
    reference = _reference(evaluations)
    known = {e.truth for e in reference.errors} if reference else set()
    return [e for e in evaluations if e is reference or not {x.truth for x in e.errors} <= known]


def _compared(evaluations: Sequence[Bodies]) -> list[BodyErrors]:
    """The reference's errors in the recordings that variants evaluate with less data."""
    reference = _reference(evaluations)
    others = [e for e in evaluations if e not in _apart(evaluations)]
    if reference is None or not others:
        return []
    shared = {x.truth for e in others for x in e.errors}
    return [x for x in reference.errors if x.truth in shared]


def print_bodies(evaluations: Sequence[Bodies]) -> None:
    """Print tables by interaction, by rig, by joint, and of each recording's worst frame."""
    console = console_of(190)
    apart = _apart(evaluations)
    for found in apart:
        _print_interactions(console, found)
    _print_rigs(console, evaluations)
    _print_joints(console, apart)
    _print_worst(console, evaluations)
    every = [e for found in evaluations for e in found.errors]
    flags = body_errors.flag_figures(every)
    console.print(
        f"bad frames in all: {sum(int(e.bad.sum()) for e in every)} of "
        f"{sum(len(e.bad) for e in every)}; flags' recall "
        f"{number(flags.get('bad_frames_recall'), 2) or '-'}, precision "
        f"{number(flags.get('bad_frames_precision'), 2) or '-'}",
        highlight=False,
    )


def _print_interactions(console: Console, found: Bodies) -> None:
    table = Table("interaction", "frames", *_COLUMNS, box=None)
    table.title = f"{found.dataset}: bodies against truth, mm, after body_fit"
    groups = body_errors.by_interaction(found.errors)
    for name, errors in {**groups, "all": list(found.errors)}.items():
        _add_row(table, name, errors, with_spread=name == "all")
    for name in found.missing:
        table.add_row(f"{name}: no fit")
    console.print(table)


def _print_rigs(console: Console, evaluations: Sequence[Bodies]) -> None:
    compared = _compared(evaluations)
    if not compared:
        return
    table = Table("rig", "frames", *_COLUMNS, box=None)
    table.title = f"the same {len(compared)} recordings with less"
    reference, apart = _reference(evaluations), _apart(evaluations)
    assert reference is not None
    _add_row(table, reference.rig, compared)
    for found in evaluations:
        if found in apart:
            continue
        _add_row(table, found.rig, found.errors)
        for name in found.missing:
            table.add_row(f"{found.rig}: {name}: no fit")
    console.print(table)


def _add_row(
    table: Table, name: str, errors: Sequence[BodyErrors], *, with_spread: bool = True
) -> None:
    figures = body_errors.figures(errors)
    spreads = spread(body_errors.figures, errors) if with_spread else None
    add_rows(table, name, figures, _COLUMNS, spreads, [number(figures.get("frames"), 0)])


def _print_joints(console: Console, evaluations: Sequence[Bodies]) -> None:
    """Print mean, 95th percentile and normalised error of each joint, for each project."""
    table = Table("joint", box=None, title="body joints: mean and p95, mm; median normalised error")
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
    table = Table(
        "recording", "rig", "frame", "PVE", "MPJPE", "worst joint", "mm", "hands", "flagged",
        box=None, title="each recording's worst frame",
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
    "bodies",
    "body_fit",
    ("frames", "scene", "person"),
    measure,
    flat,
    print_bodies,
    lambda project: rig_of(project.config),
    kept=BodyErrors,
)
