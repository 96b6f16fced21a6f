"""Constant time offset of each camera, estimated from the motion of the subject's keypoints.

An image exposed late shows every keypoint further along its path, so the residual is parallel to
the pixel velocity. Wrong joint positions, constant detector errors and wrong camera poses cause
different patterns over time. All offsets are estimated jointly by generalised least squares, with
joint positions and pose errors as further unknowns.

A residual series is one coordinate of one keypoint in one view over time. Its covariance is the sum
of a constant of any size, a process correlated over time, and white noise. Kind and length of the
correlated part are chosen by likelihood from a short list, in common for all keypoints and views.

Axes: T sets, C views, K keypoints, W sets of a window.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from intercap_core.formats.recordings.synchronise import (
    frame_interval,
    images_of_moments,
    in_step_sigma,
)
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.solve.time_series import filled_linearly
from intercap_core.scene.keypoint_motion import KeypointMotion, build_motion

# Factor of the variance, because the errors of one person's keypoints are correlated over all
# groups of keypoints. Tuned on the studio.
COMMON_ERRORS = 4.0
MIN_TIMING_SETS = 8  # least number of sets for an estimate; tuned on the studio


@dataclass(frozen=True)
class TimeNoise:
    """Covariance of a residual over time."""

    kind: str
    """Correlation at a time difference d: "rough", exp(-|d| / length), or "smooth",
    exp(-d^2 / (2 length^2))."""
    length: float
    """Correlation time, seconds."""
    fast: float
    """Share of the variance that is white noise, 0 to 1."""
    scale: float
    """Standard deviation, in units of the series."""

    def precision(self, times: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Inverse covariances (N, T, T) of N series.

        ``variance``: (N, T) added to the variance of each sample, in units of ``scale`` squared;
        very large for a missing sample.
        """
        unique, of_series = np.unique(variance, axis=0, return_inverse=True)
        one = _covariance(times, self.kind, self.length, self.fast)
        whole = np.broadcast_to(one, (*unique.shape, len(times))).copy()
        rows = np.arange(len(times))
        whole[:, rows, rows] += unique
        return (np.linalg.inv(whole) / self.scale**2)[of_series.ravel()]


def fit_noise(times: np.ndarray, series: np.ndarray, valid: np.ndarray) -> TimeNoise:
    """Choose the noise model of greatest likelihood.

    Only series with at least 90 % valid samples are used; their gaps are interpolated. With fewer
    than 10 of them or fewer than 8 sets, the result is a fixed usual model.

    Args:
        times: (T,) seconds.
        series: (N, T) residuals divided by their standard deviations.
        valid: (N, T) bool.
    """
    whole = np.flatnonzero(valid.mean(1) >= 0.9)
    if len(whole) < 10 or len(times) < 8:
        return TimeNoise("rough", 0.5, 0.25, 1.0)
    rows = np.where(valid[whole], series[whole], np.nan)
    steps = np.arange(rows.shape[1])
    rows = np.stack([filled_linearly(row[:, None], steps, np.isfinite(row))[:, 0] for row in rows])
    best, chosen = -np.inf, TimeNoise("rough", 0.5, 0.25, 1.0)
    # correlation times, seconds, tuned on the studio
    for kind, lengths in {"rough": (0.2, 0.5, 1.0), "smooth": (0.15, 0.3, 0.6)}.items():
        for length in lengths:
            for fast in (0.03, 0.1, 0.25, 0.6):
                covariance = _covariance(times, kind, length, fast)
                low = np.linalg.cholesky(covariance)
                energy = (np.linalg.solve(low, rows.T) ** 2).sum(0)
                # The median over series is robust to occluded joints and unsynchronised cameras.
                # 1.7: the median of chi-square with n degrees of freedom is about n - 2/3, and the
                # free constant takes one.
                scale = max(float(np.median(energy)) / max(len(times) - 1.7, 1), 1e-6)
                likelihood = -np.log(np.diag(low)).sum() - len(times) / 2 * np.log(scale)
                if likelihood > best:
                    best, chosen = likelihood, TimeNoise(kind, length, fast, float(np.sqrt(scale)))
    return chosen


def _covariance(times: np.ndarray, kind: str, length: float, fast: float) -> np.ndarray:
    """Covariance (T, T) of correlated part and white noise, together of unit variance, and of a
    constant whose variance of 100 leaves it nearly free."""
    apart = np.abs(times[:, None] - times) / length
    lasting = np.exp(-apart) if kind == "rough" else np.exp(-(apart**2) / 2)
    return (1 - fast) * lasting + fast * np.eye(len(times)) + 100.0


@dataclass(frozen=True, eq=False)
class TimeOffsets:
    """Time offsets, and their normal equations ``information`` @ offset = ``vector``.

    The equations have no prior, and the master's offset is not set to 0.
    """

    offset: np.ndarray
    """(C,) seconds."""
    sigma: np.ndarray
    """(C,) standard deviation, seconds; NaN = undetermined, and ``offset`` is 0."""
    information: np.ndarray
    """(C, C) 1/s^2."""
    vector: np.ndarray
    """(C,) 1/s."""


