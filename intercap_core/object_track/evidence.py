"""Evidence of the views of a frame set as quadratic forms of small motions of a pose.

The negative log-likelihood of a step x = (turn on the left, shift) from the pose is
x^T H x / 2 + g^T x. H = J'J (``information``) and g = J'r (``gradient``) are those of equation 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.fit import DEPTH_SCALES_M, view_fits
from intercap_core.object_track.view import FitContext, View
from intercap_core.object_track.view_fit import CONTOUR_SCALES_PX, NormalEquations, ViewFit
from intercap_core.object_track.view_report import ViewReport

# Total variance of the views' errors over the part that is independent between views. Errors that
# all views have in common (calibration, masks that are too large) shift the object rather than
# rotate it.
COMMON_ERROR_VARIANCE = 4.0  # of shifts; tuned
# (6,) corrects standard deviations (turn, shift) computed with COMMON_ERROR_VARIANCE alone. That of
# turns is 1.5; tuned.
TURN_SCALE = np.repeat([np.sqrt(1.5 / COMMON_ERROR_VARIANCE), 1.0], 3)
# Duration of errors of masks, seconds: frames within it are one independent observation.
ERROR_LASTING_S = 0.3  # tuned
# Standard deviations (turn, shift) of an unobserved pose: a uniform angle, radians; a room, metres.
UNKNOWN_SIGMA = np.repeat([np.pi / np.sqrt(3), 1.0], 3)


@dataclass(frozen=True)
class ImageEvidence:
    """Evidence of V views on small motions (turn on the left, shift) of a pose, without a prior.

    J'J and J'r are weighted in units of one standard deviation, zero for a view without evidence.
    """

    information: np.ndarray
    """(V, 6, 6) J'J."""
    gradient: np.ndarray
    """(V, 6) J'r."""
    of_depth: np.ndarray
    """(V, 6, 6) part of ``information`` that depth gives."""
    depth_gradient: np.ndarray
    """(V, 6) part of ``gradient`` that depth gives."""
    reports: tuple[ViewReport, ...]
    """Agreement of each view with the pose."""

    @property
    def log_ratio(self) -> float:
        """Log-likelihood ratio of all views, nats (:mod:`.likelihood`)."""
        return sum(view.log_ratio for view in self.reports)


def evidence_at(
    context: FitContext, views: list[View], pose: np.ndarray, twist: np.ndarray
) -> ImageEvidence:
    """Evaluate the evidence of the images at ``pose`` (4, 4) with the last robust scales of a fit.

    ``twist`` (6,) is the motion of the object as in :func:`.fit.fit_pose`.
    """
    fits = view_fits(context, views, pose, twist)

    def terms(fit: ViewFit) -> tuple[NormalEquations, NormalEquations, ViewReport]:
        fit.choose()
        depth = fit.depth_terms(DEPTH_SCALES_M[1])
        contour = fit.contour_terms(CONTOUR_SCALES_PX[1], context.background_term)[:2]
        return depth, contour, fit.report()

    by_view = context.renderer.pool.map(terms, fits)
    depth = [np.array(part) for part in zip(*(terms[0] for terms in by_view), strict=True)]
    contour = [np.array(part) for part in zip(*(terms[1] for terms in by_view), strict=True)]
    reports = tuple(report for *_, report in by_view)
    return ImageEvidence(depth[0] + contour[0], depth[1] + contour[1], depth[0], depth[1], reports)


def report_at(context: FitContext, view: View, pose: np.ndarray, twist: np.ndarray) -> ViewReport:
    """Return the report of :func:`evidence_at` for one view and ``pose`` (4, 4)."""
    (fit,) = view_fits(context, [view], pose, twist)
    fit.choose()
    return fit.report()


