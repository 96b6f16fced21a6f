"""Refined camera poses of one recording, or the start where nothing better can be shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.camera.rig import Rig
from intercap_core.capture.frames import Frames
from intercap_core.detection.read import Detections
from intercap_core.scene.background import Background
from intercap_core.scene.body_constraints import BodyConstraint, BodyViews, body_views
from intercap_core.scene.registration import Estimate, PairResiduals, Patch, Registration
from intercap_core.scene.surface import surface_of

BACKGROUND_CELL_M = 0.03
FOREGROUND_CELL_M = 0.015
MAX_DEPTH_M = 5.0  # beyond, the depth's error is past a centimetre
# The subject's own surface is a good target too, where it hardly moves: at this speed a camera
# that is 30 ms late sees it 3 mm off.
MAX_SPEED_M_S = 0.10
MOMENTS = 8
QUIET_MARGIN_S = 0.2  # the subject rests this long before and after: cameras may slip frames
FOREGROUND_GAP_M = 0.05
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
    frames: Frames, detections: Detections, backgrounds: list[Background | None], master: int
) -> Refinement:
    """Refine all cameras' poses but the ``master``'s; the start is kept where held-out points and
    keypoints together do not get better."""
    rig = frames.rig
    start = Estimate(rig.master_from_colour.copy(), np.zeros(len(rig)))
    views = body_views(detections, rig, frames.time_s, min_confidence=MIN_CONFIDENCE)
    patches = _background_patches(rig, backgrounds)
    patches += _quiet_patches(frames, rig, backgrounds, views)
    registration = Registration(rig, patches, master)
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


def _background_patches(rig: Rig, backgrounds: list[Background | None]) -> list[Patch]:
    patches = []
    for c, background in enumerate(backgrounds):
        lens = rig[c].depth
        if background is None or lens is None:
            continue
        surface = surface_of(
            background.depth,
            lens,
            keep=background.static,
            cell_m=BACKGROUND_CELL_M,
            max_depth_m=MAX_DEPTH_M,
        )
        patches.append(Patch(c, 0, surface))
    return patches


def quiet_sets(speed: np.ndarray, times: np.ndarray) -> np.ndarray:
    """At most :data:`MOMENTS` sets in which the subject rests, far apart in time."""
    worst = np.full(len(speed), np.inf)
    for t, time in enumerate(times):
        near = np.abs(times - time) <= QUIET_MARGIN_S
        if np.isfinite(speed[near]).all():
            worst[t] = speed[near].max()
    quiet = np.flatnonzero(worst <= MAX_SPEED_M_S)
    if len(quiet) <= MOMENTS:
        return quiet
    return quiet[np.linspace(0, len(quiet) - 1, MOMENTS).round().astype(int)]


def _quiet_patches(
    frames: Frames, rig: Rig, backgrounds: list[Background | None], views: BodyViews
) -> list[Patch]:
    patches = []
    for moment, t in enumerate(quiet_sets(views.speed, frames.time_s), start=1):
        for c, background in enumerate(backgrounds):
            lens, depth = rig[c].depth, frames.depth(int(t), c)
            if background is None or lens is None or depth is None:
                continue
            gap = background.depth.astype(np.int32) - depth
            surface = surface_of(
                depth,
                lens,
                keep=(background.depth > 0) & (gap > FOREGROUND_GAP_M * 1000),
                cell_m=FOREGROUND_CELL_M,
                max_depth_m=MAX_DEPTH_M,
            )
            patches.append(Patch(c, moment, surface))
    return patches
