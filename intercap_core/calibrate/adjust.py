"""Bundle adjustment of camera poses on body joints and on corners of a board.

The unknowns of a camera are a step of its pose ``master_from_colour``, six numbers
(:mod:`intercap_core.geometry.camera.transforms`). Joints belong to one set and the poses of the
board to one set: each term eliminates them by the Schur complement and returns normal equations of
the poses alone, as the terms of :mod:`intercap_core.scene.constraints` do. So the same terms also
enter the registration of depth surfaces (:mod:`intercap_core.scene.registration`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtri, stdtrit

from intercap_core.calibrate.evidence import CORNERS, JOINTS, NUM_JOINTS, Views
from intercap_core.formats.calibration.boards import Board
from intercap_core.geometry.camera import projection
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply_step, invert, step_between
from intercap_core.geometry.camera.triangulation import pixel_scale
from intercap_core.geometry.solve.robust import geman_mcclure_weight
from intercap_core.scene.constraints import KEYPOINT_ERROR_TIME_S, ROBUST_SIGMA, cross_matrix
from intercap_core.scene.registration import Constraint

JOINT_PX = 3.0  # smallest error assumed of a joint, pixels of a 1080p image, as in stage `scene`
DISTANCE_M = 0.03  # error of a lifted joint: relief of skin and clothes, and the sensor
INSET_M = 0.02
# Error of a board's corner, pixels of a 1080p image: mostly that of the lens, which neighbouring
# corners share, so that the corners of an image count as four.
CORNER_PX, CORNERS_OF_IMAGE = 0.5, 4.0
MAX_SETS = 300  # with joints; more add nothing but time


class _Pixels:
    """Reprojection errors of points (N, 3) seen at pixels (N, C, 2), and their derivatives."""

    def __init__(self, rig: Rig, poses: np.ndarray, points: np.ndarray, seen: np.ndarray) -> None:
        to_colour, scale = invert(poses), pixel_scale(rig)[:, None]
        in_camera = np.einsum("cij,nj->nci", to_colour[:, :3, :3], points) + to_colour[:, :3, 3]
        pixels, by_camera = projection.project_with_jacobian(in_camera, rig.colour_parameters)
        self.known = np.isfinite(seen[..., 0]) & (in_camera[..., 2] > 0.1)
        self.residual = np.where(self.known[..., None], (pixels - seen) / scale, 0.0)
        by_point = by_camera @ to_colour[:, :3, :3] / scale[..., None]
        self.by_point = np.where(self.known[..., None, None], by_point, 0.0)
        """(N, C, 2, 3)"""
        self.arm = points[:, None] - poses[:, :3, 3]
        """(N, C, 3) from the camera's centre."""
        self.by_pose = np.concatenate([self.by_point @ cross_matrix(self.arm), -self.by_point], -1)
        """(N, C, 2, 6)"""
        self.size = np.linalg.norm(self.residual, axis=-1)
        """(N, C) pixels of a 1080p image."""

    def weights(self, least_px: float) -> np.ndarray:
        """Robust weights over the variance (N, C), 1 / px^2; 0 = not seen."""
        if not self.known.any():
            return np.zeros(self.known.shape)
        sigma = max(least_px, float(np.median(self.size[self.known])) / 1.177)  # Rayleigh's median
        robust = geman_mcclure_weight(self.size**2, ROBUST_SIGMA * sigma)
        return np.where(self.known, robust / sigma**2, 0.0)

    def median(self) -> np.ndarray:
        """Median error (C,) of each camera, pixels of a 1080p image; NaN = nothing seen."""
        return np.array(
            [
                np.median(size[known]) if known.any() else np.nan
                for size, known in zip(self.size.T, self.known.T, strict=True)
            ]
        )


