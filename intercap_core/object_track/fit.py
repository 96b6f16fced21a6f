"""Gauss-Newton fit of the object's pose to one frame set: E_O of equation 1, summed over views.

Correspondences are refreshed by rendering between steps: depth pixels with the plane of the
triangle that they hit, mask contours with the render's rim. Weights are Geman-McClure with a scale
that shrinks from the expected error to the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from intercap_core.geometry.camera.transforms import apply_step, step_between
from intercap_core.geometry.rigid.shots import Rendering, Surface
from intercap_core.object_track.view import FitContext, View
from intercap_core.object_track.view_fit import (
    CONTOUR_SCALES_PX,
    NormalEquations,
    ViewFit,
    shots_of,
)
from intercap_core.object_track.view_report import ViewReport, choose_candidate, report_view

# Geman-McClure scales, first and last, like those of contours: from the error of a start to a few
# standard deviations of the noise.
DEPTH_SCALES_M = (0.050, 0.012)  # metres; tuned
AT_REST = np.zeros(6)  # motion of the object: turn and shift per second, rad and metres
AT_REST.setflags(write=False)
FIT_ROUNDS = (4, 5)  # at most this many Gauss-Newton steps after each choice of candidates; tuned


@dataclass(frozen=True)
class MotionPrior:
    """Prior of the pose around a prediction (beyond the paper).

    It keeps motions that no image shows, such as the spin of a bottle, at rest.
    """

    pose: np.ndarray
    """(4, 4) master_from_object."""
    sigma_m: float = 0.06  # tuned on the studio
    """Standard deviation of the translation along each axis, metres."""
    sigma_rad: float = float(np.radians(15))  # tuned on the studio
    """Standard deviation of the turn about each axis, radians."""


@dataclass(frozen=True)
class FittedPose:
    """A fitted or assessed pose."""

    pose: np.ndarray
    """(4, 4) master_from_object."""
    covariance: np.ndarray
    """(6, 6) of (turn on the left, shift)."""
    views: tuple[ViewReport, ...]
    """Agreement of each view."""
    twist: np.ndarray = field(default_factory=lambda: np.zeros(6))
    """(6,) motion of the object per second that was assumed (:func:`fit_pose`)."""

    @property
    def log_ratio(self) -> float:
        """Log-likelihood ratio of all views, nats (:mod:`.likelihood`)."""
        return float(sum(view.log_ratio for view in self.views))

    @property
    def mean_overlap(self) -> float:
        """Mean IoU of the views with a candidate; 0 if there is none."""
        overlaps = [view.overlap for view in self.views if not np.isnan(view.overlap)]
        return float(np.mean(overlaps)) if overlaps else 0.0

    @property
    def support(self) -> int:
        """Number of views whose images are evidence for the pose."""
        return sum(view.log_ratio > 0 for view in self.views)


def fit_pose(
    context: FitContext,
    views: list[View],
    pose: np.ndarray,
    *,
    prior: MotionPrior | None = None,
    rounds: tuple[int, ...] = FIT_ROUNDS,
    start_scale: float = 1.0,
    twist: np.ndarray = AT_REST,
) -> FittedPose:
    """Fit the pose (4, 4) to all views, starting from ``pose``.

    In each round every view chooses its candidate, then Gauss-Newton steps follow until they are
    small or the round's limit is reached. Robust scales halve with each step. The views are
    rendered again only if a step is larger than a quarter of a pixel. The rotation's pivot is the
    origin of the mesh.

    A view that exposes later sees a moved object. To first order in that motion, a step of the pose
    moves the seen object by the same step.

    Args:
        context: object and settings.
        views: views of the frame set.
        pose: (4, 4) start, master_from_object.
        prior: prior of the pose, if any.
        rounds: Gauss-Newton steps at most. Before each round, every view chooses its candidate.
        start_scale: factor of the first robust scales; below 1 if the start is better than from a
            search.
        twist: (6,) turn and shift of the object per second (rad, m). Each view sees the object
            moved by the twist times its time offset.
    """
    pool = context.renderer.pool
    scales, last_scales = np.array([DEPTH_SCALES_M, CONTOUR_SCALES_PX]).T
    scales = np.maximum(scales * start_scale, last_scales)
    drawn_pose = pose
    fits = view_fits(context, views, drawn_pose, twist)
    information = np.eye(6)
    done = False
    for number, steps in enumerate(rounds):
        if number == 0:
            pool.map(ViewFit.choose, fits)
        elif not any(pool.map(ViewFit.choose_again, fits)) and done:
            break
        done = False
        last = np.zeros(6)
        for _ in range(steps):
            information, step = _step(context, fits, prior, drawn_pose, scales)
            pose = apply_step(drawn_pose, step)
            settled = bool((scales <= last_scales).all())
            scales = np.maximum(scales * 0.5, last_scales)
            # 0.5 mm: 0.2 px of 1080p at 2.5 m
            done = settled and _is_below(step - last, 5e-4, np.radians(0.1))
            if done:
                break
            # below a quarter of a pixel residuals are linear in the step: no new renderings
            if _is_below(step, 1.5e-3, np.radians(0.3)):
                last = step
            else:
                last, drawn_pose = np.zeros(6), pose
                seen = seen_by(drawn_pose, views, twist)
                for fit, own, drawn in zip(fits, seen, _draw(context, views, seen), strict=True):
                    fit.see(own, drawn)
    reports = pool.map(lambda fit: fit.report(), fits)
    covariance = np.linalg.inv(information + 1e-9 * np.eye(6))
    return FittedPose(pose, covariance, tuple(reports), twist)


def _step(
    context: FitContext,
    fits: list[ViewFit],
    prior: MotionPrior | None,
    pose: np.ndarray,
    scales: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal matrix (6, 6) of all views at their current pose, and the step (6,)."""
    depth_m, contour_px = scales.tolist()

    def terms(fit: ViewFit) -> NormalEquations:
        return fit.normal_equations(depth_m, contour_px, context.background_term)

    hessian, gradient = _prior_terms(prior, pose)
    for h, g in context.renderer.pool.map(terms, fits):
        hessian += h
        gradient += g
    damped = hessian + np.diag(1e-3 * np.diag(hessian) + 1e-9)
    step = -np.linalg.solve(damped, gradient)
    turn, shift = np.linalg.norm(step[:3]), np.linalg.norm(step[3:])
    return hessian, step / max(1.0, turn / np.radians(20), shift / 0.06)  # limited, rad and metres


