"""One view's part of E_O (equation 1) during a fit: weighted silhouette and depth terms.

The paper sets its lambdas empirically. Here they follow from the noise and from the number of
independent pixels of a view. Squared residuals are divided by their variance, and the pixels of a
term together count as a number of independent samples:

    lambda_depth = VIEW_SAMPLES n / (n + DEPTH_HALF_SAMPLES_PX) / n / sigma^2
    lambda_segm = trust VIEW_SAMPLES / m / CONTOUR_SIGMA_PX^2

for each of n depth pixels and m contour pixels (of the mask's contour or of the render's rim,
whichever has more). ``trust`` of a mask grows from 0.1 to 1 with its overlap with the render.
Residuals are in :mod:`.object_depth` and :mod:`.object_silhouette`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from intercap_core.geometry.rigid.shots import Rendering, Shot
from intercap_core.object_track import object_depth, object_silhouette
from intercap_core.object_track.likelihood import (
    CONTOUR_SIGMA_PX,
    DEPTH_HALF_SAMPLES_PX,
    VIEW_SAMPLES,
)
from intercap_core.object_track.patches import ContourPatch, DepthPatch
from intercap_core.object_track.reduced_mask import EMPTY
from intercap_core.object_track.view import FitContext, MaskCandidate, View
from intercap_core.object_track.view_report import (
    FREE_SPACE_M,
    MIN_RENDERED_PX,
    ViewReport,
    choose_candidate,
    mask_overlap,
    report_view,
)

# Standard deviation of one view's depth: systematic error and calibration, not pixel noise. Azure
# Kinect's data sheet states a systematic error below 11 mm + 0.1 % of the distance; half of that
# bound is a guess of its standard deviation.
DEPTH_SIGMA_M = 0.005  # metres; data sheet
# Geman-McClure scales of contours, first and last of a fit.
CONTOUR_SCALES_PX = (30.0, 6.0)  # pixels at full resolution; tuned
GATE_SCALES = 2.5  # robust scales; matches beyond weigh below 2 % and are left out (tuned)

NormalEquations = tuple[np.ndarray, np.ndarray]
"""J'WJ (6, 6) and J'Wr (6,), in units of one standard deviation."""


def shots_of(view: View, pose: np.ndarray) -> list[Shot]:
    """Return the shots to render at a pose (4, 4): colour image, then depth image if present."""
    geometry = view.geometry
    shots = [Shot(geometry.lens, geometry.camera.colour_from_master @ pose)]
    if view.depth is not None and geometry.depth_lens is not None:
        shots.append(Shot(geometry.depth_lens, geometry.camera.depth_from_master @ pose))
    return shots


class ViewFit:
    """One view during a fit: its chosen candidate and the measurements around it.

    All terms refer to the current pose and its renderings, set by the constructor and :meth:`see`.
    Before :meth:`choose` there is no candidate. Different views may be fitted in different threads.
    """

    def __init__(
        self, context: FitContext, view: View, pose: np.ndarray, drawn: list[Rendering]
    ) -> None:
        self._context = context
        self._view = view
        self._candidate: MaskCandidate | None = None
        self._contour_patch: ContourPatch | None = None
        self._depth_patch: DepthPatch | None = None
        self.see(pose, drawn)

    def see(self, pose: np.ndarray, drawn: list[Rendering]) -> None:
        """Set the current pose (4, 4) and its renderings, in the order of :func:`shots_of`."""
        self._pose = pose
        self._silhouette = drawn[0]
        self._drawn_depth = drawn[1] if len(drawn) > 1 else None

    def choose(self) -> None:
        """Choose the candidate with the largest overlap and cut the patches around it."""
        self._candidate = self._best_candidate()
        self._cut()

    def choose_again(self) -> bool:
        """Choose the candidate at the current pose again; returns whether it changed."""
        if self._best_candidate() is self._candidate:
            return False
        self.choose()
        return True

    def _best_candidate(self) -> MaskCandidate | None:
        context = self._context
        return choose_candidate(self._view, self._silhouette, context.labels, context.min_overlap)

    def _cut(self) -> None:
        """Cut the patches around the candidate, and set the trust in its mask."""
        mask = self._candidate.mask if self._candidate else EMPTY
        overlap = mask_overlap(self._silhouette, mask, self._view.person)
        # rises linearly from 0.1 at an IoU of 0.34 to 1 at 0.7; tuned on the studio
        self._contour_trust = float(np.clip((overlap - 0.3) / 0.4, 0.1, 1.0))
        self._contour_patch = self._depth_patch = None
        if self._candidate is not None:
            self._contour_patch = ContourPatch.cut(self._view, mask, self._silhouette)
        if self._drawn_depth is not None:
            self._depth_patch = DepthPatch.cut(self._view, mask, self._drawn_depth)

    def normal_equations(
        self, depth_scale_m: float, contour_scale_px: float, background: bool
    ) -> NormalEquations:
        """Return both terms of equation 1, weighted; ``contour_scale_px`` is at full resolution."""
        h_depth, g_depth = self.depth_terms(depth_scale_m)
        h_contour, g_contour, _ = self.contour_terms(contour_scale_px, background)
        return h_depth + h_contour, g_depth + g_contour

    def depth_terms(self, scale_m: float) -> NormalEquations:
        """Return the weighted depth term."""
        patch, drawn = self._depth_patch, self._drawn_depth
        if patch is None or drawn is None:
            return np.zeros((6, 6)), np.zeros(6)
        hessian, gradient, count = object_depth.normal_equations(
            drawn.depth, drawn.face, (drawn.x0 - patch.corner[0], drawn.y0 - patch.corner[1]),
            patch.depth, patch.points, patch.trust, self._context.mesh.face_normals,
            self._pose[:3, :3], self._pose[:3, 3],
            self._view.geometry.camera.master_from_depth[:3, 3], GATE_SCALES * scale_m, scale_m,
        )  # fmt: skip
        if count < MIN_RENDERED_PX:
            return np.zeros((6, 6)), np.zeros(6)
        samples = VIEW_SAMPLES * count / (count + DEPTH_HALF_SAMPLES_PX)
        noise = float(self._view.geometry.camera.stereo_sigma(self._pose[:3, 3]))
        weight = samples / count / (DEPTH_SIGMA_M**2 + noise**2)
        return weight * hessian, weight * gradient

    def contour_terms(
        self, scale_px: float, background: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the weighted silhouette term and its residuals (N,), reduced pixels.

        ``scale_px`` is at full resolution.
        """
        nothing = np.zeros((6, 6)), np.zeros(6), np.zeros(0)
        patch, drawn, geometry = self._contour_patch, self._silhouette, self._view.geometry
        # if the rendering leaves the patch, only depth is used until the patch is cut again
        if patch is None or not patch.holds(drawn):
            return nothing
        scale = scale_px / geometry.step
        corner = (drawn.x0, drawn.y0)
        at, target, missed, rim_size = object_silhouette.correspondences(
            drawn.face, corner, patch.inside, patch.person, patch.corner, patch.contour,
            patch.rim, patch.starts, background, GATE_SCALES * scale, MIN_RENDERED_PX,
        )  # fmt: skip
        # The first ``missed`` matches are those of mask pixels that the rendering misses. The
        # others are those of the rendering's rim outside of the mask. They are left out where
        # measured depth shows an occluder, or the object itself.
        measured, lens = self._depth_patch, geometry.depth_lens
        if measured is not None and lens is not None and missed < len(at):
            clear = object_silhouette.sees_past(
                at[missed:], drawn.depth, corner, geometry.lens.rays, geometry.depth_from_colour,
                lens.parameters, measured.depth, measured.corner, FREE_SPACE_M,
            )  # fmt: skip
            kept = np.concatenate([np.ones(missed, bool), clear])
            at, target = at[kept], target[kept]
        if len(at) < 3:
            return nothing
        hessian, gradient, residuals = object_silhouette.normal_equations(
            at, target, drawn.depth, corner, geometry.lens.rays, geometry.lens.parameters,
            geometry.camera.master_from_colour, self._pose[:3, 3], scale,
        )  # fmt: skip
        # normalised by the whole rim: a few pixels that are off weigh less than a whole rim
        samples = VIEW_SAMPLES / max(len(patch.contour), rim_size)
        weight = self._contour_trust * samples / (CONTOUR_SIGMA_PX / geometry.step) ** 2
        return weight * hessian, weight * gradient, residuals

    def report(self) -> ViewReport:
        """Compare the current renderings with the view."""
        report = report_view(
            self._context, self._view, self._pose, self._silhouette, self._drawn_depth,
            self._candidate,
        )  # fmt: skip
        contour = depth = float("nan")
        if self._candidate is not None:
            # four times the last scale of a fit, so that outliers count
            _, _, residuals = self.contour_terms(4 * CONTOUR_SCALES_PX[1], True)
            step = self._view.geometry.step
            contour = float(np.median(residuals)) * step if len(residuals) else 0.0
        patch, drawn = self._depth_patch, self._drawn_depth
        if patch is not None and drawn is not None:
            gap, across, where = object_depth.matches(
                drawn.depth, drawn.face, (drawn.x0 - patch.corner[0], drawn.y0 - patch.corner[1]),
                patch.depth, patch.points, self._context.mesh.face_normals,
                self._pose[:3, :3], self._view.geometry.camera.master_from_depth[:3, 3],
            )  # fmt: skip
            column, row = where.T
            # in metres; pixels whose depth differs by more show something else
            own = (patch.trust[row, column] == 1.0) & (np.abs(gap) < 0.1)
            if own.sum() >= MIN_RENDERED_PX:
                depth = float(np.median(across[own]))
        return replace(report, depth_residual_m=depth, contour_residual_px=contour)
