"""Small corrections of the cameras from the images of body and object (beyond the paper).

Image residuals that body and object have in common over all frames are errors of the cameras. The
unknowns d are a turn about its centre, a shift and a depth bias of each camera. The unknowns x of
all frames (poses of body and object) are eliminated by the Schur complement. The prior of d is
Gaussian about the scene's cameras, with the scene's covariance P^-1:

    S = P + sum a (H_dd - H_dx H_xx^-1 H_xd)
    step = -S^-1 (P d + sum a (g_d - H_dx H_xx^-1 g_x))

The sums run over all frames, of the body (E_B) and of the object (E_O). H and g are the blocks of
their Gauss-Newton matrices and gradients. d is the correction so far, and a the weight of a frame,
below 1 because errors last over several frames. The poses follow by -H_xx^-1 H_xd step. S^-1 is the
covariance of the corrections.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.rig import Rig
from intercap_core.joint.state import ALL

# Unknowns of a camera: turn about its centre (rad), shift (m), both in the master frame, depth bias
# (m).
FREEDOMS = 7
TURN, SHIFT, BIAS = slice(0, 3), slice(3, 6), 6


@dataclass(frozen=True, eq=False)
class Cameras:
    """Poses, lenses and depth biases of C cameras."""

    rig: Rig  # Lenses and poses
    depth_bias: np.ndarray  # (C,) metres to subtract from depth

    def moved(self, step: np.ndarray) -> Cameras:
        """The cameras after ``step`` (C, 7): turns about their centres, shifts, depth biases."""
        poses = self.rig.master_from_colour.copy()
        poses[:, :3, :3] = Rotation.from_rotvec(step[:, TURN]).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += step[:, SHIFT]
        return Cameras(self.rig.moved(poses), self.depth_bias + step[:, BIAS])


@dataclass(frozen=True, eq=False)
class CameraEvidence:
    """Gauss-Newton form of E_B or E_O by n unknowns x of N frames and D = 7 C of the cameras.

    Symbols are those of the module's header.
    """

    columns: slice  # The n unknowns of a frame
    frames: np.ndarray  # (N,) indices of the frames, increasing
    matrix: np.ndarray  # (N, n, n) H_xx
    gradient: np.ndarray  # (N, n) g_x
    cross: np.ndarray  # (N, n, D) H_xd
    hessian: np.ndarray  # (D, D) H_dd, summed over frames
    pull: np.ndarray  # (D,) g_d, summed over frames
    share: float  # a, weight of a frame: 1 / number of frames with the same errors


@dataclass(frozen=True, eq=False)
class CameraStep:
    """A correction of the cameras."""

    step: np.ndarray  # (C, 7)
    along: np.ndarray  # (T, 174) step of the frames' unknowns that follows from ``step``,
    # interpolated between the frames of the evidence
    covariance: np.ndarray  # (C, 7, C, 7) of the cameras' corrections after the step

    @property
    def shift(self) -> float:
        """Largest displacement of a point at one metre from its camera (estimate), metres."""
        size = np.abs(self.step)
        return float((size[:, TURN].max(1) + size[:, SHIFT].max(1) + size[:, BIAS]).max())


class CameraFit:
    """The cameras, corrected in steps from those of the scene.

    Attributes:
        now: the cameras after all accepted steps.
        covariance: (C, 7, C, 7) of the corrections; 0 for what is fixed.
        refused: a step was implausible, and the cameras were reset to the scene's.
    """

    def __init__(self, start: Cameras, covariance: np.ndarray) -> None:
        """``covariance`` (C, 7, C, 7) is 0 for fixed unknowns.

        Raises LinAlgError if that of the other unknowns is not positive definite.
        """
        self._given = start, covariance
        self.now, self.covariance, self.refused = start, covariance, False
        self._correction = np.zeros((len(start.rig), FREEDOMS))
        flat = covariance.reshape(self._correction.size, -1)
        self._free = np.flatnonzero(flat.diagonal() > 0)
        self._sigma = np.sqrt(flat.diagonal()[self._free])
        own = flat[np.ix_(self._free, self._free)]
        np.linalg.cholesky(own)
        self._information = np.linalg.inv(own)

    def take(self, correction: CameraStep) -> bool:
        """Apply a plausible correction and return True; otherwise reset all cameras."""
        total = self._correction + correction.step
        if not self._is_plausible(total):
            (self.now, self.covariance), self._correction = self._given, np.zeros_like(total)
            self.refused = True
            return False
        self.now, self._correction = self.now.moved(correction.step), total
        self.covariance = correction.covariance
        return True

    def _is_plausible(self, total: np.ndarray) -> bool:
        """Whether the sum (C, 7) of all corrections is plausible.

        Each unknown must stay below 5 standard deviations of the scene, and so must the root mean
        square of all in units of the scene's covariance. A point at 2.5 m must move by less than
        30 mm. These limits are two to three times the largest correction on the studio.
        """
        free = total.ravel()[self._free]
        together = np.sqrt(free @ self._information @ free / max(len(free), 1))
        size = np.linalg.norm(total[:, TURN], axis=1) * 2.5
        size += np.linalg.norm(total[:, SHIFT], axis=1) + np.abs(total[:, BIAS])
        return bool(
            (np.abs(free) < 5.0 * self._sigma).all() and together < 5.0 and (size < 0.03).all()
        )

    def solve(self, evidence: Iterable[CameraEvidence], count: int) -> CameraStep:
        """Return the step to the minimum of ``evidence`` and prior; fixed unknowns have step 0.

        ``evidence`` is that of successive windows of the ``count`` frames, each used once.
        """
        free = self._free
        total, pull = self._information, self._information @ self._correction.ravel()[free]
        follows: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = {}
        for form in evidence:
            cross = form.cross[..., free]
            right = np.concatenate([cross, form.gradient[..., None]], axis=2)
            solved = np.linalg.solve(form.matrix, right)
            inside = form.hessian[np.ix_(free, free)] - np.einsum(
                "tid,tie->de", cross, solved[..., :-1], optimize=True
            )
            total = total + form.share * inside
            own = form.pull[free] - np.einsum("tid,ti->d", cross, solved[..., -1])
            pull = pull + form.share * own
            columns = form.columns.start, form.columns.stop
            follows.setdefault(columns, []).append((form.frames, solved[..., :-1]))
        covariance = np.linalg.inv(total)
        step = np.zeros(self._correction.size)
        step[free] = -covariance @ pull
        stated = np.zeros((step.size, step.size))
        stated[np.ix_(free, free)] = covariance
        along = np.zeros((count, ALL.stop))
        for (first, last), parts in follows.items():
            frames = np.concatenate([at for at, _ in parts])
            moved = np.concatenate([follow @ step[free] for _, follow in parts])
            if len(frames):
                between = [np.interp(np.arange(count), frames, column) for column in moved.T]
                along[:, first:last] = -np.stack(between, axis=1)
        return CameraStep(
            step.reshape(self._correction.shape), along, stated.reshape(self.covariance.shape)
        )
