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
    config_files,
    grouped,
    keyed,
    truth_of,
    variant,
    with_spread,
)
from intercap_core.evaluation import object_errors
from intercap_core.evaluation.object_errors import ObjectErrors
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.project import Project

Objects = Measured[ObjectErrors]
AREA = "object"
# The dataset ``object`` and its copies with other random errors of the detector
REDRAWN = re.compile(rf"{AREA}(_redrawn\d+)?")


def measure(project: Project, sequence: str) -> ObjectErrors:
    """Errors of one recording's object after ``object_track``."""
    entry = project.object_of(sequence)
    assert entry is not None
    mesh = ObjectMesh.load(entry)
    paths = project.paths(sequence)
    truth = truth_of(project, sequence)
    return track_errors.measure(paths.scene, paths.object_track, truth, mesh)


def flat(evaluations: Sequence[Objects]) -> Figures:
    """Keys ``object.lost_share``, ``object.cup.lost_share``, ``object.views_2.lost_share``.

    Keys of a dataset object_<variant> are ``object.<variant>_lost_share`` and so on.
    """
    found: Figures = {}
    for tracked in evaluations:
        start = variant(tracked.dataset, AREA)
        found[f"{AREA}.{start}recordings"] = float(len(tracked.errors))
        for group, errors in {"": tracked.errors, **grouped(tracked.errors, "object_")}.items():
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
    draws = [grouped(e.errors, "object_") for e in evaluations if REDRAWN.fullmatch(e.dataset)]
    if len(draws) < 2:
        return {}
    return {
        name: [float(np.mean(np.concatenate([e.lost for e in draw[name]]))) for draw in draws]
        for name in sorted(set.intersection(*(set(draw) for draw in draws)))
    }


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
    columns=(
        "translation_median_mm", "translation_p95_mm", "rotation_median_deg", "rotation_p95_deg",
        "lost_share", "lost_unnoticed_share",
    ),
    areas=(AREA,),
    has=has_object,
)  # fmt: skip