def views_noise(evidences: Sequence[ImageEvidence]) -> float:
    """Estimate s^2, the true over the stated variance of a view, from the disagreement of views.

    At the minimum each view v of a frame still has a gradient g_v. If the errors of views are
    independent, E[g_v g_v'] = s^2 H_v, less the share of v in the minimum. Errors that all views
    have in common do not show; ``COMMON_ERROR_VARIANCE`` adds them.
    """
    squares = freedom = 0.0
    for evidence in evidences:
        total = evidence.information.sum(0) + np.diag(UNKNOWN_SIGMA**-2)
        inverse = np.linalg.inv(total)
        share = np.einsum("vij,ji->v", evidence.information, inverse) / 6
        gradient = evidence.gradient
        squares += float(np.einsum("vi,ij,vj->", gradient, inverse, gradient))
        freedom += float((6 * share * (1 - share)).sum())
    apart = squares / freedom if freedom > 1 else 1.0
    # a few views may agree by chance, so the total variance is at least 0.05 of the stated one
    return float(np.clip(apart, 0.05 / COMMON_ERROR_VARIANCE, 1.0))


def free_turns(mesh: ObjectMesh, pose: np.ndarray) -> np.ndarray:
    """Return the steps (N, 6) of a pose (4, 4) that no image shows.

    These are turns about the axis of a continuous symmetry, or any turn of a sphere.
    """
    symmetry = mesh.symmetry
    if symmetry.sphere:
        axes, offset = np.eye(3), np.zeros(3)
    elif symmetry.axis is not None and symmetry.offset is not None:
        axes, offset = symmetry.axis[None], symmetry.offset
    else:
        return np.zeros((0, 6))
    turn = axes @ pose[:3, :3].T
    return np.concatenate([turn, -np.cross(turn, pose[:3, :3] @ offset)], axis=1)


def without_turns(
    information: np.ndarray, gradient: np.ndarray, steps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Remove the evidence on ``steps`` (N, 6), which the facets of a round mesh seem to give.

    For each step s of :func:`free_turns`, information H (..., 6, 6) becomes
    H - H s s^T H / (s^T H s), so that H s = 0. ``gradient`` (..., 6).
    """
    for step in steps:
        row = information @ step
        size = np.maximum(row @ step, 1e-9)
        seen = (row @ step > 1e-9) / size
        gradient = gradient - row * (seen * (gradient @ step))[..., None]
        information = information - row[..., :, None] * row[..., None, :] * seen[..., None, None]
    return information, gradient


@dataclass(frozen=True)
class FrameEvidence:
    """Evidence of T frames on small motions (turn on the left, shift) of their poses."""

    poses: np.ndarray
    """(T, 4, 4) at which the evidence was evaluated."""
    information: np.ndarray
    """(T, 6, 6) J'J."""
    gradient: np.ndarray
    """(T, 6) J'r."""

    def about(self, centre: np.ndarray) -> FrameEvidence:
        """Express poses and steps about ``centre`` (3,) of the object instead of its origin.

        The translations become the positions of the centre.
        """
        # the shift of the origin is that of the centre plus that by the turn
        to_origin = steps_about_point(self.poses[:, :3, :3] @ centre)
        back = to_origin.transpose(0, 2, 1)
        poses = self.poses.copy()
        poses[:, :3, 3] += poses[:, :3, :3] @ centre
        return FrameEvidence(
            poses, back @ self.information @ to_origin, np.einsum("tij,tj->ti", back, self.gradient)
        )

    @property
    def own(self) -> np.ndarray:
        """Steps (T, 6) to the minimum of the evidence of each frame alone, from its pose."""
        damped = self.information + np.diag(UNKNOWN_SIGMA**-2)
        return -np.linalg.solve(damped, self.gradient[..., None])[..., 0]


def steps_about_point(arms: np.ndarray) -> np.ndarray:
    """Return matrices (T, 6, 6) from steps about one point to steps about another.

    The second point is the first minus ``arms`` (T, 3), so its shift gains turn x -arm.
    """
    result = np.tile(np.eye(6), (len(arms), 1, 1))
    result[:, 3:, :3] = np.cross(np.eye(3), arms[:, None])
    return result
