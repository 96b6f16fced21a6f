"""One view's part of E_O (equation 1) while a pose is fitted: silhouette and depth, weighed.

The paper's lambdas are set empirically; here they follow from noise and from how many pixels of a
view err independently. A term counts as so many samples in units of their standard deviation:

    lambda_depth = DEPTH_SAMPLES n / (n + DEPTH_HALF_SAMPLES_PX) / n / DEPTH_SIGMA_M^2
    lambda_segm = trust CONTOUR_SAMPLES / m / CONTOUR_SIGMA_PX^2

for each of n depth pixels and of m contour pixels (of the mask's contour or of the render's rim,
whichever has more), with ``trust`` of a mask from CONTOUR_TRUST_MIN to 1 by its overlap with the
render (CONTOUR_TRUST_OVERLAP, CONTOUR_TRUST_RANGE). All are in
:mod:`intercap_core.object_track.constants`; the residuals are in
:mod:`intercap_core.object_track.object_depth` and
:mod:`intercap_core.object_track.object_silhouette`.
"""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.shots import Rendering, Shot
from intercap_core.object_track import object_depth_kernel, object_silhouette_kernel
from intercap_core.object_track.candidates import choose, mask_overlap, visible_pixels
from intercap_core.object_track.constants import (
    CONTOUR_SAMPLES,
    CONTOUR_SIGMA_PX,
    CONTOUR_TRUST_MIN,
    CONTOUR_TRUST_OVERLAP,
    CONTOUR_TRUST_RANGE,
    DEPTH_HALF_SAMPLES_PX,
    DEPTH_SAMPLES,
    DEPTH_SIGMA_M,
    FREE_SPACE_M,
    GATE_SCALES,
    MIN_CONTOUR_MATCHES,
    MIN_RENDERED_PX,
    REPORT_DEPTH_M,
)
from intercap_core.object_track.likelihood import log_ratio
from intercap_core.object_track.patches import ContourPatch, DepthPatch
from intercap_core.object_track.reduced_mask import EMPTY
from intercap_core.object_track.view import Candidate, View
from intercap_core.object_track.view_report import ViewReport, depth_agreement, unhidden

NormalEquations = tuple[np.ndarray, np.ndarray]
"""J'WJ (6, 6) and J'Wr (6,), in units of one standard deviation."""


def shots_of(view: View, pose: np.ndarray) -> list[Shot]:
    """What is drawn of a pose (4, 4) master_from_object: the colour image and, if any, depth."""
    geometry = view.geometry
    shots = [Shot(geometry.lens, geometry.colour_from_master @ pose)]
    if view.depth is not None and geometry.depth_lens is not None:
        shots.append(Shot(geometry.depth_lens, geometry.depth_from_master @ pose))
    return shots