def find_offsets(
    keypoints: np.ndarray,
    slip: np.ndarray,
    rig: Rig,
    times: np.ndarray,
    *,
    master: int = 0,
    start: np.ndarray | None = None,
) -> TimeOffsets:
    """Estimate when each camera exposes, seconds after the master.

    Args:
        keypoints: (T, C, 135, 3) x, y, confidence of the subject by image; 0 = not seen.
        slip: (T, C) whole sets by which an image is older than its set.
        times: (T,) seconds.
        master: camera whose offset is 0.
        start: (C,) seconds, approximate offsets; None = 0. They are no evidence: the prior is about
            0.
    """
    shown = keypoints_by_moment(keypoints, slip)
    views = len(rig)
    if len(times) < MIN_TIMING_SETS or views < 2:
        unknown = np.where(np.arange(views) == master, 0.0, np.nan)
        return TimeOffsets(np.zeros(views), unknown, np.zeros((views, views)), np.zeros(views))
    motion = build_motion(shown, rig, times)
    start = np.zeros(views) if start is None else start
    first = start + estimate_offsets(motion.at_offsets(start), master, -start).offset
    # Paths of views that are apart in time are wrong in proportion to the offsets, and so are the
    # first estimates: new paths from keypoints without the effect of the offsets.
    again = build_motion(motion.without_offsets(shown, first), rig, times)
    change = estimate_offsets(again, master, -first)
    return replace(
        change,
        offset=np.where(np.isfinite(change.sigma), first + change.offset, start),
        vector=change.vector + change.information @ first,
    )


def undetermined(sigma: np.ndarray, prior_sigma: np.ndarray) -> np.ndarray:
    """Where data leave more than half of the prior's variance; both are standard deviations."""
    return sigma**2 > prior_sigma**2 / 2


def estimate_offsets(motion: KeypointMotion, master: int, expected: np.ndarray) -> TimeOffsets:
    """The time offsets that explain a motion's residuals best.

    Generalised least squares for 7C unknowns: C offsets, then 6 pose errors of each camera. The
    points are already eliminated by the motion's projector. ``information`` and ``vector`` of the
    result are the equations of the offsets with the poses eliminated.

    Args:
        motion: residuals of the keypoints.
        master: camera whose offset is 0.
        expected: (C,) mean of the prior, seconds; its deviation is :func:`.in_step_sigma`.
    """
    views = len(motion.rig)
    matrices, vectors = _keypoint_equations(motion)
    prior_sigma = np.full(views, in_step_sigma(frame_interval(motion.times)))
    # given poses are uncertain by a degree and 2 cm; tuned on the studio
    pose_sigma = np.repeat([np.radians(1.0), 0.02], 3)
    prior = np.r_[prior_sigma**-2.0, np.tile(pose_sigma**-2.0, views)]
    free = np.flatnonzero(np.arange(7 * views) != master)
    # places of the offsets, without the master's, among the free unknowns
    own = np.searchsorted(free, np.delete(np.arange(views), master))
    inflation = _inflation(matrices, vectors, prior, free, own)
    matrix, vector = matrices.sum(0) / inflation, vectors.sum(0) / inflation
    posterior = matrix + np.diag(prior)
    covariance = np.linalg.inv(posterior[np.ix_(free, free)])
    expectation = prior * np.r_[expected, np.zeros(6 * views)]
    offset, sigma = np.zeros(views), np.zeros(views)
    offset[free[own]] = (covariance @ (vector + expectation)[free])[own]
    sigma[free[own]] = np.sqrt(np.diag(covariance)[own])
    unknown = undetermined(sigma, prior_sigma)
    offset[unknown], sigma[unknown] = 0.0, np.nan
    solved = np.linalg.solve(posterior[views:, views:], matrix[views:, :views])
    information = matrix[:views, :views] - matrix[:views, views:] @ solved
    return TimeOffsets(
        offset, sigma, (information + information.T) / 2, vector[:views] - solved.T @ vector[views:]
    )


def _inflation(
    matrices: np.ndarray, vectors: np.ndarray, prior: np.ndarray, free: np.ndarray, own: np.ndarray
) -> float:
    """Factor by which the offsets' variance exceeds that of the noise model.

    It is :data:`COMMON_ERRORS` times an estimated ratio, at least 1: the cluster-robust sandwich
    variance over the model's variance, mean over the cameras. A cluster is a group of keypoints
    with correlated errors: each of the 25 body points on its own, the 8 points of each hand, and
    the 8 points of the face. Its score is the sum of its keypoints' gradients at the solution.

    Args:
        matrices: (K, n, n) normal matrix of each keypoint, n = 7C.
        vectors: (K, n).
        prior: (n,) inverse variances of the prior about 0.
        free: (m,) indices of the free unknowns.
        own: indices of the offsets among the free unknowns.
    """
    matrix = (matrices.sum(0) + np.diag(prior))[np.ix_(free, free)]
    covariance = np.linalg.inv(matrix)
    solution = covariance @ vectors.sum(0)[free]
    scores = vectors[:, free] - matrices[np.ix_(np.arange(len(matrices)), free, free)] @ solution
    groups = np.zeros((28, len(free)))
    np.add.at(groups, np.r_[np.arange(25), np.repeat([25, 26, 27], 8)], scores)
    taking_part = (np.abs(groups).sum(1) > 0).sum()
    if taking_part < 3:
        return COMMON_ERRORS
    spread = (groups @ covariance[:, own]) ** 2
    ratio = spread.sum(0) / np.diag(covariance)[own] * taking_part / (taking_part - 1)
    return COMMON_ERRORS * max(1.0, float(ratio.mean()))


