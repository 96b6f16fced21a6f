"""Refined camera poses of one recording, or the start where nothing better can be shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.camera.rig import Rig
from intercap_core.capture.frames import Frames
from intercap_core.detection.read import Detections
from intercap_core.scene.background import Background
from intercap_core.scene.body_constraints import BodyConstraint, body_views
from intercap_core.scene.registration import Estimate, PairResiduals, Registration
from intercap_core.scene.surface import Surface, surface_of

BACKGROUND_CELL_M = 0.03
MAX_DEPTH_M = 5.0  # beyond, the depth's error is past a centimetre
MIN_CONFIDENCE = 0.3
MIN_BODY_POINTS = 50
MUST_IMPROVE = 0.98  # of the start's held-out cost
MAY_WORSEN = 1.02


@dataclass(frozen=True)
class Refinement:
    """``poses`` (C, 4, 4) master_from_colour, ``bias`` (C,) metres to subtract from depth,
    ``improved``, and the held-out residuals at the start and at the returned poses."""

    poses: np.ndarray
    bias: np.ndarray
    improved: bool
    before: PairResiduals
    after: PairResiduals


def refine(
    frames: Frames, detections: Detections, surfaces: dict[int, Surface], master: int
) -> Refinement:
    """Refine all cameras' poses but the ``master``'s; the start is kept where held-out points and
    keypoints together do not get better. ``surfaces`` as :func:`background_surfaces` gives."""
    rig = frames.rig
    start = Estimate(rig.master_from_colour.copy(), np.zeros(len(rig)))
    views = body_views(detections, rig, frames.time_s, min_confidence=MIN_CONFIDENCE)
    registration = Registration(rig, surfaces, master)
    body = BodyConstraint(views, rig) if len(views.points) >= MIN_BODY_POINTS else None
    before = registration.residuals(start)
    found = registration.solve(start, [body] if body else [])
    after = registration.residuals(found)
    if _better(before, after, body, start.poses, found.poses):
        return Refinement(found.poses, found.bias, True, before, after)
    return Refinement(start.poses, start.bias, False, before, before)


def _better(
    before: PairResiduals,
    after: PairResiduals,
    body: BodyConstraint | None,
    start: np.ndarray,
    found: np.ndarray,
) -> bool:
    if not np.isfinite(found).all():
        return False
    ratios = []
    if len(before.pairs) and len(after.pairs):
        ratios.append(_cost(after) / max(_cost(before), 1e-9))
    if body is not None:
        ratios.append(body.median_error(found) / max(body.median_error(start), 1e-9))
    return bool(ratios) and min(ratios) <= MUST_IMPROVE and max(ratios) <= MAY_WORSEN


def _cost(residuals: PairResiduals) -> float:
    """Mean of the pairs' medians: every pair counts the same, however much it overlaps."""
    return float(residuals.median.mean())


def background_surfaces(rig: Rig, backgrounds: list[Background | None]) -> dict[int, Surface]:
    """The static surface that each camera sees, in its depth camera's frame, by camera index."""
    surfaces = {}
    for c, background in enumerate(backgrounds):
        lens = rig[c].depth
        if background is not None and lens is not None:
            surfaces[c] = surface_of(
                background.depth,
                lens,
                keep=background.static,
                cell_m=BACKGROUND_CELL_M,
                max_depth_m=MAX_DEPTH_M,
            )
    return surfaces