class ViewFit:
    """One view while a pose is fitted: its chosen candidate and the measured points around.

    It looks at one pose at a time, (4, 4) with its renderings: that of the constructor, then those
    of :meth:`see`. Before :meth:`choose` no candidate counts. It may run beside the other views'
    on another thread.
    """

    def __init__(
        self,
        mesh: ObjectMesh,
        view: View,
        min_overlap: float,
        labels: tuple[str, ...],
        pose: np.ndarray,
        drawn: list[Rendering],
    ) -> None:
        self._mesh = mesh
        self._view = view
        self._min_overlap = min_overlap
        self._labels = labels
        self._candidate: Candidate | None = None
        self._contour_patch: ContourPatch | None = None
        self._depth_patch: DepthPatch | None = None
        self.see(pose, drawn)

    def see(self, pose: np.ndarray, drawn: list[Rendering]) -> None:
        """Look at a pose (4, 4) whose renderings are ``drawn``, in the order of :func:`shots_of`"""
        self._pose = pose
        self._silhouette = drawn[0]
        self._drawn_depth = drawn[1] if len(drawn) > 1 else None

    # --- evidence ------------------------------------------------------------------------------

    def choose(self) -> None:
        """Keep the candidate that overlaps the render most, and cut the evidence around it."""
        self._candidate = choose(self._view, self._silhouette, self._min_overlap, self._labels)
        self._cut()

    def choose_again(self) -> bool:
        """Choose the candidate anew at the current pose; returns whether it has changed."""
        found = choose(self._view, self._silhouette, self._min_overlap, self._labels)
        if found is self._candidate:
            return False
        self._candidate = found
        self._cut()
        return True

    def _cut(self) -> None:
        mask = self._candidate.mask if self._candidate else EMPTY
        overlap = mask_overlap(self._silhouette, mask, self._view.person)
        self._contour_trust = float(
            np.clip((overlap - CONTOUR_TRUST_OVERLAP) / CONTOUR_TRUST_RANGE, CONTOUR_TRUST_MIN, 1.0)
        )
        self._contour_patch = self._depth_patch = None
        if self._candidate is not None:
            self._contour_patch = ContourPatch.cut(self._view, mask, self._silhouette)
        if self._drawn_depth is not None:
            self._depth_patch = DepthPatch.cut(self._view, mask, self._drawn_depth)

    # --- the energy at the pose that is seen ---------------------------------------------------

    def normal_equations(
        self, depth_scale_m: float, contour_scale_px: float, background: bool
    ) -> NormalEquations:
        """Both terms of equation 1, weighed; ``contour_scale_px`` is at full resolution."""
        h_depth, g_depth = self.depth_terms(depth_scale_m)
        h_contour, g_contour = self.contour_terms(contour_scale_px, background)
        return h_depth + h_contour, g_depth + g_contour

    def contour_terms(self, scale_px: float, background: bool) -> NormalEquations:
        """The silhouette's term, weighed; ``scale_px`` is at full resolution."""
        hessian, gradient, _ = self._contour_terms(scale_px, background)
        return hessian, gradient

    def depth_terms(self, scale_m: float) -> NormalEquations:
        """The depth's term, weighed."""
        patch, drawn = self._depth_patch, self._drawn_depth
        if patch is None or drawn is None:
            return np.zeros((6, 6)), np.zeros(6)
        hessian, gradient, count = object_depth_kernel.normal_equations(
            drawn.depth,
            drawn.face,
            (drawn.x0 - patch.x0, drawn.y0 - patch.y0),
            patch.depth,
            patch.points,
            patch.trust,
            self._mesh.face_normals,
            self._pose[:3, :3],
            self._pose[:3, 3],
            self._view.geometry.master_from_depth[:3, 3],
            GATE_SCALES * scale_m,
            scale_m,
        )
        if count < MIN_RENDERED_PX:
            return np.zeros((6, 6)), np.zeros(6)
        samples = DEPTH_SAMPLES * count / (count + DEPTH_HALF_SAMPLES_PX)
        weight = samples / count / DEPTH_SIGMA_M**2
        return weight * hessian, weight * gradient

    def _contour_terms(
        self, scale_px: float, background: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The normal equations and the residuals (N,) in pixels of the reduced image."""
        nothing = np.zeros((6, 6)), np.zeros(6), np.zeros(0)
        patch, drawn, geometry = self._contour_patch, self._silhouette, self._view.geometry
        # the render has left the mask's window: depth alone is used until the window is cut again
        if patch is None or not patch.holds(drawn):
            return nothing
        scale = scale_px / geometry.step
        corner = (drawn.x0, drawn.y0)
        at, target, missed, rim_size = object_silhouette_kernel.correspondences(
            drawn.face,
            corner,
            patch.inside,
            patch.person,
            patch.place,
            patch.contour,
            patch.rim,
            patch.starts,
            background,
            GATE_SCALES * scale,
            MIN_RENDERED_PX,
        )
        measured, lens = self._depth_patch, geometry.depth_lens
        if measured is not None and lens is not None and missed < len(at):
            clear = object_silhouette_kernel.sees_past(
                at[missed:],
                drawn.depth,
                corner,
                geometry.lens.rays,
                geometry.depth_from_colour,
                lens.parameters,
                measured.depth,
                measured.place,
                FREE_SPACE_M,
            )
            kept = np.concatenate([np.ones(missed, bool), clear])
            at, target = at[kept], target[kept]
        if len(at) < MIN_CONTOUR_MATCHES:
            return nothing
        hessian, gradient, residuals = object_silhouette_kernel.normal_equations(
            at,
            target,
            drawn.depth,
            corner,
            geometry.lens.rays,
            geometry.lens.parameters,
            geometry.master_from_colour,
            self._pose[:3, 3],
            scale,
        )
        # Normalised by the size of the whole rim, not by the number of residuals: a few outlier
        # pixels of a rim that fits elsewhere weigh less than a rim that is off all around.
        samples = CONTOUR_SAMPLES / max(len(patch.contour), rim_size)
        weight = self._contour_trust * samples / (CONTOUR_SIGMA_PX / geometry.step) ** 2
        return weight * hessian, weight * gradient, residuals

    # --- the outcome ---------------------------------------------------------------------------

    def report(self, contour_scale_px: float) -> ViewReport:
        """Compare the renderings with the view; the scale is at full resolution."""
        view, image = self._view, self._silhouette
        overlap = contour = float("nan")
        if self._candidate is not None:
            overlap = mask_overlap(image, self._candidate.mask, view.person)
            _, _, residuals = self._contour_terms(contour_scale_px, True)
            contour = float(np.median(residuals)) * view.geometry.step if len(residuals) else 0.0
        visible = visible_pixels(image, view.person)
        depth_residual = agreement = float("nan")
        patch, drawn = self._depth_patch, self._drawn_depth
        if patch is not None and drawn is not None:
            gap, across, where = object_depth_kernel.matches(
                drawn.depth,
                drawn.face,
                (drawn.x0 - patch.x0, drawn.y0 - patch.y0),
                patch.depth,
                patch.points,
                self._mesh.face_normals,
                self._pose[:3, :3],
                view.geometry.master_from_depth[:3, 3],
            )
            column, row = where.T
            mine = (patch.trust[row, column] == 1.0) & (np.abs(gap) < REPORT_DEPTH_M)
            if mine.sum() >= MIN_RENDERED_PX:
                depth_residual = float(np.median(across[mine]))
            agreement, free = depth_agreement(gap, across, patch.on_person[row, column])
            visible = unhidden(image, visible, free, len(gap))
        number = self._candidate.index if self._candidate is not None else -1
        ratio = log_ratio(
            self._mesh,
            view,
            self._pose,
            image,
            self._drawn_depth,
            self._candidate,
            visible,
            self._labels,
        )
        return ViewReport(
            number, overlap, depth_residual, contour, visible, agreement, view.detected, ratio
        )
