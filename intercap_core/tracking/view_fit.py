"""One view's part of the object's energy: correspondences at a pose, residuals, agreement."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core.energy import object_depth, object_silhouette
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.rigid.render import Rendering, render
from intercap_core.tracking.evidence import Candidate, DepthPatch, View
from intercap_core.tracking.reduced_mask import EMPTY, ReducedMask

DEPTH_SIGMA_M = 0.005  # of one view: ranging bias and calibration rather than pixel noise
CONTOUR_SIGMA_PX = 2.0  # of a detector's contour at full resolution
# A view's pixels err together, so each term of a view counts as few independent samples.
DEPTH_SAMPLES = 4.0
CONTOUR_SAMPLES = 3.0
OUTSIDE_MASK_WEIGHT = 0.3  # of a depth pixel at the rendered depth that the candidate leaves out
LIKELY_LABEL_BONUS = 0.05  # of overlap: breaks ties between candidates
FREE_SPACE_M = 0.03  # measured this much behind the render: known background
PATCH_MARGIN_M = 0.08  # the pose may move this far before measured points leave the patch
AGREEMENT_SCALE_M = 0.010  # a depth pixel off by this counts half
GATE = 2.5  # correspondences farther than this many robust scales are left out
MIN_PIXELS = 12  # fewer rendered pixels say nothing

Terms = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Residuals (N,), Jacobian (N, 6) and weights (N,)."""


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


@dataclass(frozen=True)
class _DepthMatches:
    """Measured and rendered points under the same pixels, master frame, metres.

    ``observed``, ``hit``, ``normals`` (N, 3); ``trust`` (N,) 1 inside the candidate; ``gap`` (N,)
    measured minus rendered depth; ``on_person`` (N,) bool.
    """

    observed: np.ndarray
    hit: np.ndarray
    normals: np.ndarray
    trust: np.ndarray
    gap: np.ndarray
    on_person: np.ndarray

    @property
    def across(self) -> np.ndarray:
        """Distance (N,) of the measured points from the rendered planes, metres."""
        return np.abs(np.einsum("ij,ij->i", self.normals, self.observed - self.hit))


