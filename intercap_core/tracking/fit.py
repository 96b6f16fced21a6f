"""Gauss-Newton fit of the object's pose to one frame set (equation 1 over all views).

Correspondences are refreshed by rendering between steps: depth pixels against the plane of the
triangle that they hit, mask contours against the render's rim. Weights are Geman-McClure with a
scale that shrinks from the size of the expected error to that of the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

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
DEPTH_SCALES_M = (0.050, 0.012)  # Geman-McClure scale: first, last
CONTOUR_SCALES_PX = (30.0, 6.0)  # at full resolution
SHRINK = 0.5  # of the scales from step to step
MAX_STEP_M, MAX_STEP_RAD = 0.06, np.radians(20)
CONVERGED_M, CONVERGED_RAD = 3e-4, np.radians(0.05)
DAMPING = 1e-3  # of the diagonal
FREE_SPACE_M = 0.03  # measured this much behind the render: known background
PATCH_MARGIN_M = 0.15  # the pose may move this far before measured points leave the patch
AGREEMENT_SCALE_M = 0.010  # a depth pixel off by this counts half
MIN_PIXELS = 12  # fewer rendered pixels say nothing


@dataclass(frozen=True)
class MotionPrior:
    """Where the object is expected: keeps motions that nothing shows (a bottle's spin) at rest."""

    pose: np.ndarray  # (4, 4) master_from_object
    sigma_m: float = 0.06
    sigma_rad: float = float(np.radians(15))


@dataclass(frozen=True)
class ViewReport:
    """How one view agrees with the final pose.

    ``overlap`` IoU of candidate and visible render (NaN: no candidate); ``depth_residual_m`` and
    ``contour_residual_px`` medians (NaN: none); ``visible_px`` rendered pixels that nothing
    hides; ``depth_agreement`` how close to the render they are measured, 0 to 1 (NaN: no depth).
    """

    candidate: int
    overlap: float
    depth_residual_m: float
    contour_residual_px: float
    visible_px: int
    depth_agreement: float


@dataclass(frozen=True)
class Fit:
    """A pose (4, 4) master_from_object, its covariance (6, 6) and how each view agrees."""

    pose: np.ndarray
    covariance: np.ndarray
    views: tuple[ViewReport, ...]

    @property
    def score(self) -> float:
        """Agreement over all views, 0 to 1, each view by the pixels it could show.

        A view without a candidate counts with overlap 0: a pose that no detector supports is not
        as good as one that six do.
        """
        total, weight = 0.0, 0.0
        for view in self.views:
            if view.visible_px < MIN_PIXELS:
                continue
            overlap = 0.0 if np.isnan(view.overlap) else view.overlap
            agreement = overlap if np.isnan(view.depth_agreement) else view.depth_agreement
            total += view.visible_px * 0.5 * (overlap + agreement)
            weight += view.visible_px
        return total / weight if weight else 0.0

    @property
    def confidence(self) -> float:
        """:attr:`score`, less where few views support it: one view can agree by chance."""
        return self.score * (1 - 0.5**self.support)

    @property
    def mean_overlap(self) -> float:
        """Mean IoU over the views with a candidate; 0 where there is none."""
        overlaps = [view.overlap for view in self.views if not np.isnan(view.overlap)]
        return float(np.mean(overlaps)) if overlaps else 0.0

    @property
    def support(self) -> int:
        """Number of views with a candidate, or whose depth agrees with what is visible."""
        return sum(
            not np.isnan(view.overlap)
            or (view.visible_px >= 3 * MIN_PIXELS and view.depth_agreement > 0.5)
            for view in self.views
        )


def fit_pose(
    mesh: ObjectMesh,
    views: list[View],
    pose: np.ndarray,
    *,
    prior: MotionPrior | None,
    min_overlap: float,
    background_term: bool,
    labels: tuple[str, ...] = (),
    rounds: tuple[int, ...] = (4, 5),
    start_scale: float = 1.0,
) -> Fit:
    """Fit the pose (4, 4) to all views, starting from ``pose``.

    Before each of the ``rounds`` (Gauss-Newton steps at most), every view keeps the candidate
    that overlaps the render most, if by ``min_overlap``. ``background_term`` also penalises
    render over known background. ``start_scale`` shrinks the first robust scale where the start is
    known better than from a search. The pivot of the rotation is the mesh's origin.
    """
    depth_scale, contour_scale = DEPTH_SCALES_M[0], CONTOUR_SCALES_PX[0]
    depth_scale = max(depth_scale * start_scale, DEPTH_SCALES_M[1])
    contour_scale = max(contour_scale * start_scale, CONTOUR_SCALES_PX[1])
    information = np.eye(6)
    prepared: list[_ViewFit] = []
    for steps in rounds:
        prepared = [_ViewFit(mesh, view, pose, min_overlap, labels) for view in views]
        for _ in range(steps):
            hessian, gradient = _prior_terms(prior, pose)
            for view_fit in prepared:
                h, g = view_fit.normal_equations(pose, depth_scale, contour_scale, background_term)
                hessian += h
                gradient += g
            information = hessian
            damped = hessian + np.diag(DAMPING * np.diag(hessian) + 1e-9)
            step = _limited(-np.linalg.solve(damped, gradient))
            pose = _moved(pose, step)
            settled = depth_scale <= DEPTH_SCALES_M[1] and contour_scale <= CONTOUR_SCALES_PX[1]
            depth_scale = max(depth_scale * SHRINK, DEPTH_SCALES_M[1])
            contour_scale = max(contour_scale * SHRINK, CONTOUR_SCALES_PX[1])
            small = np.abs(step[3:]).max() < CONVERGED_M and np.abs(step[:3]).max() < CONVERGED_RAD
            if settled and small:
                break
    reports = tuple(view_fit.report(pose) for view_fit in prepared)
    return Fit(pose, np.linalg.inv(information + 1e-9 * np.eye(6)), reports)


def assess(
    mesh: ObjectMesh,
    views: list[View],
    pose: np.ndarray,
    *,
    min_overlap: float,
    labels: tuple[str, ...] = (),
) -> Fit:
    """How well a pose (4, 4) agrees with all views, without changing it."""
    reports = tuple(_ViewFit(mesh, view, pose, min_overlap, labels).report(pose) for view in views)
    return Fit(pose, np.full((6, 6), np.nan), reports)


def _prior_terms(prior: MotionPrior | None, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if prior is None:
        weight = np.concatenate([np.full(3, 1.0), np.full(3, 1.0)])
        return np.diag(weight), np.zeros(6)
    turn = Rotation.from_matrix(pose[:3, :3] @ prior.pose[:3, :3].T).as_rotvec()
    away = np.concatenate([turn, pose[:3, 3] - prior.pose[:3, 3]])
    weight = np.repeat([prior.sigma_rad**-2, prior.sigma_m**-2], 3)
    return np.diag(weight), weight * away


def _limited(step: np.ndarray) -> np.ndarray:
    turn, shift = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
    return step / max(1.0, turn / MAX_STEP_RAD, shift / MAX_STEP_M)


def _moved(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ pose[:3, :3]
    moved[:3, 3] += step[3:]
    return moved


def _geman_mcclure(residual: np.ndarray, scale: float) -> np.ndarray:
    """Weights (N,) of iterated least squares for rho^2 r^2 / (r^2 + rho^2)."""
    return (scale**2 / (scale**2 + residual**2)) ** 2


class _ViewFit:
    """One view, its chosen candidate and the measured points around the expected pose."""

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
        geometry = view.geometry
        self._camera = geometry.camera
        self._lens = geometry.lens
        predicted = self._draw_silhouette(pose)
        self._candidate, self._overlap = self._choose(predicted, min_overlap, labels)
        self._mask = self._candidate.mask if self._candidate else EMPTY
        self._cut_silhouette(predicted)
        self._cut_depth(pose)

    # --- evidence, once -----------------------------------------------------------------------

    def _choose(
        self, predicted: Rendering, min_overlap: float, labels: tuple[str, ...]
    ) -> tuple[Candidate | None, float]:
        """The candidate of largest overlap with the visible render; likely labels break ties."""
        best: Candidate | None = None
        best_rank, best_overlap = 0.0, float("nan")
        if predicted.mask.sum() < MIN_PIXELS:
            return best, best_overlap
        person = self._view.person.window(predicted.x0, predicted.y0, *predicted.mask.shape)
        for candidate in self._view.candidates:
            overlap = _overlap(predicted, candidate.mask, person)
            rank = overlap + (0.05 if candidate.label in labels else 0.0)
            if overlap >= min_overlap and rank > best_rank:
                best, best_rank, best_overlap = candidate, rank, overlap
        return best, best_overlap

    def _cut_silhouette(self, predicted: Rendering) -> None:
        """Window over render and mask, the mask's contour there, and who else is in it."""
        if self._candidate is None:
            return
        margin = int(self._pixels_per_metre(predicted) * PATCH_MARGIN_M) + 4
        height, width = predicted.mask.shape
        left = max(predicted.x0 - margin, 0)
        top = max(predicted.y0 - margin, 0)
        right = min(predicted.x0 + width + margin, self._lens.width)
        bottom = min(predicted.y0 + height + margin, self._lens.height)
        self._window = (left, top, right - left, bottom - top)
        shape = (bottom - top, right - left)
        self._inside = self._mask.window(left, top, *shape)
        self._person = self._view.person.window(left, top, *shape) & ~self._inside
        contour = object_silhouette.rim(self._inside)
        self._contour_rim = object_silhouette.NearestRim(contour) if contour.any() else None
        # where the mask ends because a person is in front there is no contour of the object
        near_person = _grown(self._person)
        self._contour = np.argwhere(contour & ~near_person)[:, ::-1]

    def _cut_depth(self, pose: np.ndarray) -> None:
        """Measured points around the predicted render, and how far each may be trusted."""
        self._patch = None
        lens = self._view.geometry.depth_lens
        if lens is None or self._view.depth is None:
            return
        predicted = render(
            self._mesh.vertices,
            self._mesh.faces,
            lens,
            self._camera.depth_from_master @ pose,
            cull_back=self._mesh.watertight,
        )
        if not predicted.mask.any():
            return
        margin = int(self._pixels_per_metre(predicted, lens.fx) * PATCH_MARGIN_M) + 2
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
            person = self._patch.sample(self._view.person) & ~inside
            self._trust = np.where(inside, 1.0, np.where(person, 0.0, OUTSIDE_MASK_WEIGHT))
            self._on_person = person

    def _pixels_per_metre(self, rendering: Rendering, focal: float | None = None) -> float:
        depth = rendering.depth[rendering.mask]
        return (focal or self._lens.fx) / float(np.median(depth)) if len(depth) else 0.0

    # --- the energy at one pose ---------------------------------------------------------------

    def normal_equations(
        self, pose: np.ndarray, depth_scale_m: float, contour_scale_px: float, background: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Weighted J'J (6, 6) and J'r (6,) of both terms, in units of one standard deviation."""
        hessian, gradient = np.zeros((6, 6)), np.zeros(6)
        for residual, jacobian, weight in (
            self._depth_terms(pose, depth_scale_m),
            self._contour_terms(pose, contour_scale_px / self._view.geometry.step, background),
        ):
            weighted = jacobian * weight[:, None]
            hessian += weighted.T @ jacobian
            gradient += weighted.T @ residual
        return hessian, gradient

    def _depth_terms(
        self, pose: np.ndarray, scale_m: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found = self._depth_matches(pose)
        if found is None:
            return _nothing()
        observed, hit, normals, trust, gap, _ = found
        near = (np.abs(gap) < 2.5 * scale_m) & (trust > 0)
        if near.sum() < MIN_PIXELS:
            return _nothing()
        residual, jacobian = object_depth.residuals(
            observed[near], hit[near], normals[near], pose[:3, 3]
        )
        weight = trust[near] * _geman_mcclure(residual, scale_m)
        samples = DEPTH_SAMPLES * len(residual) / (len(residual) + 10 * MIN_PIXELS)
        weight *= samples / len(residual) / DEPTH_SIGMA_M**2
        return residual, jacobian, weight

    def _depth_matches(self, pose: np.ndarray) -> tuple[np.ndarray, ...] | None:
        """Measured and rendered points under the same pixels, or None.

        Returns observed (N, 3), hit (N, 3), normals (N, 3) in the master frame, trust (N,), the
        depth gap (N,) measured minus rendered, and whether a person covers the pixel (N,).
        """
        patch = self._patch
        lens = self._view.geometry.depth_lens
        if patch is None or lens is None:
            return None
        depth_from_object = self._camera.depth_from_master @ pose
        image = render(
            self._mesh.vertices,
            self._mesh.faces,
            lens,
            depth_from_object,
            cull_back=self._mesh.watertight,
        )
        y, x = np.nonzero(image.mask)
        y, x = y + (image.y0 - patch.y0), x + (image.x0 - patch.x0)
        inside = (x >= 0) & (y >= 0) & (x < patch.depth.shape[1]) & (y < patch.depth.shape[0])
        inside[inside] &= patch.depth[y[inside], x[inside]] > 0
        x, y = x[inside], y[inside]
        rendered = image.depth[image.mask][inside].astype(np.float64)
        face = image.face[image.mask][inside]
        measured = patch.depth[y, x]
        observed = patch.points[y, x].astype(np.float64)
        # the rendered point lies on the same ray as the measured one
        to_master = self._camera.master_from_depth
        eye = to_master[:3, 3]
        hit = eye + (observed - eye) * (rendered / measured)[:, None]
        normals = self._mesh.face_normals[face] @ pose[:3, :3].T
        return (
            observed,
            hit,
            normals,
            self._trust[y, x],
            measured - rendered,
            self._on_person[y, x],
        )

    def _contour_terms(
        self, pose: np.ndarray, scale_px: float, background: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if self._candidate is None or self._contour_rim is None:
            return _nothing()
        image = self._draw_silhouette(pose)
        left, top, width, height = self._window
        drawn = np.zeros((height, width), bool)
        depth = np.zeros((height, width), np.float32)
        rows, columns, own_rows, own_columns = _common(image, left, top, height, width)
        drawn[rows, columns] = image.mask[own_rows, own_columns]
        depth[rows, columns] = image.depth[own_rows, own_columns]
        rim = object_silhouette.rim(drawn)
        if rim.sum() < MIN_PIXELS:
            return _nothing()
        at, targets = [], []
        nearest_rim = object_silhouette.NearestRim(rim)
        x, y = self._contour.T
        missed = ~drawn[y, x] & (nearest_rim.distance[y, x] < 2.5 * scale_px)
        if missed.any():
            at.append(nearest_rim.pixels[nearest_rim.index(x[missed], y[missed])])
            targets.append(self._contour[missed])
        if background:
            x, y = nearest_rim.pixels.T
            extra = ~self._inside[y, x] & ~self._person[y, x]
            extra &= self._contour_rim.distance[y, x] < 2.5 * scale_px
            x, y = x[extra], y[extra]
            clear = self._is_background(x + left, y + top, depth[y, x], pose)
            x, y = x[clear], y[clear]
            at.append(np.stack([x, y], 1))
            targets.append(self._contour_rim.pixels[self._contour_rim.index(x, y)])
        if not at or sum(map(len, at)) < 3:
            return _nothing()
        rim_pixels, target = np.concatenate(at), np.concatenate(targets)
        points = self._lift(
            rim_pixels + np.array([left, top]), depth[rim_pixels[:, 1], rim_pixels[:, 0]]
        )
        residual, jacobian = object_silhouette.residuals(
            points,
            target + np.array([left, top], float),
            self._lens,
            self._camera.colour_from_master,
            pose[:3, 3],
        )
        weight = _geman_mcclure(residual, scale_px)
        # Weights go by the whole rim: a rim that fits nearly everywhere must not let the few
        # pixels that do not count as much as a rim that is off all around.
        samples = CONTOUR_SAMPLES / max(len(self._contour), len(nearest_rim.pixels))
        weight *= samples / (CONTOUR_SIGMA_PX / self._view.geometry.step) ** 2
        return residual, jacobian, weight

    def _draw_silhouette(self, pose: np.ndarray) -> Rendering:
        return render(
            self._mesh.vertices,
            self._mesh.faces,
            self._lens,
            self._camera.colour_from_master @ pose,
            cull_back=self._mesh.watertight,
        )

    def _lift(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the master frame at reduced colour pixels (N, 2) and depths (N,)."""
        rays = self._lens.rays[pixels[:, 1], pixels[:, 0]].astype(np.float64)
        local = np.column_stack([rays * depth[:, None], depth])
        pose = self._camera.master_from_colour
        return local @ pose[:3, :3].T + pose[:3, 3]

    def _is_background(
        self, x: np.ndarray, y: np.ndarray, depth: np.ndarray, pose: np.ndarray
    ) -> np.ndarray:
        """Whether rim pixels of the render (N,) lie where the sensor sees past the object.

        A rim point that is measured nearer is hidden, one measured at its own depth belongs to
        the object whatever the mask says; without a measurement the mask is believed.
        """
        patch = self._patch
        clear = np.ones(len(x), bool)
        lens = self._view.geometry.depth_lens
        if patch is None or lens is None or len(x) == 0:
            return clear
        points = self._lift(np.stack([x, y], 1), depth)
        to_depth = self._camera.depth_from_master
        local = points @ to_depth[:3, :3].T + to_depth[:3, 3]
        column, row = (np.rint(lens.project(local)).astype(int) - (patch.x0, patch.y0)).T
        inside = (column >= 0) & (row >= 0)
        inside &= (column < patch.depth.shape[1]) & (row < patch.depth.shape[0])
        measured = np.zeros(len(x))
        measured[inside] = patch.depth[row[inside], column[inside]]
        clear[(measured > 0) & (measured < local[:, 2] + FREE_SPACE_M)] = False
        return clear

    # --- the outcome --------------------------------------------------------------------------

    def report(self, pose: np.ndarray) -> ViewReport:
        """Compare the render at ``pose`` with the view."""
        image = self._draw_silhouette(pose)
        person = self._view.person.window(image.x0, image.y0, *image.mask.shape)
        overlap = contour = float("nan")
        if self._candidate is not None:
            overlap = _overlap(image, self._mask, person)
            residual, _, weight = self._contour_terms(
                pose, CONTOUR_SCALES_PX[1] * 4 / self._view.geometry.step, True
            )
            if len(weight):
                contour = float(np.median(residual)) * self._view.geometry.step
            else:
                contour = 0.0
        visible = int((image.mask & ~person).sum())
        depth_residual = agreement = float("nan")
        found = self._depth_matches(pose)
        if found is not None:
            observed, hit, normals, trust, gap, on_person = found
            across = np.abs(np.einsum("ij,ij->i", normals, observed - hit))
            mine = (trust == 1.0) & (np.abs(gap) < 0.1)
            if mine.sum() >= MIN_PIXELS:
                depth_residual = float(np.median(across[mine]))
            free = ~on_person & (gap > -FREE_SPACE_M)  # neither person nor anything in front
            hidden = len(gap) - int(free.sum())
            if free.sum() >= MIN_PIXELS:
                near = AGREEMENT_SCALE_M**2 / (AGREEMENT_SCALE_M**2 + across[free] ** 2)
                agreement = float(near.mean())
            elif hidden:
                visible = 0
        number = self._candidate.index if self._candidate is not None else -1
        return ViewReport(number, overlap, depth_residual, contour, visible, agreement)


def _nothing() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros(0), np.zeros((0, 6)), np.zeros(0)


def _overlap(image: Rendering, mask: ReducedMask, person: np.ndarray) -> float:
    """IoU of a mask and the part of a render that no person (h, w) hides."""
    if not mask.area:
        return 0.0
    here = mask.window(image.x0, image.y0, *image.mask.shape)
    visible = image.mask & ~(person & ~here)
    common = int((visible & here).sum())
    return common / max(1, int(visible.sum()) + mask.area - common)


def _common(
    image: Rendering, left: int, top: int, height: int, width: int
) -> tuple[slice, slice, slice, slice]:
    """Rows and columns shared by a window and a rendering: in the window, in the rendering."""
    own_height, own_width = image.mask.shape
    x0, x1 = max(image.x0, left), min(image.x0 + own_width, left + width)
    y0, y1 = max(image.y0, top), min(image.y0 + own_height, top + height)
    x1, y1 = max(x0, x1), max(y0, y1)
    return (
        slice(y0 - top, y1 - top),
        slice(x0 - left, x1 - left),
        slice(y0 - image.y0, y1 - image.y0),
        slice(x0 - image.x0, x1 - image.x0),
    )


def _grown(mask: np.ndarray) -> np.ndarray:
    return cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
