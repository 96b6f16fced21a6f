"""Agreement of a view with a pose: overlap of the masks, and pixels that nothing occludes.

The candidate that shows the object is the one that overlaps the rendered object most, as in the
paper (render-compare-and-preserve).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from intercap_core.geometry.rigid.shots import Rendering
from intercap_core.object_track.likelihood import log_ratio
from intercap_core.object_track.reduced_mask import EMPTY, ReducedMask, covers
from intercap_core.object_track.view import FitContext, MaskCandidate, View

MIN_RENDERED_PX = 12  # renderings with fewer pixels are not compared; tuned
# Depth that differs from the render by more than this shows the background (farther) or an occluder
# (nearer). The value is above the systematic errors of sensor and pose.
FREE_SPACE_M = 0.03  # metres; tuned


def choose_candidate(
    view: View, predicted: Rendering, labels: tuple[str, ...], min_overlap: float = 0.1
) -> MaskCandidate | None:
    """Choose the candidate with the largest overlap with the visible render.

    0.05 is added to the overlap of candidates with one of the object's labels, which breaks ties.
    Returns None if no overlap reaches ``min_overlap``, whose default is for poses without a fit.
    """
    best, best_rank = None, 0.0
    if predicted.area < MIN_RENDERED_PX:
        return None
    for candidate in view.candidates:
        overlap = mask_overlap(predicted, candidate.mask, view.person)
        rank = overlap + (0.05 if candidate.label in labels else 0.0)
        if overlap >= min_overlap and rank > best_rank:
            best, best_rank = candidate, rank
    return best


def mask_overlap(image: Rendering, mask: ReducedMask, person: ReducedMask) -> float:
    """Return the IoU of a mask and the visible part of a render.

    A rendered pixel is visible if the mask shows it or no person is there.
    """
    if not image.meets(mask.x0, mask.y0, *mask.mask.shape):
        return 0.0
    visible, common = _compare(image.face, (image.x0, image.y0), person.placed, mask.placed)
    return common / max(1, visible + mask.area - common)


def visible_pixels(image: Rendering, person: ReducedMask) -> int:
    """Count the pixels of a render that no person hides."""
    if not image.meets(person.x0, person.y0, *person.mask.shape):
        return image.area
    return int(_compare(image.face, (image.x0, image.y0), person.placed, EMPTY.placed)[0])


@numba.njit(cache=True, nogil=True)
def _compare(face, corner, person, mask):
    """Count the rendered pixels that are visible (:func:`mask_overlap`), and those in the mask.

    ``corner`` is the first pixel (x, y) of the rendering in the image.
    """
    visible, common = 0, 0
    for v in range(face.shape[0]):
        for u in range(face.shape[1]):
            if face[v, u] < 0:
                continue
            x, y = u + corner[0], v + corner[1]
            if covers(mask, x, y):
                visible += 1
                common += 1
            elif not covers(person, x, y):
                visible += 1
    return visible, common


@dataclass(frozen=True, slots=True)
class ViewReport:
    """Agreement of one view with a pose. Residuals are NaN if nothing was compared."""

    candidate: int
    """Index of the chosen candidate, -1 = none."""
    overlap: float
    """IoU of candidate and visible render; NaN without a candidate."""
    visible_px: int
    """Rendered pixels that are not occluded."""
    log_ratio: float = 0.0
    """Log-likelihood ratio, nats (:mod:`.likelihood`)."""
    depth_residual_m: float = float("nan")
    """Median point-to-plane distance, metres."""
    contour_residual_px: float = float("nan")
    """Median contour distance, pixels at full resolution."""


def report_view(
    context: FitContext,
    view: View,
    pose: np.ndarray,
    silhouette: Rendering,
    drawn_depth: Rendering | None,
    candidate: MaskCandidate | None,
) -> ViewReport:
    """Compare the renderings of a pose (4, 4) with a view and its chosen candidate.

    ``drawn_depth`` is None without depth.
    """
    visible = _count_unoccluded(view, silhouette, drawn_depth)
    ratio = log_ratio(context, view, pose, silhouette, drawn_depth, candidate, visible)
    if candidate is None:
        return ViewReport(-1, float("nan"), visible, ratio)
    overlap = mask_overlap(silhouette, candidate.mask, view.person)
    return ViewReport(candidate.index, overlap, visible, ratio)


def _count_unoccluded(view: View, silhouette: Rendering, drawn_depth: Rendering | None) -> int:
    """Estimate the pixels of a silhouette that neither a person nor anything nearer occludes."""
    visible = visible_pixels(silhouette, view.person)
    if drawn_depth is None or view.depth is None:
        return visible
    measured = view.depth[drawn_depth.window]
    compared = drawn_depth.mask & (measured > 0)
    free = compared & (measured > drawn_depth.depth - FREE_SPACE_M)
    compared_px, free_px = np.count_nonzero(compared), np.count_nonzero(free)
    if compared_px <= MIN_RENDERED_PX:
        return visible
    if free_px < MIN_RENDERED_PX:
        return 0
    return min(visible, round(silhouette.area * free_px / compared_px))
