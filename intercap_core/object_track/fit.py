"""Gauss-Newton fit of the object's pose to one frame set: E_O of equation 1, summed over views.

Correspondences are refreshed by rendering between steps: depth pixels against the plane of the
triangle that they hit, mask contours against the render's rim. Weights are Geman-McClure with a
scale that shrinks from the size of the expected error to that of the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from intercap_core.geometry.camera.transforms import apply_step, step_between
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import Renderer, default_renderer
from intercap_core.geometry.rigid.shots import Rendering, Surface
from intercap_core.object_track.constants import (
    CONTOUR_SCALES_PX,
    DEPTH_SCALES_M,
    FIT_CONVERGED_M,
    FIT_CONVERGED_RAD,
    FIT_DAMPING,
    FIT_MAX_STEP_M,
    FIT_MAX_STEP_RAD,
    FIT_ROUNDS,
    PRIOR_SIGMA_M,
    PRIOR_SIGMA_RAD,
    REDRAWN_M,
    REDRAWN_RAD,
    REPORT_CONTOUR_SCALE,
    SCALE_SHRINKAGE,
    SUPPORTING_AGREEMENT,
    SUPPORTING_PX,
    UNMOVED_M,
    UNMOVED_RAD,
)
from intercap_core.object_track.view import View
from intercap_core.object_track.view_fit import NormalEquations, ViewFit, shots_of
from intercap_core.object_track.view_report import ViewReport, quick_report


@dataclass(frozen=True)
class MotionPrior:
    """Prior on the pose around the prediction: keeps unobserved motions (a bottle's spin) at rest.

    Beyond the paper.
    """

    pose: np.ndarray  # (4, 4) master_from_object
    sigma_m: float = PRIOR_SIGMA_M
    sigma_rad: float = PRIOR_SIGMA_RAD


@dataclass(frozen=True)
class Fit:
    """A pose (4, 4) master_from_object, its covariance (6, 6), how each view agrees, and the
    ``twist`` (6,) in a second by which each saw it (:func:`fit_pose`)."""

    pose: np.ndarray
    covariance: np.ndarray
    views: tuple[ViewReport, ...]
    twist: np.ndarray = field(default_factory=lambda: np.zeros(6))

    @property
    def log_ratio(self) -> float:
        """Log-likelihood ratio of all views, nats: see :mod:`.likelihood`."""
        return float(sum(view.log_ratio for view in self.views))

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
            or (view.visible_px >= SUPPORTING_PX and view.depth_agreement > SUPPORTING_AGREEMENT)
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
    rounds: tuple[int, ...] = FIT_ROUNDS,
    start_scale: float = 1.0,
    twist: np.ndarray | None = None,
    renderer: Renderer | None = None,
) -> Fit:
    """Fit the pose (4, 4) to all views, starting from ``pose``.

    Before each of the ``rounds`` (Gauss-Newton steps at most), every view keeps the candidate that
    overlaps the render most, if by ``min_overlap``. ``background_term`` (beyond the paper) also
    penalises render over known background. ``start_scale`` shrinks the first robust scale where the
    start is known better than from a search. The pivot of the rotation is the mesh's origin.
    ``twist`` (6,) is the object's turn and shift in a second (rad, m), by which each view sees it
    when it exposes; None = at rest. To first order in what it moves meanwhile, a step of the pose
    is the same step of what every view sees. ``renderer`` draws; None = the CPU.
    """
    renderer = renderer or default_renderer()
    depth_scale, contour_scale = DEPTH_SCALES_M[0], CONTOUR_SCALES_PX[0]
    depth_scale = max(depth_scale * start_scale, DEPTH_SCALES_M[1])
    contour_scale = max(contour_scale * start_scale, CONTOUR_SCALES_PX[1])
    drawn_pose = pose  # what the fits look at
    fits = view_fits(renderer, mesh, views, drawn_pose, min_overlap, labels, twist)
    information = np.eye(6)
    done = False
    for number, steps in enumerate(rounds):
        if number == 0:
            renderer.pool.map(ViewFit.choose, fits)
        elif not any(renderer.pool.map(ViewFit.choose_again, fits)) and done:
            break
        done = False
        last = np.zeros(6)
        for _ in range(steps):
            information, step = _step(
                renderer, fits, prior, drawn_pose, depth_scale, contour_scale, background_term
            )
            pose = apply_step(drawn_pose, step)
            settled = depth_scale <= DEPTH_SCALES_M[1] and contour_scale <= CONTOUR_SCALES_PX[1]
            depth_scale = max(depth_scale * SCALE_SHRINKAGE, DEPTH_SCALES_M[1])
            contour_scale = max(contour_scale * SCALE_SHRINKAGE, CONTOUR_SCALES_PX[1])
            done = settled and _below(step - last, FIT_CONVERGED_M, FIT_CONVERGED_RAD)
            if done:
                break
            if _below(step, REDRAWN_M, REDRAWN_RAD):
                last = step
            else:
                last, drawn_pose = np.zeros(6), pose
                _look(renderer, mesh, views, fits, seen_by(drawn_pose, views, twist))
    report_scale = REPORT_CONTOUR_SCALE * CONTOUR_SCALES_PX[1]
    reports = renderer.pool.map(lambda fit: fit.report(report_scale), fits)
    covariance = np.linalg.inv(information + 1e-9 * np.eye(6))
    return Fit(pose, covariance, tuple(reports), np.zeros(6) if twist is None else twist)


def _step(
    renderer: Renderer,
    fits: list[ViewFit],
    prior: MotionPrior | None,
    pose: np.ndarray,
    depth_scale: float,
    contour_scale: float,
    background: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix (6, 6) over all views at the pose they look at, and the step (6,) from it."""

    def terms(fit: ViewFit) -> NormalEquations:
        return fit.normal_equations(depth_scale, contour_scale, background)

    hessian, gradient = _prior_terms(prior, pose)
    for h, g in renderer.pool.map(terms, fits):
        hessian += h
        gradient += g
    damped = hessian + np.diag(FIT_DAMPING * np.diag(hessian) + 1e-9)
    return hessian, _limited(-np.linalg.solve(damped, gradient))


def _below(step: np.ndarray, metres: float, radians: float) -> bool:
    return bool(np.abs(step[3:]).max() < metres and np.abs(step[:3]).max() < radians)


def view_fits(
    renderer: Renderer,
    mesh: ObjectMesh,
    views: list[View],
    pose: np.ndarray,
    min_overlap: float,
    labels: tuple[str, ...],
    twist: np.ndarray | None,
) -> list[ViewFit]:
    """Every view's fit, looking at ``pose`` (4, 4) as its camera sees it; see :func:`fit_pose`."""
    seen = seen_by(pose, views, twist)
    return [
        ViewFit(mesh, view, min_overlap, labels, own, drawn)
        for view, own, drawn in zip(views, seen, _draw(renderer, mesh, views, seen), strict=True)
    ]


def _look(
    renderer: Renderer,
    mesh: ObjectMesh,
    views: list[View],
    fits: list[ViewFit],
    seen: list[np.ndarray],
) -> None:
    """Draw what each view sees, all at once, and show it to the views' fits."""
    for fit, pose, drawn in zip(fits, seen, _draw(renderer, mesh, views, seen), strict=True):
        fit.see(pose, drawn)


def _draw(
    renderer: Renderer, mesh: ObjectMesh, views: list[View], seen: list[np.ndarray]
) -> list[list[Rendering]]:
    """The renderings of each view's pose, in the order of :func:`.view_fit.shots_of`."""
    shots = [shots_of(view, pose) for view, pose in zip(views, seen, strict=True)]
    drawn = iter(renderer.draw(Surface.of(mesh), [shot for group in shots for shot in group]))
    return [[next(drawn) for _ in group] for group in shots]


def assess_all(
    mesh: ObjectMesh,
    views: list[View],
    poses: np.ndarray,
    *,
    min_overlap: float,
    labels: tuple[str, ...] = (),
    twists: np.ndarray | None = None,
    renderer: Renderer | None = None,
) -> list[Fit]:
    """How well poses (N, 4, 4) agree with all views, without changing them; ``twists`` (N, 6) as of
    :func:`fit_pose`."""
    renderer = renderer or default_renderer()
    motions = np.zeros((len(poses), 6)) if twists is None else twists
    seen = [own for pose, twist in zip(poses, motions, strict=True)
            for own in seen_by(pose, views, twist)]  # fmt: skip
    each = list(views) * len(poses)
    drawn = _draw(renderer, mesh, each, seen)

    def compare(number: int) -> ViewReport:
        silhouette, *depth = drawn[number]
        return quick_report(
            mesh,
            each[number],
            seen[number],
            silhouette,
            depth[0] if depth else None,
            min_overlap,
            labels,
        )

    reports = renderer.pool.map(compare, range(len(each)))
    unknown = np.full((6, 6), np.nan)
    count = len(views)
    return [
        Fit(pose, unknown, tuple(reports[i * count : (i + 1) * count]), twist)
        for i, (pose, twist) in enumerate(zip(poses, motions, strict=True))
    ]


def _prior_terms(prior: MotionPrior | None, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if prior is None:
        return np.eye(6), np.zeros(6)
    away = step_between(prior.pose, pose)
    weight = np.repeat([prior.sigma_rad**-2, prior.sigma_m**-2], 3)
    return np.diag(weight), weight * away


def _limited(step: np.ndarray) -> np.ndarray:
    turn, shift = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
    return step / max(1.0, turn / FIT_MAX_STEP_RAD, shift / FIT_MAX_STEP_M)


def seen_by(pose: np.ndarray, views: list[View], twist: np.ndarray | None) -> list[np.ndarray]:
    """The pose (4, 4) at each view's exposure, of what moves by ``twist`` (6,): the same array
    where it hardly moves until then."""
    if twist is None:
        return [pose] * len(views)
    steps = np.array([view.geometry.time_offset_s for view in views])[:, None] * twist
    moves = (np.abs(steps[:, :3]).max(1) > UNMOVED_RAD) | (np.abs(steps[:, 3:]).max(1) > UNMOVED_M)
    if not moves.any():
        return [pose] * len(views)
    later = apply_step(np.broadcast_to(pose, (len(views), 4, 4)), steps)
    return [own if moves[i] else pose for i, own in enumerate(later)]