class ViewFit:
    """One view while a pose is fitted: its chosen candidate and the measured points around.

    Renderings of the last pose asked for are kept, so that asking again costs nothing.
    """

    def __init__(
        self,
        mesh: ObjectMesh,
        view: View,
        pose: np.ndarray,
        min_overlap: float,
        labels: tuple[str, ...],
    ) -> None:
        self._mesh = mesh
        self._view = view
        self._camera = view.geometry.camera
        self._lens = view.geometry.lens
        self._min_overlap = min_overlap
        self._labels = labels
        self._silhouette: tuple[np.ndarray, Rendering] | None = None
        self._depth_image: tuple[np.ndarray, Rendering] | None = None
        self._candidate = choose(view, self._draw_silhouette(pose), min_overlap, labels)
        self._cut(pose)

    # --- evidence ------------------------------------------------------------------------------

    def choose_again(self, pose: np.ndarray) -> bool:
        """Look at the candidates again from a new pose; whether another one is kept now."""
        found = choose(self._view, self._draw_silhouette(pose), self._min_overlap, self._labels)
        if found is self._candidate:
            return False
        self._candidate = found
        self._cut(pose)
        return True

    def _cut(self, pose: np.ndarray) -> None:
        self._mask = self._candidate.mask if self._candidate else EMPTY
        image = self._draw_silhouette(pose)
        self._cut_silhouette(image)
        person = self._view.person.window(image.x0, image.y0, *image.mask.shape)
        overlap = mask_overlap(image, self._mask, person)
        self._contour_trust = float(np.clip((overlap - 0.3) / 0.4, 0.1, 1.0))
        self._cut_depth(pose)

    def _cut_silhouette(self, predicted: Rendering) -> None:
        """Window over the render, the mask's contour there, and who else is in it."""
        self._contour = np.zeros((0, 2), np.int64)
        if self._candidate is None:
            return
        margin = int(_pixels_per_metre(predicted, self._lens.fx) * PATCH_MARGIN_M) + 4
        height, width = predicted.mask.shape
        left, top = max(predicted.x0 - margin, 0), max(predicted.y0 - margin, 0)
        right = min(predicted.x0 + width + margin, self._lens.width)
        bottom = min(predicted.y0 + height + margin, self._lens.height)
        self._window = (left, top, right - left, bottom - top)
        shape = (bottom - top, right - left)
        self._inside = self._mask.window(left, top, *shape)
        self._person = self._view.person.window(left, top, *shape) & ~self._inside
        contour = object_silhouette.rim(self._inside)
        # where the mask ends because a person is in front there is no contour of the object
        own = contour & (cv2.dilate(self._person.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
        self._contour = np.argwhere(own)[:, ::-1]
        every = np.argwhere(contour)[:, ::-1]
        self._mask_rim = object_silhouette.NearestRim(every) if len(every) else None

    def _cut_depth(self, pose: np.ndarray) -> None:
        """Measured points around the predicted render, and how far each may be trusted."""
        self._patch = None
        lens = self._view.geometry.depth_lens
        if lens is None or self._view.depth is None:
            return
        predicted = self._draw_depth(pose)
        if not predicted.mask.any():
            return
        margin = int(_pixels_per_metre(predicted, lens.fx) * PATCH_MARGIN_M) + 2
        height, width = predicted.mask.shape
        self._patch = DepthPatch.cut(
            self._view,
            predicted.x0 - margin,
            predicted.y0 - margin,
            predicted.x0 + width + margin,
            predicted.y0 + height + margin,
        )
        if self._patch is not None:
            inside = self._patch.sample(self._mask)
            self._on_person = self._patch.sample(self._view.person) & ~inside
            self._trust = np.where(inside, 1.0, np.where(self._on_person, 0.0, OUTSIDE_MASK_WEIGHT))

    def _draw_silhouette(self, pose: np.ndarray) -> Rendering:
        if self._silhouette is None or self._silhouette[0] is not pose:
            image = draw_silhouette(self._mesh, self._view, pose)
            self._silhouette = (pose, image)
        return self._silhouette[1]

    def _draw_depth(self, pose: np.ndarray) -> Rendering:
        if self._depth_image is None or self._depth_image[0] is not pose:
            image = draw_depth(self._mesh, self._view, pose)
            self._depth_image = (pose, image)
        return self._depth_image[1]

    # --- the energy at one pose ----------------------------------------------------------------

    def normal_equations(
        self, pose: np.ndarray, depth_scale_m: float, contour_scale_px: float, background: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Weighted J'J (6, 6) and J'r (6,) of both terms, in units of one standard deviation.

        ``contour_scale_px`` is at full resolution.
        """
        hessian, gradient = np.zeros((6, 6)), np.zeros(6)
        step = self._view.geometry.step
        for residual, jacobian, weight in (
            self._depth_terms(pose, depth_scale_m),
            self._contour_terms(pose, contour_scale_px / step, background),
        ):
            weighted = jacobian * weight[:, None]
            hessian += weighted.T @ jacobian
            gradient += weighted.T @ residual
        return hessian, gradient

    def _depth_terms(self, pose: np.ndarray, scale_m: float) -> Terms:
        found = self._match_depth(pose)
        if found is None:
            return _nothing()
        near = (np.abs(found.gap) < GATE * scale_m) & (found.trust > 0)
        if near.sum() < MIN_PIXELS:
            return _nothing()
        residual, jacobian = object_depth.residuals(
            found.observed[near], found.hit[near], found.normals[near], pose[:3, 3]
        )
        weight = found.trust[near] * _geman_mcclure(residual, scale_m)
        samples = DEPTH_SAMPLES * len(residual) / (len(residual) + 10 * MIN_PIXELS)
        weight *= samples / len(residual) / DEPTH_SIGMA_M**2
        return residual, jacobian, weight

    def _match_depth(self, pose: np.ndarray) -> _DepthMatches | None:
        patch = self._patch
        if patch is None:
            return None
        image = self._draw_depth(pose)
        mask = image.mask
        y, x = np.nonzero(mask)
        y, x = y + (image.y0 - patch.y0), x + (image.x0 - patch.x0)
        inside = (x >= 0) & (y >= 0) & (x < patch.depth.shape[1]) & (y < patch.depth.shape[0])
        inside[inside] &= patch.depth[y[inside], x[inside]] > 0
        x, y = x[inside], y[inside]
        rendered = image.depth[mask][inside].astype(np.float64)
        measured = patch.depth[y, x]
        observed = patch.points[y, x].astype(np.float64)
        # the rendered point lies on the same ray as the measured one
        eye = self._camera.master_from_depth[:3, 3]
        hit = eye + (observed - eye) * (rendered / measured)[:, None]
        normals = self._mesh.face_normals[image.face[mask][inside]] @ pose[:3, :3].T
        return _DepthMatches(
            observed, hit, normals, self._trust[y, x], measured - rendered, self._on_person[y, x]
        )

    def _contour_terms(self, pose: np.ndarray, scale_px: float, background: bool) -> Terms:
        if self._candidate is None or self._mask_rim is None:
            return _nothing()
        image = self._draw_silhouette(pose)
        left, top, width, height = self._window
        own_height, own_width = image.mask.shape
        right, bottom = left + width, top + height
        if (
            image.x0 < left
            or image.y0 < top
            or image.x0 + own_width > right
            or image.y0 + own_height > bottom
        ):
            return _nothing()  # moved out of the evidence: depth alone leads until it is cut anew
        drawn = np.zeros((height, width), bool)
        depth = np.zeros((height, width), np.float32)
        place = np.s_[
            image.y0 - top : image.y0 - top + own_height,
            image.x0 - left : image.x0 - left + own_width,
        ]
        drawn[place], depth[place] = image.mask, image.depth
        rim = np.argwhere(object_silhouette.rim(drawn))[:, ::-1]
        if len(rim) < MIN_PIXELS:
            return _nothing()
        at, targets = [], []
        missed = self._contour[~drawn[self._contour[:, 1], self._contour[:, 0]]]
        if len(missed):
            nearest = object_silhouette.NearestRim(rim)
            distance, index = nearest.query(missed, GATE * scale_px)
            close = np.isfinite(distance)
            at.append(rim[index[close]])
            targets.append(missed[close])
        if background:
            x, y = rim.T
            extra = rim[~self._inside[y, x] & ~self._person[y, x]]
            distance, index = self._mask_rim.query(extra, GATE * scale_px)
            close = np.isfinite(distance)
            extra, index = extra[close], index[close]
            clear = self._is_background(
                extra + np.array([left, top]), depth[extra[:, 1], extra[:, 0]]
            )
            at.append(extra[clear])
            targets.append(self._mask_rim.pixels[index[clear]])
        if sum(map(len, at)) < 3:
            return _nothing()
        pixels, target = np.concatenate(at), np.concatenate(targets)
        corner = np.array([left, top])
        residual, jacobian = object_silhouette.residuals(
            self._lift(pixels + corner, depth[pixels[:, 1], pixels[:, 0]]),
            (target + corner).astype(np.float64),
            self._lens,
            self._camera.colour_from_master,
            pose[:3, 3],
        )
        weight = self._contour_trust * _geman_mcclure(residual, scale_px)
        # Weights go by the whole rim: a rim that fits nearly everywhere must not let the few
        # pixels that do not count as much as a rim that is off all around.
        samples = CONTOUR_SAMPLES / max(len(self._contour), len(rim))
        weight *= samples / (CONTOUR_SIGMA_PX / self._view.geometry.step) ** 2
        return residual, jacobian, weight

    def _lift(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the master frame at reduced colour pixels (N, 2) and depths (N,)."""
        rays = self._lens.rays[pixels[:, 1], pixels[:, 0]].astype(np.float64)
        local = np.column_stack([rays * depth[:, None], depth])
        pose = self._camera.master_from_colour
        return local @ pose[:3, :3].T + pose[:3, 3]

    def _is_background(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Whether rim pixels (N, 2) of the render lie where the sensor sees past the object.

        A rim point that is measured nearer is hidden, one measured at its own depth belongs to
        the object whatever the mask says; without a measurement the mask is believed.
        """
        patch = self._patch
        clear = np.ones(len(pixels), bool)
        lens = self._view.geometry.depth_lens
        if patch is None or lens is None or len(pixels) == 0:
            return clear
        to_depth = self._camera.depth_from_master
        local = self._lift(pixels, depth) @ to_depth[:3, :3].T + to_depth[:3, 3]
        column, row = (np.rint(lens.project(local)).astype(int) - (patch.x0, patch.y0)).T
        inside = (column >= 0) & (row >= 0)
        inside &= (column < patch.depth.shape[1]) & (row < patch.depth.shape[0])
        measured = np.zeros(len(pixels))
        measured[inside] = patch.depth[row[inside], column[inside]]
        clear[(measured > 0) & (measured < local[:, 2] + FREE_SPACE_M)] = False
        return clear

    # --- the outcome ---------------------------------------------------------------------------

    def report(self, pose: np.ndarray, contour_scale_px: float) -> ViewReport:
        """Compare the render at ``pose`` with the view; the scale is at full resolution."""
        image = self._draw_silhouette(pose)
        person = self._view.person.window(image.x0, image.y0, *image.mask.shape)
        overlap = contour = float("nan")
        step = self._view.geometry.step
        if self._candidate is not None:
            overlap = mask_overlap(image, self._mask, person)
            residual, _, _ = self._contour_terms(pose, contour_scale_px / step, True)
            contour = float(np.median(residual)) * step if len(residual) else 0.0
        visible = int((image.mask & ~person).sum())
        depth_residual = agreement = float("nan")
        found = self._match_depth(pose)
        if found is not None:
            mine = (found.trust == 1.0) & (np.abs(found.gap) < 0.1)
            across = found.across
            if mine.sum() >= MIN_PIXELS:
                depth_residual = float(np.median(across[mine]))
            agreement, hidden = depth_agreement(found.gap, across, found.on_person)
            if hidden:
                visible = 0
        number = self._candidate.index if self._candidate is not None else -1
        return ViewReport(
            number, overlap, depth_residual, contour, visible, agreement, self._view.detected
        )


def draw_silhouette(mesh: ObjectMesh, view: View, pose: np.ndarray) -> Rendering:
    """The mesh in the view's reduced colour image, pose (4, 4) master_from_object."""
    geometry = view.geometry
    return render(
        mesh.vertices,
        mesh.faces,
        geometry.lens,
        geometry.camera.colour_from_master @ pose,
        cull_back=mesh.watertight,
    )


def draw_depth(mesh: ObjectMesh, view: View, pose: np.ndarray) -> Rendering:
    """The mesh in the view's reduced depth image, pose (4, 4) master_from_object."""
    geometry = view.geometry
    if geometry.depth_lens is None:
        raise ValueError(f"camera {geometry.camera.name} has no depth")
    return render(
        mesh.vertices,
        mesh.faces,
        geometry.depth_lens,
        geometry.camera.depth_from_master @ pose,
        cull_back=mesh.watertight,
    )


def choose(
    view: View, predicted: Rendering, min_overlap: float, labels: tuple[str, ...]
) -> Candidate | None:
    """The candidate of largest overlap with the visible render; likely labels break ties.

    The paper's render-compare-and-preserve; None where no overlap reaches ``min_overlap``.
    """
    best, best_rank = None, 0.0
    if predicted.mask.sum() < MIN_PIXELS:
        return None
    person = view.person.window(predicted.x0, predicted.y0, *predicted.mask.shape)
    for candidate in view.candidates:
        overlap = mask_overlap(predicted, candidate.mask, person)
        rank = overlap + (LIKELY_LABEL_BONUS if candidate.label in labels else 0.0)
        if overlap >= min_overlap and rank > best_rank:
            best, best_rank = candidate, rank
    return best


def quick_report(
    mesh: ObjectMesh,
    view: View,
    pose: np.ndarray,
    min_overlap: float,
    labels: tuple[str, ...],
) -> ViewReport:
    """As :meth:`ViewFit.report` with two renderings and no correspondences: overlap and depth."""
    image = draw_silhouette(mesh, view, pose)
    person = view.person.window(image.x0, image.y0, *image.mask.shape)
    candidate = choose(view, image, min_overlap, labels)
    overlap = mask_overlap(image, candidate.mask, person) if candidate else float("nan")
    visible = int((image.mask & ~person).sum())
    agreement = float("nan")
    lens = view.geometry.depth_lens
    if view.depth is not None and lens is not None:
        drawn = draw_depth(mesh, view, pose)
        mask = drawn.mask
        measured = view.depth[drawn.window][mask]
        known = measured > 0
        gap = measured[known] - drawn.depth[mask][known]
        rays = lens.rays[drawn.window][mask][known]
        normals = mesh.face_normals[drawn.face[mask][known]] @ (
            pose[:3, :3].T @ view.geometry.camera.depth_from_master[:3, :3].T
        )
        across = np.abs(gap * ((normals[:, :2] * rays).sum(1) + normals[:, 2]))
        agreement, hidden = depth_agreement(gap, across, np.zeros(len(gap), bool))
        if hidden:
            visible = 0
    number = candidate.index if candidate else -1
    nothing = float("nan")
    return ViewReport(number, overlap, nothing, nothing, visible, agreement, view.detected)


def depth_agreement(
    gap: np.ndarray, across: np.ndarray, on_person: np.ndarray
) -> tuple[float, bool]:
    """How well measured depth fits where nothing is in front, and whether something hides it all.

    ``gap`` (N,) measured minus rendered depth, ``across`` (N,) the same across the surface, both
    metres; pixels on a person (N,) and those measured nearer do not count. NaN for too few.
    """
    free = ~on_person & (gap > -FREE_SPACE_M)
    if free.sum() >= MIN_PIXELS:
        scale = AGREEMENT_SCALE_M**2
        return float((scale / (scale + across[free] ** 2)).mean()), False
    return float("nan"), len(gap) > MIN_PIXELS


def mask_overlap(image: Rendering, mask: ReducedMask, person: np.ndarray) -> float:
    """IoU of a mask and the part of a render that no person (h, w) hides."""
    if not mask.area:
        return 0.0
    here = mask.window(image.x0, image.y0, *image.mask.shape)
    visible = image.mask & ~(person & ~here)
    common = int((visible & here).sum())
    return common / max(1, int(visible.sum()) + mask.area - common)


def _geman_mcclure(residual: np.ndarray, scale: float) -> np.ndarray:
    """Weights (N,) of iterated least squares for rho^2 r^2 / (r^2 + rho^2)."""
    return (scale**2 / (scale**2 + residual**2)) ** 2


def _nothing() -> Terms:
    return np.zeros(0), np.zeros((0, 6)), np.zeros(0)


def _pixels_per_metre(rendering: Rendering, focal: float) -> float:
    depth = rendering.depth[rendering.mask]
    return focal / float(np.median(depth)) if len(depth) else 0.0