class JointTerm:
    """Reprojection errors of body joints, and distances of lifted joints.

    Errors of one joint last for :data:`KEYPOINT_ERROR_TIME_S`, so images of this time count as one.
    How much deeper than assumed each joint lies below the skin is unknown, but equal in all images.
    """

    def __init__(self, rig: Rig, views: Views, joints: np.ndarray) -> None:
        """``joints``: (T, K, 3) first points, metres; NaN = left out."""
        self._rig = rig
        known = (views.confidence[:, :, JOINTS] > 0).sum(1) >= 2
        known &= np.isfinite(joints[..., 0])
        some = np.flatnonzero(known.any(1))
        chosen = np.zeros(len(known), bool)
        chosen[some[np.linspace(0, len(some) - 1, min(MAX_SETS, len(some))).astype(int)]] = True
        t, self._joint = np.nonzero(known & chosen[:, None])
        self._pixels = views.pixels[t, :, self._joint]
        self._distance = views.distance[t, :, self._joint]
        steps = np.diff(views.times[chosen])
        gap = float(np.median(steps[steps > 0])) if (steps > 0).any() else KEYPOINT_ERROR_TIME_S
        share = min(1.0, gap / KEYPOINT_ERROR_TIME_S)
        self._share = share * views.confidence[t, :, self._joint]
        self.points = joints[t, self._joint]
        """(N, 3) joints, metres."""
        self.insets = np.zeros(NUM_JOINTS)
        """(K,) metres by which each joint lies deeper than assumed."""

    def __len__(self) -> int:
        return len(self.points)

    def __call__(self, poses: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (C, 6, C, 6) and gradient (C, 6) at poses (C, 4, 4); ``offset`` is unused.

        Joints and insets are first adapted to the poses by two Gauss-Newton steps.
        """
        for _ in range(2):
            self._adapt(poses)
        matrix, gradient, *_ = self._reduced(poses)
        return matrix, gradient

    def errors_px(self, poses: np.ndarray) -> np.ndarray:
        """Median reprojection error (C,) of each camera, pixels of a 1080p image; NaN = none."""
        return _Pixels(self._rig, poses, self.points, self._pixels).median()

    def sizes_px(self, poses: np.ndarray) -> np.ndarray:
        """Reprojection errors (N, C) of all joints, pixels of a 1080p image; NaN = not seen."""
        pixel = _Pixels(self._rig, poses, self.points, self._pixels)
        return np.where(pixel.known, pixel.size, np.nan)

    def _adapt(self, poses: np.ndarray) -> None:
        """One Gauss-Newton step of the joints and insets at fixed poses."""
        _, _, matrix, gradient, cross, own, slope = self._reduced(poses)
        insets = -np.linalg.solve(matrix, gradient)
        right = slope + cross * insets[self._joint][:, None]
        self.points = self.points - np.linalg.solve(own, right[..., None])[..., 0]
        self.insets = self.insets + insets

    def _reduced(self, poses: np.ndarray) -> tuple[np.ndarray, ...]:
        """Normal equations with the joints eliminated.

        Returns the reduced matrix and gradient of the poses, those of the insets alone, the
        coupling (N, 3) of each point with its inset, and the points' own matrices and slopes.
        """
        views, count = len(self._rig), len(self.points)
        pixel = _Pixels(self._rig, poses, self.points, self._pixels)
        away = np.maximum(np.linalg.norm(pixel.arm, axis=-1), 1e-9)
        has = np.isfinite(self._distance)
        off = np.where(has, away - self._distance - self.insets[self._joint][:, None], 0.0)
        robust = geman_mcclure_weight(off**2, ROBUST_SIGMA * DISTANCE_M)
        along = (pixel.arm / away[..., None])[..., None, :]  # (N, C, 1, 3)
        by_point = np.concatenate([pixel.by_point, along], -2)  # (N, C, 3, 3)
        of_distance = np.concatenate([np.zeros_like(along), -along], -1)
        by_pose = np.concatenate([pixel.by_pose, of_distance], -2)  # (N, C, 3, 6)
        residual = np.concatenate([pixel.residual, off[..., None]], -1)
        in_px = self._share * pixel.weights(JOINT_PX)
        in_m = np.where(has, self._share * robust / DISTANCE_M**2, 0.0)
        weight = np.stack([in_px, in_px, in_m], -1)
        weighted = by_pose * weight[..., None]

        own = np.einsum("ncij,nci,ncik->njk", by_point, weight, by_point)
        own += (1e-6 * np.trace(own, axis1=1, axis2=2) + 1e-6)[:, None, None] * np.eye(3)
        slope = np.einsum("ncij,nci->nj", by_point, weight * residual)
        size = 6 * views
        with_pose = np.einsum("ncij,ncik->njck", by_point, weighted).reshape(count, 3, size)
        with_inset = -(in_m[..., None] * along[..., 0, :]).sum(1)  # (N, 3)
        # the unknowns that stay: poses, then the inset of each joint
        matrix = np.zeros((size + NUM_JOINTS, size + NUM_JOINTS))
        gradient = np.zeros(size + NUM_JOINTS)
        for c, block in enumerate(np.einsum("ncij,ncik->cjk", weighted, by_pose)):
            matrix[6 * c : 6 * c + 6, 6 * c : 6 * c + 6] = block
        gradient[:size] = np.einsum("ncij,nci->cj", weighted, residual).ravel()
        solved = np.linalg.solve(own, np.concatenate([with_pose, slope[..., None]], -1))
        matrix[:size, :size] -= np.einsum("njk,njl->kl", with_pose, solved[..., :-1])
        gradient[:size] -= np.einsum("njk,nj->k", with_pose, solved[..., -1])
        of_inset = np.linalg.solve(own, with_inset[..., None])[..., 0]
        place = size + np.arange(NUM_JOINTS)
        of_joint = np.zeros((NUM_JOINTS, size))
        np.add.at(of_joint, self._joint, -(in_m[..., None] * by_pose[:, :, 2]).reshape(count, -1))
        np.add.at(of_joint, self._joint, -np.einsum("nj,njk->nk", of_inset, with_pose))
        own_matrix, own_slope = (
            np.bincount(self._joint, values, NUM_JOINTS)
            for values in (
                in_m.sum(1) - (of_inset * with_inset).sum(1),
                -(in_m * off).sum(1) - (of_inset * slope).sum(1),
            )
        )
        matrix[place, place] = own_matrix + INSET_M**-2
        gradient[size:] = own_slope + self.insets / INSET_M**2
        matrix[size:, :size], matrix[:size, size:] = of_joint, of_joint.T
        insets = matrix[size:, size:]
        both = np.linalg.solve(insets, np.column_stack([matrix[size:, :size], gradient[size:]]))
        reduced = matrix[:size, :size] - matrix[:size, size:] @ both[:, :-1]
        pull = gradient[:size] - matrix[:size, size:] @ both[:, -1]
        shape = (views, 6, views, 6)
        pull = pull.reshape(views, 6)
        return reduced.reshape(shape), pull, insets, gradient[size:], with_inset, own, slope


class BoardTerm:
    """Reprojection errors of a board's corners; the board's pose of each set is unknown."""

    def __init__(self, rig: Rig, views: Views, board: Board, boards: np.ndarray) -> None:
        """``boards``: (T, 4, 4) first master_from_board; NaN = left out."""
        self._rig, self._corners = rig, board.corners
        seen = np.isfinite(views.pixels[:, :, CORNERS, 0]).any(2).sum(1) >= 2
        rows = np.flatnonzero(seen & np.isfinite(boards[:, 0, 0]))
        self._pixels = np.swapaxes(views.pixels[rows][:, :, CORNERS], 1, 2)  # (B, N, C, 2)
        self.boards = boards[rows]

    def __len__(self) -> int:
        return len(self.boards)

    def __call__(self, poses: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Matrix (C, 6, C, 6) and gradient (C, 6) at poses (C, 4, 4); ``offset`` is unused.

        The boards' poses are first adapted by two Gauss-Newton steps.
        """
        for _ in range(2):
            *_, own, slope = self._blocks(poses)
            self.boards = apply_step(self.boards, -np.linalg.solve(own, slope[..., None])[..., 0])
        matrix, gradient, cross, own, slope = self._blocks(poses)
        solved = np.linalg.solve(own, np.concatenate([cross, slope[..., None]], -1))
        matrix -= np.einsum("bjk,bjl->kl", cross, solved[..., :-1])
        gradient -= np.einsum("bjk,bj->k", cross, solved[..., -1])
        views = len(self._rig)
        return matrix.reshape(views, 6, views, 6), gradient.reshape(views, 6)

    def errors_px(self, poses: np.ndarray) -> np.ndarray:
        """Median reprojection error (C,) of each camera, pixels of a 1080p image; NaN = none."""
        return self._corner_pixels(poses)[1].median()

    def sizes_px(self, poses: np.ndarray) -> np.ndarray:
        """Reprojection errors (B * N, C) of all corners, pixels of a 1080p image; NaN = unseen."""
        pixel = self._corner_pixels(poses)[1]
        return np.where(pixel.known, pixel.size, np.nan)

    def _corner_pixels(self, poses: np.ndarray) -> tuple[np.ndarray, _Pixels]:
        """Corners (B, N, 3) relative to their board's origin, and their reprojection errors."""
        arms = np.einsum("bij,nj->bni", self.boards[:, :3, :3], self._corners)
        points = (arms + self.boards[:, None, :3, 3]).reshape(-1, 3)
        seen = self._pixels.reshape(len(points), -1, 2)
        return arms, _Pixels(self._rig, poses, points, seen)

    def _blocks(self, poses: np.ndarray) -> tuple[np.ndarray, ...]:
        """Matrix and gradient of the poses; coupling, matrix and slope of each board's pose."""
        views, boards = len(self._rig), len(self.boards)
        arms, pixel = self._corner_pixels(poses)
        of_image = pixel.known.reshape(boards, -1, views).sum(1, keepdims=True)
        share = np.minimum(1.0, CORNERS_OF_IMAGE / np.maximum(of_image, 1))
        share = np.broadcast_to(share, (boards, len(self._corners), views))
        weight = share.reshape(-1, views) * pixel.weights(CORNER_PX)
        by_board = np.concatenate(
            [-pixel.by_point @ cross_matrix(arms.reshape(-1, 1, 3)), pixel.by_point], -1
        )
        weighted = pixel.by_pose * weight[..., None, None]
        matrix = np.zeros((6 * views, 6 * views))
        for c, block in enumerate(np.einsum("ncij,ncik->cjk", weighted, pixel.by_pose)):
            matrix[6 * c : 6 * c + 6, 6 * c : 6 * c + 6] = block
        gradient = np.einsum("ncij,nci->cj", weighted, pixel.residual).ravel()
        shape = (boards, -1, views, 2, 6)
        by_board, of_pose = by_board.reshape(shape), weighted.reshape(shape)
        weights = weight.reshape(boards, -1, views)
        residual = pixel.residual.reshape(boards, -1, views, 2)
        cross = np.einsum("bncij,bncik->bjck", by_board, of_pose).reshape(boards, 6, -1)
        own = np.einsum("bncij,bnc,bncik->bjk", by_board, weights, by_board)
        own += 1e-6 * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(6) + 1e-9 * np.eye(6)
        slope = np.einsum("bncij,bnc,bnci->bj", by_board, weights, residual)
        return matrix, gradient, cross, own, slope


def adjust(
    terms: Sequence[Constraint], poses: np.ndarray, free: Sequence[int], *, steps: int = 30
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Minimise the terms over the poses of the cameras ``free`` by Gauss-Newton steps.

    A weak prior of 1 m and 1 rad a step limits directions without data, such as the scale of a rig
    that only colour cameras see.

    Args:
        poses: (C, 4, 4) master_from_colour at the start.

    Returns:
        Poses (C, 4, 4), covariance (C, 6, C, 6) of their steps (0 = fixed), and whether the last
        step is below a tenth of a millimetre and of a milliradian.
    """
    views = len(poses)
    rows = (6 * np.asarray(free)[:, None] + np.arange(6)).ravel()
    covariance, largest = np.zeros((6 * views, 6 * views)), np.inf
    for _ in range(steps):
        matrix, gradient = np.zeros((6 * views, 6 * views)), np.zeros(6 * views)
        for term in terms:
            block, slope = term(poses, np.zeros(views))
            matrix += block.reshape(matrix.shape)
            gradient += slope.ravel()
        system = matrix[np.ix_(rows, rows)] + np.eye(len(rows))
        step = np.zeros(6 * views)
        step[rows] = -np.linalg.solve(system, gradient[rows])
        poses = apply_step(poses, step.reshape(views, 6))
        largest = float(np.abs(step).max())
        if largest < 1e-4:
            break
    covariance[np.ix_(rows, rows)] = np.linalg.inv(system)
    return poses, covariance.reshape(views, 6, views, 6), largest < 1e-4


def jackknife_covariance(found: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Covariance (6 C, 6 C) of the steps of ``poses`` (C, 4, 4) by the delete-a-group jackknife.

    It is multiplied such that twice the standard deviation bounds 95 % of the errors, as it does of
    Gaussian ones: few groups give an uncertain variance (Student's t distribution).

    Args:
        found: (G, C, 4, 4) poses, each without one of G groups of the data. G < 2 gives zero.
    """
    groups, size = len(found), 6 * len(poses)
    if groups < 2:
        return np.zeros((size, size))
    steps = step_between(poses, found).reshape(groups, size)
    off = steps - steps.mean(0)
    wider = stdtrit(groups - 1, 0.975) / ndtri(0.975)
    return wider**2 * (groups - 1) / groups * off.T @ off
