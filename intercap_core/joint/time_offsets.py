"""Each camera's time offset from the residuals of a fit of the moving body (beyond the paper).

A camera c that exposes tau_c later than the fit assumes sees every point farther along its path.
Let r be the prediction minus the observation of a point in a view, u the prediction's velocity in
that view and J its derivative by the point's position. Then

    r_c = - u_c tau_c + J_c e + b_c + noise

e is the fit's error of a point in a frame, which all views share; it is eliminated. b_c is a
camera's constant bias, removed with the mean over time. Errors last over many frames: r and u are
replaced by the innovations of a first-order autoregression, weighted robustly (Geman-McClure). The
master's offset is zero. Thresholds and weights are tuned on the studio.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.keypoints import BODY, FACE, LEFT_HAND, RIGHT_HAND
from intercap_core.body_fit.evidence import Evidence
from intercap_core.body_fit.problem import BodyProblem
from intercap_core.geometry.camera import projection
from intercap_core.geometry.solve.robust import SIGMA_PER_MAD, geman_mcclure_weight
from intercap_core.scene.starts import PRIOR_OFFSET_S

POINT_SIGMA_M = 0.03  # prior of e, wide, so that only disagreement of views counts; tuned
INNOVATION_OUTLIER = 3.0  # standard deviations at which an innovation counts a quarter; tuned


@dataclass(frozen=True, eq=False)
class PointObservations:
    """Observations by C cameras of K points in T frames, D numbers each (pixels, or a distance)."""

    residual: np.ndarray  # (T, C, K, D) prediction minus observation
    velocity: np.ndarray  # (T, C, K, D) change of the prediction per second
    by_point: np.ndarray  # (T, C, K, D, P) derivative by P coordinates of the point
    weight: np.ndarray  # (T, C, K) relative confidence; 0 if not seen
    part: np.ndarray  # (K,) part of the body; errors within a part are correlated


@dataclass(frozen=True)
class OffsetPrior:
    """Prior of the time offsets of C cameras."""

    offset: np.ndarray  # (C,) seconds
    sigma: np.ndarray  # (C,) standard deviations, seconds; NaN for a broad prior about zero
    master: int  # Index of the camera whose offset is zero


@dataclass(frozen=True)
class OffsetEstimate:
    """Time offsets of C cameras; zero for the master."""

    offset: np.ndarray  # (C,) exposure after the times of the frame sets, seconds
    sigma: np.ndarray  # (C,) standard deviations, seconds


def estimate_offsets(
    observations: Sequence[PointObservations],
    times: np.ndarray,
    current: np.ndarray,
    prior: OffsetPrior,
) -> OffsetEstimate:
    """Estimate the time offsets of all cameras by four Gauss-Newton steps.

    The covariance contains the observed scatter of the gradient (sandwich estimator).

    Args:
        observations: predicted and observed keypoints and clouds.
        times: (T,) of the frames, seconds.
        current: (C,) offsets with which the predictions were made, seconds.
        prior: prior of the offsets.
    """
    count = len(current)
    has_prior = np.isfinite(prior.sigma)
    expected = np.where(has_prior, prior.offset, 0.0) - current
    # at least 0.5 ms: the prior comes from the same keypoints
    sigma = np.maximum(np.where(has_prior, prior.sigma, PRIOR_OFFSET_S), 0.0005)
    precision = np.diag(sigma**-2.0)
    free = np.arange(count) != prior.master
    all_innovations = [
        innovations
        for points in observations
        if (innovations := _Innovations.of(points, times)) is not None
    ]
    change = np.zeros(count)
    for _ in range(4):
        hessian, gradient = precision.copy(), precision @ (expected - change)
        for innovations in all_innovations:
            h, g = innovations.normal_equations(change)
            hessian, gradient = hessian + h, gradient + g
        change[free] += np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
    spread = precision + sum(innovations.spread(change) for innovations in all_innovations)
    inverse = np.linalg.inv(hessian[np.ix_(free, free)])
    sigma = np.zeros(count)
    sigma[free] = np.sqrt(np.diag(inverse @ spread[np.ix_(free, free)] @ inverse))
    return OffsetEstimate(np.where(free, current + change, 0.0), sigma)


@dataclass(eq=False)
class _Innovations:
    """Innovations over time, in standard deviations, of points that any view saw.

    A row is one point in one frame: N rows.
    """

    residual: np.ndarray  # (N, C, D) less its mean over time
    velocity: np.ndarray  # (N, C, D) less its mean over time
    by_point: np.ndarray  # (N, C, D, P)
    weight: np.ndarray  # (N, C)
    part: np.ndarray  # (N,) part of the body
    frame: np.ndarray  # (N,) number of the frame

    @classmethod
    def of(cls, seen: PointObservations, times: np.ndarray) -> _Innovations | None:
        """Innovations; None if too few are in successive frames, or if most are 0."""
        step = np.diff(times)
        if not len(step):
            return None
        following = (step < 1.5 * np.median(step))[:, None, None]  # a missing frame doubles a step
        weight = np.minimum(seen.weight[1:], seen.weight[:-1]) * following
        if np.count_nonzero(weight) < 50:
            return None
        correlation = _correlation(_centred(seen.residual, seen.weight), weight > 0)
        residual, velocity = (
            _centred(x[1:] - correlation * x[:-1], weight) for x in (seen.residual, seen.velocity)
        )
        scale = np.ones(residual.shape[2])
        for part in np.unique(seen.part):
            here = seen.part == part
            # errors within a part are correlated: it counts at most as four points
            weight[:, :, here] *= min(1.0, 4.0 / np.count_nonzero(here))
            size = np.abs(residual[:, :, here][weight[:, :, here] > 0])
            scale[here] = SIGMA_PER_MAD * np.median(size) if len(size) else 1.0
        # Few residuals may agree by chance, or be copies. The scale of a part is therefore at least
        # a quarter of the scale of all parts (tuned).
        pooled = SIGMA_PER_MAD * np.median(np.abs(residual)[weight > 0])
        if pooled == 0:
            return None
        scale = np.maximum(scale, 0.25 * pooled)[:, None]
        frame, point = np.nonzero(weight.any(axis=1))
        return cls(
            (residual / scale)[frame, :, point],
            (velocity / scale)[frame, :, point],
            seen.by_point[1:][frame, :, point] / scale[point, None, :, None],
            weight[frame, :, point],
            seen.part[point],
            frame,
        )

    def _remaining(self, change: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residuals at offsets ``change`` (C,) and the best errors of the points.

        Returns residuals (N, C, D), robust weights (N, C), and the inverse matrices (N, P, P) of
        the points.
        """
        residual = self.residual + self.velocity * change[:, None]
        weight = self._robust(residual)
        remaining, inverse = self._without_point_errors(residual, weight)
        for _ in range(2):
            weight = self._robust(remaining)
            remaining, inverse = self._without_point_errors(residual, weight)
        return remaining, weight, inverse

    def _robust(self, residual: np.ndarray) -> np.ndarray:
        """Return the weights (N, C) times those of Geman-McClure at ``residual`` (N, C, D)."""
        square = (residual**2).sum(-1) / residual.shape[-1]
        return self.weight * geman_mcclure_weight(square, INNOVATION_OUTLIER)

    def _without_point_errors(
        self, residual: np.ndarray, weight: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (N, C, D) at the best errors e, and the points' inverses (N, P, P)."""
        count, size = len(residual), self.by_point.shape[-1]
        by_point = self.by_point.reshape(count, -1, size)
        weighted = (self.by_point * weight[..., None, None]).reshape(by_point.shape)
        matrix = weighted.transpose(0, 2, 1) @ by_point + np.eye(size) * POINT_SIGMA_M**-2
        inverse = 1 / matrix if size == 1 else np.linalg.inv(matrix)
        gradient = weighted.transpose(0, 2, 1) @ residual.reshape(count, -1, 1)
        return residual - (by_point @ (inverse @ gradient)).reshape(residual.shape), inverse

    def normal_equations(self, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """H (C, C) and g (C,) of the next correction H^-1 g, with the points' errors eliminated."""
        remaining, weight, inverse = self._remaining(change)
        along = self.velocity * weight[..., None]
        own = (along * self.velocity).sum((0, 2))
        cross = (along[..., None] * self.by_point).sum(2)
        shared = np.tensordot(cross @ inverse, cross, axes=((0, 2), (0, 2)))
        return np.diag(own) - shared, -(along * remaining).sum((0, 2))

    def spread(self, change: np.ndarray) -> np.ndarray:
        """Covariance (C, C) of g: its scatter over body parts plus its scatter over frames.

        The former contains lasting errors, the latter errors of single frames.
        """
        remaining, weight, _ = self._remaining(change)
        gradient = (self.velocity * weight[..., None] * remaining).sum(2)  # (N, C)
        groups = [gradient[by == key].sum(0) for by in (self.part, self.frame) for key in set(by)]
        return np.transpose(groups) @ np.array(groups)


def _centred(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Values (T, C, K, D) less the mean over time of each camera and point; 0 if not seen."""
    total = np.maximum(weight.sum(0), 1e-12)[..., None]
    mean = (values * weight[..., None]).sum(0) / total
    return np.where(weight[..., None] > 0, values - mean, 0.0)


def _correlation(residual: np.ndarray, both: np.ndarray) -> float:
    """Correlation of successive residuals (T, C, K, D) that are ``both`` (T-1, C, K) seen.

    Outliers are clipped.
    """
    now, before = residual[1:][both], residual[:-1][both]
    limit = INNOVATION_OUTLIER * SIGMA_PER_MAD * np.median(np.abs(now))
    now, before = (np.clip(x, -limit, limit) for x in (now, before))
    power = np.sqrt((now**2).sum() * (before**2).sum())
    return float(np.clip((now * before).sum() / max(power, 1e-30), 0.0, 0.98))


def observe_keypoints(evidence: Evidence, problem: BodyProblem) -> PointObservations:
    """Keypoints in all colour images, in units of their standard deviation."""
    views = problem.views
    if views is None:
        raise ValueError("the problem has no views to compare with")
    points = evidence.points(problem)
    # shift: motion of each point until each camera exposes
    seen = points[:, None] if views.shift is None else points[:, None] + views.shift
    rotation = views.colour_from_master[:, :3, :3]
    in_camera = seen @ rotation.transpose(1, 2) + views.colour_from_master[:, None, :3, 3]
    pixels, by_camera = projection.project_with_jacobian(in_camera, views.lenses[:, None])
    by_point = by_camera @ rotation[:, None] / views.sigma[..., None, None]
    velocity = by_point @ evidence.velocity(points)[:, None, :, :, None]
    return PointObservations(
        _array((pixels - views.observed) / views.sigma[..., None]),
        _array(velocity[..., 0]),
        _array(by_point),
        _array(views.confidence),
        _part_of_keypoint(problem.keypoints.index.numpy()),
    )


def observe_clouds(evidence: Evidence, problem: BodyProblem) -> PointObservations | None:
    """Depth points at the samples of the skin, along its normal; None without depth.

    A sample at which a camera has two points has half its full weight.
    """
    clouds = evidence.by_view
    if clouds is None:
        return None
    params = evidence.model.parameters(problem.base)
    samples = evidence.model.forward(params, vertex_ids=evidence.sample_ids).vertices
    along = (evidence.velocity(samples) * clouds.normal).sum(-1)
    joint = evidence.model.skinning_weights.argmax(1)[evidence.sample_ids]
    shape = (*clouds.distance.shape, 1)
    return PointObservations(
        -_array(clouds.distance)[..., None],
        np.broadcast_to(_array(along)[:, None, :, None], shape),
        np.ones((*shape, 1)),
        _array(clouds.points / (clouds.points + 2.0)),
        joint.numpy(),
    )


def _part_of_keypoint(index: np.ndarray) -> np.ndarray:
    """Part (K,) of keypoints: each body keypoint, each hand and the face is a part."""
    starts = (LEFT_HAND.start, RIGHT_HAND.start, FACE.start)
    hand_or_face = BODY.stop - 1 + np.searchsorted(starts, index, side="right")
    return np.where(index < BODY.stop, index, hand_or_face)


def _array(values: Tensor) -> np.ndarray:
    with torch.no_grad():
        return values.double().numpy()
