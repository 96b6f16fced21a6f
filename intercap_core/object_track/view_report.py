"""How a view agrees with a pose: overlap of the masks, depth where nothing is in front."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.shots import Rendering
from intercap_core.object_track import object_depth_kernel
from intercap_core.object_track.candidates import choose, mask_overlap, visible_pixels
from intercap_core.object_track.constants import AGREEMENT_SCALE_M, FREE_SPACE_M, MIN_RENDERED_PX
from intercap_core.object_track.likelihood import log_ratio
from intercap_core.object_track.view import View


@dataclass(frozen=True)
class ViewReport:
    """How one view agrees with a pose.

    ``overlap`` IoU of candidate and visible render (NaN: no candidate); ``depth_residual_m`` and
    ``contour_residual_px`` medians (NaN: none); ``visible_px`` rendered pixels that nothing
    hides; ``depth_agreement`` how close to the render they are measured, 0 to 1 (NaN: no depth);
    ``detected``: candidates are known for this image, so that none says something.
    """

    candidate: int
    overlap: float
    depth_residual_m: float
    contour_residual_px: float
    visible_px: int
    depth_agreement: float
    detected: bool = True
    log_ratio: float = 0.0


def quick_report(
    mesh: ObjectMesh,
    view: View,
    pose: np.ndarray,
    silhouette: Rendering,
    drawn_depth: Rendering | None,
    min_overlap: float,
    labels: tuple[str, ...],
) -> ViewReport:
    """Compare the renderings of a pose (4, 4) with the view, no correspondences: overlap, depth."""
    candidate = choose(view, silhouette, min_overlap, labels)
    overlap = mask_overlap(silhouette, candidate.mask, view.person) if candidate else float("nan")
    visible = visible_pixels(silhouette, view.person)
    agreement = float("nan")
    geometry = view.geometry
    if view.depth is not None and drawn_depth is not None and geometry.depth_lens is not None:
        compared, free, total = object_depth_kernel.agreement(
            drawn_depth.depth,
            drawn_depth.face,
            drawn_depth.x0,
            drawn_depth.y0,
            view.depth,
            geometry.depth_lens.rays,
            mesh.face_normals,
            geometry.depth_from_master[:3, :3] @ pose[:3, :3],
            FREE_SPACE_M,
            AGREEMENT_SCALE_M,
        )
        if free >= MIN_RENDERED_PX:
            agreement = total / free
        visible = unhidden(silhouette, visible, free, compared)
    number = candidate.index if candidate else -1
    nothing = float("nan")
    ratio = log_ratio(mesh, view, pose, silhouette, drawn_depth, candidate, visible, labels)
    return ViewReport(number, overlap, nothing, nothing, visible, agreement, view.detected, ratio)


def depth_agreement(
    gap: np.ndarray, across: np.ndarray, on_person: np.ndarray
) -> tuple[float, int]:
    """How well measured depth fits where nothing is in front, and of how many pixels that holds.

    ``gap`` (N,) measured minus rendered depth, ``across`` (N,) the same across the surface, both
    metres; pixels on a person (N,) and those measured nearer do not count. NaN for too few.
    """
    free = ~on_person & (gap > -FREE_SPACE_M)
    count = int(free.sum())
    if count < MIN_RENDERED_PX:
        return float("nan"), count
    scale = AGREEMENT_SCALE_M**2
    return float((scale / (scale + across[free] ** 2)).mean()), count


def unhidden(silhouette: Rendering, visible: int, free: int, compared: int) -> int:
    """Pixels of a rendered silhouette that nothing hides: of those that no person's mask covers
    (``visible``) at most the share ``free`` of ``compared`` before which depth finds nothing."""
    if compared <= MIN_RENDERED_PX:
        return visible
    if free < MIN_RENDERED_PX:
        return 0
    return min(visible, round(int(silhouette.mask.sum()) * free / compared))
