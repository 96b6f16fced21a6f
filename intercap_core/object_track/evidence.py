"""What the views of one frame set say about small motions of a pose, each view for itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.object_track.constants import (
    CONTOUR_SCALES_PX,
    DEPTH_SCALES_M,
    REPORT_CONTOUR_SCALE,
)
from intercap_core.object_track.fit import view_fits
from intercap_core.object_track.view import View
from intercap_core.object_track.view_fit import NormalEquations, ViewFit
from intercap_core.object_track.view_report import ViewReport
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.rigid.render import Renderer, default_renderer


@dataclass(frozen=True)
class PoseEvidence:
    """What each view of a frame set says about small motions of a pose: the weighted J'J
    ``information`` (V, 6, 6) and J'r ``gradient`` (V, 6) of (turn on the left, shift), in units of
    one standard deviation; zero from a view that says nothing. No prior is in them. ``reports`` is
    how each view agrees with the pose."""

    information: np.ndarray
    gradient: np.ndarray
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

    def terms(fit: ViewFit) -> tuple[NormalEquations, ViewReport]:
        fit.choose()
        found = fit.normal_equations(DEPTH_SCALES_M[1], CONTOUR_SCALES_PX[1], background_term)
        return found, fit.report(REPORT_CONTOUR_SCALE * CONTOUR_SCALES_PX[1])

    found = renderer.pool.map(terms, fits)
    return PoseEvidence(
        np.array([h for (h, _), _ in found]),
        np.array([g for (_, g), _ in found]),
        tuple(report for _, report in found),
    )
