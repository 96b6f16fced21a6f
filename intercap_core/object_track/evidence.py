"""What the views of one frame set say about small motions of a pose, each view for itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import Renderer, default_renderer
from intercap_core.object_track.constants import (
    COMMON_ERROR_VARIANCE,
    CONTOUR_SCALES_PX,
    DEPTH_SCALES_M,
    MIN_NOISE_VARIANCE,
    REPORT_CONTOUR_SCALE,
    UNKNOWN_SIGMA,
)
from intercap_core.object_track.fit import view_fits
from intercap_core.object_track.view import View
from intercap_core.object_track.view_fit import NormalEquations, ViewFit
from intercap_core.object_track.view_report import ViewReport


@dataclass(frozen=True)
class PoseEvidence:
    """What each view of a frame set says about small motions of a pose: the weighted J'J
    ``information`` (V, 6, 6) and J'r ``gradient`` (V, 6) of (turn on the left, shift), in units of
    one standard deviation; zero from a view that says nothing. No prior is in them. ``of_depth``
    (V, 6, 6) and ``depth_gradient`` (V, 6) are the part of them that depth gives. ``reports`` is
    how each view agrees with the pose."""

    information: np.ndarray
    gradient: np.ndarray
    of_depth: np.ndarray
    depth_gradient: np.ndarray
    reports: tuple[ViewReport, ...]


def evidence_at(
    mesh: ObjectMesh,
    views: list[View],
    pose: np.ndarray,
    *,
    min_overlap: float,
    background_term: bool,
    labels: tuple[str, ...] = (),
    twist: np.ndarray | None = None,
    renderer: Renderer | None = None,
) -> PoseEvidence:
    """The images' evidence at ``pose`` (4, 4) with the last, sharpest robust scales."""
    renderer = renderer or default_renderer()
    fits = view_fits(renderer, mesh, views, pose, min_overlap, labels, twist)

    def terms(fit: ViewFit) -> tuple[NormalEquations, NormalEquations, ViewReport]:
        fit.choose()
        depth = fit.depth_terms(DEPTH_SCALES_M[1])
        contour = fit.contour_terms(CONTOUR_SCALES_PX[1], background_term)
        return depth, contour, fit.report(REPORT_CONTOUR_SCALE * CONTOUR_SCALES_PX[1])

    found = renderer.pool.map(terms, fits)
    depth = [np.array(part) for part in zip(*(one[0] for one in found), strict=True)]
    contour = [np.array(part) for part in zip(*(one[1] for one in found), strict=True)]
    return PoseEvidence(
        depth[0] + contour[0],
        depth[1] + contour[1],
        depth[0],
        depth[1],
        tuple(report for *_, report in found),
    )


def report_at(
    mesh: ObjectMesh,
    view: View,
    pose: np.ndarray,
    *,
    min_overlap: float,
    labels: tuple[str, ...] = (),
    twist: np.ndarray | None = None,
    renderer: Renderer | None = None,
) -> ViewReport:
    """How one view agrees with ``pose`` (4, 4): what :func:`evidence_at` reports of it."""
    renderer = renderer or default_renderer()
    (fit,) = view_fits(renderer, mesh, [view], pose, min_overlap, labels, twist)
    fit.choose()
    return fit.report(REPORT_CONTOUR_SCALE * CONTOUR_SCALES_PX[1])


def views_noise(found: Sequence[PoseEvidence]) -> float:
    """Factor of the evidence's stated variance, from how far the views' gradients disagree.

    At the minimum each view v of a frame still has a gradient g_v; if its errors are independent,
    with s^2 times its stated variance, E[g_v g_v'] = s^2 H_v less its share in the minimum. What
    all views have in common (calibration, masks that are too large) does not show and comes on top.
    """
    squares = freedom = 0.0
    for evidence in found:
        total = evidence.information.sum(0) + np.diag(UNKNOWN_SIGMA**-2)
        inverse = np.linalg.inv(total)
        share = np.einsum("vij,ji->v", evidence.information, inverse) / 6
        gradient = evidence.gradient
        squares += float(np.einsum("vi,ij,vj->", gradient, inverse, gradient))
        freedom += float((6 * share * (1 - share)).sum())
    apart = squares / freedom if freedom > 1 else 1.0
    return float(np.clip(apart, MIN_NOISE_VARIANCE / COMMON_ERROR_VARIANCE, 1.0))