def keypoints_by_moment(keypoints: np.ndarray, slip: np.ndarray) -> np.ndarray:
    """Keypoints (T, C, 135, 3) of the images that show each set's moment; 0 = no such image."""
    image_of = images_of_moments(slip, np.asarray(keypoints[..., 2].any(-1)))
    shown = keypoints[np.maximum(image_of, 0), np.arange(image_of.shape[1])]
    shown[image_of < 0] = 0
    return shown


def windows(sets: int) -> list[slice]:
    """Divide the indices of ``sets`` sets into slices of about equal length, at most 96 sets.

    Covariances over time are dense within a slice and 0 between slices, which bounds memory and
    time.
    """
    edges = np.linspace(0, sets, -(-sets // 96) + 1).round().astype(int)
    return [slice(a, b) for a, b in pairwise(edges.tolist())]


def as_series(values: np.ndarray) -> np.ndarray:
    """Move the time axis last: (T, K, 2C) to (K, 2C, T)."""
    return np.moveaxis(values, 0, 2)


def estimate_noise(motion: KeypointMotion) -> TimeNoise:
    """Noise model of the motion's projected residuals in the first window."""
    first = motion.window(windows(len(motion.times))[0])
    series = as_series(first.projected_residual)
    valid = np.repeat(np.moveaxis(first.valid, (0, 1, 2), (2, 1, 0)), 2, axis=1)
    size = series.shape[2]
    return fit_noise(first.times, series.reshape(-1, size), valid.reshape(-1, size))


def precisions(motion: KeypointMotion, noise: TimeNoise) -> np.ndarray:
    """Inverse covariances (K, C, W, W) over time of one window's motion, the same for x and y."""
    valid = np.moveaxis(motion.valid, 0, 2)  # (C, K, W)
    variance = np.where(valid, 0.0, 1e6)  # practically no weight if missing
    views, count, size = variance.shape
    inverse = noise.precision(motion.times, variance.reshape(-1, size))
    return np.swapaxes(inverse.reshape(views, count, size, size), 0, 1)


def _keypoint_equations(motion: KeypointMotion) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix (K, n, n) and vector (K, n) of each keypoint, for n = 7C unknowns.

    These are the offsets, then the pose errors of each camera.
    """
    noise = estimate_noise(motion)
    views, count = motion.valid.shape[1:]
    matrices, vectors = np.zeros((count, 7 * views, 7 * views)), np.zeros((count, 7 * views))
    for part in windows(len(motion.times)):
        own = motion.window(part)
        # derivatives (n, W, K, 2C) of the projected residuals
        by_offset = [own.projected_of(c, own.speed_px[:, c]) for c in range(views)]
        columns = np.concatenate([np.stack(by_offset), _pose_columns(own)])
        series, precision = as_series(own.projected_residual), precisions(own, noise)
        for k in range(count):
            for c in np.flatnonzero(own.valid[:, :, k].any(0)):
                both = slice(2 * c, 2 * c + 2)
                rows = columns[:, :, k, both].transpose(2, 1, 0)  # (2, W, n)
                weighted = precision[k, c] @ rows
                matrices[k] += (np.swapaxes(rows, 1, 2) @ weighted).sum(0)
                vectors[k] += np.einsum("xtn,xt->n", weighted, series[k, both])
    return matrices, vectors


def _pose_columns(motion: KeypointMotion) -> np.ndarray:
    """Derivatives (6C, T, K, 2C) of the projected residuals by each camera's rotation about its
    centre, rad, and translation, m, in the master's axes."""
    poses = []
    for c, camera in enumerate(motion.rig):
        arm = np.nan_to_num(motion.paths.points - camera.master_from_colour[:3, 3])
        by_point = motion.by_point[:, c]
        # Turning the camera by w about its centre moves the point, as seen by it, by -(w x arm).
        turned = -np.cross(np.eye(3)[:, None, None], arm)
        moved = np.concatenate([turned, np.broadcast_to(-np.eye(3)[:, None, None], turned.shape)])
        pixels = np.einsum("tkij,ptkj->ptki", by_point, moved)
        poses += [motion.projected_of(c, pixels[p]) for p in range(6)]
    return np.stack(poses)
