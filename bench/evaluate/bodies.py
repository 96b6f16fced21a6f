"""Part ``bodies`` of `intercap dev evaluate`: body fits compared with truth.

The reference is the dataset named ``object`` (or ``body``). Datasets such as ``object_noise2`` and
``body_two_view`` are its variants.
"""

from __future__ import annotations

from collections.abc import Sequence

from bench.evaluate import body_errors
from bench.evaluate.body_errors import BodyErrors
from bench.evaluate.part import (
    COMPARED,
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
from intercap_core.project import Project

Bodies = Measured[BodyErrors]
AREA = "body"
OTHER_AREAS = ("object",)  # datasets whose recordings are measured here too
_FLAGS = ("bad_frames_share", "bad_frames_recall", "bad_frames_precision")


def measure(project: Project, sequence: str) -> BodyErrors:
    """Errors of one recording's body after ``body_fit``."""
    return body_errors.measure(
        project.paths(sequence),
        truth_of(project, sequence),
        project.config.body_models,
        project.subjects[project.sequences[sequence].subject].gender,
    )


def _variant(evaluation: Bodies) -> str:
    return variant(evaluation.dataset, AREA, *OTHER_AREAS)


def flat(evaluations: Sequence[Bodies]) -> Figures:
    """Keys ``body.pve_mm``, ``body.cup_drink.pve_mm``, ``body.noise2_pve_mm``.

    Recall and precision of the flags without a variant's prefix are over all projects, because a
    single project may have no bad frames. ``body.compared_...`` are figures of the project without
    a variant, over the recordings that variants also evaluate.
    """
    found: Figures = {}
    reference = next((e for e in evaluations if not _variant(e)), None)
    known = {e.truth for e in reference.errors} if reference else set()
    # variants that use recordings of the reference with fewer views or less data
    reduced = [
        project
        for project in evaluations
        if project is not reference and {e.truth for e in project.errors} <= known
    ]
    for evaluation in evaluations:
        start = _variant(evaluation)
        found[f"{AREA}.{start}recordings"] = float(len(evaluation.errors))
        found |= keyed(f"{AREA}.{start}", with_spread(body_errors.figures, evaluation.errors))
        if evaluation is reference:
            found |= keyed(f"{AREA}.", body_errors.joint_figures(evaluation.errors))
        if evaluation not in reduced:
            for name, recordings in grouped(evaluation.errors, "interaction").items():
                found |= keyed(f"{AREA}.{name}.{start}", body_errors.figures(recordings))
    if reference is not None:
        shared = {e.truth for project in reduced for e in project.errors}
        compared = [e for e in reference.errors if e.truth in shared]
        found |= keyed(f"{AREA}.{COMPARED}", with_spread(body_errors.figures, compared))
        every = body_errors.flag_figures([e for some in evaluations for e in some.errors])
        for key in _FLAGS:
            found.pop(f"{AREA}.{key}", None)
        found |= keyed(f"{AREA}.", {key: every[key] for key in _FLAGS if key in every})
    return found


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
    columns=(
        "pve_mm", "pve_p95_mm", "mpjpe_mm", "hand_mpjpe_mm", "flagged_share", "bad_frames_share",
    ),
    areas=(AREA, *OTHER_AREAS),
)  # fmt: skip