def _is_below(step: np.ndarray, metres: float, radians: float) -> bool:
    return bool(np.abs(step[3:]).max() < metres and np.abs(step[:3]).max() < radians)


def view_fits(
    context: FitContext, views: list[View], pose: np.ndarray, twist: np.ndarray
) -> list[ViewFit]:
    """Create the fit of each view at ``pose`` (4, 4), moved by ``twist`` (6,) to its exposure."""
    seen = seen_by(pose, views, twist)
    return [
        ViewFit(context, view, own, drawn)
        for view, own, drawn in zip(views, seen, _draw(context, views, seen), strict=True)
    ]


def _draw(context: FitContext, views: list[View], seen: list[np.ndarray]) -> list[list[Rendering]]:
    """Render each view's pose, in the order of :func:`.view_fit.shots_of`."""
    shots = [shots_of(view, pose) for view, pose in zip(views, seen, strict=True)]
    surface = Surface.of(context.mesh)
    drawn = iter(context.renderer.draw(surface, [shot for group in shots for shot in group]))
    return [[next(drawn) for _ in group] for group in shots]


def assess_all(
    context: FitContext, views: list[View], poses: np.ndarray, twists: np.ndarray | None = None
) -> list[FittedPose]:
    """Compare poses (N, 4, 4) with all views without changing them.

    ``twists`` (N, 6) are the motions of the object as in :func:`fit_pose`. Covariances are NaN.
    """
    motions = np.zeros((len(poses), 6)) if twists is None else twists
    seen = [own for pose, twist in zip(poses, motions, strict=True)
            for own in seen_by(pose, views, twist)]  # fmt: skip
    each = list(views) * len(poses)
    drawn = _draw(context, each, seen)

    def compare(number: int) -> ViewReport:
        silhouette, *depth = drawn[number]
        view, own = each[number], seen[number]
        candidate = choose_candidate(view, silhouette, context.labels)
        return report_view(context, view, own, silhouette, depth[0] if depth else None, candidate)

    reports = context.renderer.pool.map(compare, range(len(each)))
    unknown = np.full((6, 6), np.nan)
    count = len(views)
    return [
        FittedPose(pose, unknown, tuple(reports[i * count : (i + 1) * count]), twist)
        for i, (pose, twist) in enumerate(zip(poses, motions, strict=True))
    ]


def _prior_terms(prior: MotionPrior | None, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return J'J (6, 6) and J'r (6,) of the prior at ``pose``.

    Without a prior J'J is the identity, which keeps the equations regular, and J'r is 0.
    """
    if prior is None:
        return np.eye(6), np.zeros(6)
    away = step_between(prior.pose, pose)
    weight = np.repeat([prior.sigma_rad**-2, prior.sigma_m**-2], 3)
    return np.diag(weight), weight * away


def seen_by(pose: np.ndarray, views: list[View], twist: np.ndarray) -> list[np.ndarray]:
    """Return the pose (4, 4) at the exposure of each view.

    ``twist`` (6,) is the motion of the object per second. If the object moves by less than 0.4 mm
    and 0.08 degrees until a view exposes, the view gets the array ``pose`` itself.
    """
    steps = np.array([view.geometry.time_offset_s for view in views])[:, None] * twist
    moves = np.abs(steps[:, :3]).max(1) > np.radians(0.08)
    moves |= np.abs(steps[:, 3:]).max(1) > 4e-4
    if not moves.any():
        return [pose] * len(views)
    later = apply_step(np.broadcast_to(pose, (len(views), 4, 4)), steps)
    return [own if moves[i] else pose for i, own in enumerate(later)]
