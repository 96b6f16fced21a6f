"""Part ``objects`` of `intercap dev evaluate`: object tracks compared with truth."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from bench.evaluate import track_errors
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
from intercap_core.evaluation import object_errors
from intercap_core.evaluation.object_errors import ObjectErrors
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.project import Project

Objects = Measured[ObjectErrors]
AREA = "object"
# The dataset ``object`` and its copies with other random errors of the detector
REDRAWN = re.compile(rf"{AREA}(_redrawn\d+)?")
_COLUMNS = {
    "mm": ("translation_median_mm", 1), "p95": ("translation_p95_mm", 1),
    "deg": ("rotation_median_deg", 2), "p95 deg": ("rotation_p95_deg", 1),
    "ADD-S": ("add_s_recall", 2), "MSSD": ("mssd_recall", 2), "first": ("first_frame_success", 2),
    "lost": ("lost_share", 3), "unseen": ("lost_unnoticed_share", 3),
    "flagged": ("flagged_share", 2), "rest mm": ("rest_jitter_mm", 2),
    "rest deg": ("rest_jitter_deg", 2), "onset": ("motion_onset_frames", 1),
}  # fmt: skip


def measure(project: Project, sequence: str) -> ObjectErrors:
    """Errors of one recording's object after ``object_track``."""
    entry = project.object_of(sequence)
    assert entry is not None
    mesh = ObjectMesh.load(entry)
    paths = project.paths(sequence)
    truth = truth_of(project, sequence)
    return track_errors.measure(paths.scene, paths.object_track, truth, mesh)


def by_object(errors: Sequence[ObjectErrors]) -> dict[str, list[ObjectErrors]]:
    """The recordings of each object, by name."""
    names = sorted({e.object_ for e in errors})
    return {name: [e for e in errors if e.object_ == name] for name in names}


def flat(evaluations: Sequence[Objects]) -> Figures:
    """Keys ``object.lost_share``, ``object.cup.lost_share``, ``object.views_2.lost_share``.

    Keys of a dataset object_<variant> are ``object.<variant>_lost_share`` and so on.
    """
    found: Figures = {}
    for tracked in evaluations:
        start = variant(tracked.dataset, AREA)
        found[f"{AREA}.{start}recordings"] = float(len(tracked.errors))
        for group, errors in {"": tracked.errors, **by_object(tracked.errors)}.items():
            figures = with_spread(object_errors.figures, errors)
            found |= keyed(f"{AREA}.{group}{'.' if group else ''}{start}", figures)
        for views, figures in track_errors.by_views(tracked.errors).items():
            found |= keyed(f"{AREA}.{start}views_{views.replace('-', '_to_')}.", figures)
    drawn = lost_by_draw(evaluations)
    spreads = {name: max(shares) - min(shares) for name, shares in drawn.items()}
    found |= {f"{AREA}.{name}.lost_spread": value for name, value in spreads.items()}
    if spreads:
        found[f"{AREA}.lost_spread"] = float(np.mean(list(spreads.values())))
    return found


def lost_by_draw(evaluations: Sequence[Objects]) -> dict[str, list[float]]:
    """Share of lost frames of each object for each draw of the detector errors.

    Only objects that all draws have; empty if there is only one draw.
    """
    draws = [by_object(e.errors) for e in evaluations if REDRAWN.fullmatch(e.dataset)]
    if len(draws) < 2:
        return {}
    return {
        name: [float(np.mean(np.concatenate([e.lost for e in draw[name]]))) for draw in draws]
        for name in sorted(set.intersection(*(set(draw) for draw in draws)))
    }


def print_objects(evaluations: Sequence[Objects]) -> None:
    """Print for each project a table by object and a table by number of views."""
    console = standard_console()
    for found in evaluations:
        table = ListTable("object", *_COLUMNS)
        table.title = f"{found.dataset}: objects against truth, after object_track"
        for name, errors in by_object(found.errors).items():
            add_rows(table, name, object_errors.figures(errors), _COLUMNS)
        add_rows(table, "all", with_spread(object_errors.figures, found.errors), _COLUMNS)
        for name in found.missing:
            table.add_row(f"{name}: no track")
        console.print(table)
        table = ListTable("views that see it", "frames", "mm", "deg", "lost")
        for name, figures in track_errors.by_views(found.errors).items():
            digits = (0, 1, 2, 3)
            table.add_row(
                name, *(number(v, d) for v, d in zip(figures.values(), digits, strict=True))
            )
        console.print(table)
    drawn = lost_by_draw(evaluations)
    if drawn:
        table = ListTable("object", "lost, redrawn detections", "spread")
        for name, shares in drawn.items():
            each = "  ".join(number(share, 3) for share in shares)
            table.add_row(name, each, number(max(shares) - min(shares), 3))
        console.print(table)


def has_object(project: Project, sequence: str) -> bool:
    """Whether the recording has an object."""
    return project.object_of(sequence) is not None


PART = EvaluationPart(
    name="objects",
    stage="object_track",
    settings=config_files("object", "config", "no_detector", "noise_2", "family_b"),
    budget_minutes=7.4,
    measure=measure,
    flat=flat,
    print_tables=print_objects,
    has=has_object,
)
