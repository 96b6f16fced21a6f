"""Small corrections of the cameras that body and object settle together (beyond the paper).

The scene's cameras are the best that the room shows. What moves through all views says more: the
object's shape is known, and what all frames have in common of its disagreements is the cameras'.
Between the rounds each camera's turn about its centre, shift and depth bias d go to the minimum of
the images' evidence over all poses, with the prior that the scene's covariance P^-1 gives:

    S = P + sum a (H_dd - H_dx H_xx^-1 H_xd)
    step = -S^-1 (P d + sum a (g_d - H_dx H_xx^-1 g_x))

summed over frames, body (E_B) and object (E_O), x its pose, which goes along: -H_xx^-1 H_xd step. a
is the share of an independent observation that a frame is, as errors last. S^-1 is the covariance.
Contact, which says where body and object are to each other, says nothing of cameras. The keypoints
that helped the scene's registration count once more here, with the little that the body counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.rig import Rig
from intercap_core.joint.state import ALL

# Corrections of so many of the scene's standard deviations say that body or object are wrong, not
# the cameras. Tuned on the studio: none of its recordings comes to half of it.
MAX_CAMERA_SIGMAS = 5.0
# Largest correction of what a camera shows so far away, metres: beyond it a calibration is wrong
# and has to be made again. Tuned on the studio, whose corrections stay below a third of it.
MAX_CAMERA_SHIFT_M, CAMERA_REACH_M = 0.03, 2.5

FREEDOMS = 7  # of a camera: turn about its centre, shift, depth bias
TURN, SHIFT, BIAS = slice(0, 3), slice(3, 6), 6


@dataclass(frozen=True, eq=False)
class Cameras:
    """Lenses and poses of ``rig`` and ``depth_bias`` (C,), metres to subtract from depth."""

    rig: Rig
    depth_bias: np.ndarray

    def moved(self, step: np.ndarray) -> Cameras:
        """The cameras after ``step`` (C, 7): turns about their centres, shifts, depth biases."""
        poses = self.rig.master_from_colour.copy()
        poses[:, :3, :3] = Rotation.from_rotvec(step[:, TURN]).as_matrix() @ poses[:, :3, :3]
        poses[:, :3, 3] += step[:, SHIFT]
        return Cameras(self.rig.moved(poses), self.depth_bias + step[:, BIAS])


@dataclass(frozen=True, eq=False)
class Sights:
    """What images say of the unknowns ``columns`` of frames and of the cameras, D = 7 C: the
    frames' ``matrix`` (T, n, n) and ``gradient`` (T, n), ``cross`` (T, n, D), and ``hessian``
    (D, D) and ``pull`` (D,) by the corrections; ``share`` as in the module's text."""

    columns: slice
    matrix: np.ndarray
    gradient: np.ndarray
    cross: np.ndarray
    hessian: np.ndarray
    pull: np.ndarray
    share: float


@dataclass(frozen=True, eq=False)
class CameraStep:
    """The cameras' ``step`` (C, 7), what the frames' unknowns do with it, ``along`` (T, N), and the
    ``covariance`` (C, 7, C, 7) of the corrections after it."""

    step: np.ndarray
    along: np.ndarray
    covariance: np.ndarray

    @property
    def shift(self) -> float:
        """The largest motion of something a metre from its camera, metres."""
        size = np.abs(self.step)
        return float((size[:, TURN].max(1) + size[:, SHIFT].max(1) + size[:, BIAS]).max())


class CameraFit:
    """The cameras ``now``, from what the scene says of them: poses and biases ``start`` with their
    ``covariance`` (C, 7, C, 7), 0 for what is held. ``refused``: corrections were, and all are
    taken back. Raises LinAlgError where the covariance is not positive definite."""

    def __init__(self, start: Cameras, covariance: np.ndarray) -> None:
        self._given = start, covariance
        self.now, self.covariance, self.refused = start, covariance, False
        self._away = np.zeros((len(start.rig), FREEDOMS))
        flat = covariance.reshape(self._away.size, -1)
        self._free = np.flatnonzero(flat.diagonal() > 0)
        self._sigma = np.sqrt(flat.diagonal()[self._free])
        own = flat[np.ix_(self._free, self._free)]
        np.linalg.cholesky(own)
        self._information = np.linalg.inv(own)

    def take(self, found: CameraStep) -> bool:
        """Move the cameras; where that goes far beyond what the scene leaves open, put all of them
        back instead. Returns whether they were moved."""
        away = self._away + found.step
        if not self._is_likely(away):
            (self.now, self.covariance), self._away = self._given, np.zeros_like(away)
            self.refused = True
            return False
        self.now, self._away = self.now.moved(found.step), away
        self.covariance = found.covariance
        return True

    def _is_likely(self, away: np.ndarray) -> bool:
        """Whether corrections (C, 7) are within the scene's standard deviations, each by itself and
        all together, and small where things happen."""
        free = away.ravel()[self._free]
        together = np.sqrt(free @ self._information @ free / max(len(free), 1))
        size = np.linalg.norm(away[:, TURN], axis=1) * CAMERA_REACH_M
        size += np.linalg.norm(away[:, SHIFT], axis=1) + np.abs(away[:, BIAS])
        return bool(
            (np.abs(free) < MAX_CAMERA_SIGMAS * self._sigma).all()
            and together < MAX_CAMERA_SIGMAS
            and (size < MAX_CAMERA_SHIFT_M).all()
        )

    def settle(self, sights: Sequence[Sights]) -> CameraStep:
        """The best corrections beside those that were taken, of what can be corrected."""
        free = self._free
        total, pull = self._information, self._information @ self._away.ravel()[free]
        follows = []
        for seen in sights:
            cross = seen.cross[..., free]
            right = np.concatenate([cross, seen.gradient[..., None]], axis=2)
            found = np.linalg.solve(seen.matrix, right)
            inside = seen.hessian[np.ix_(free, free)] - np.einsum(
                "tid,tie->de", cross, found[..., :-1], optimize=True
            )
            total = total + seen.share * inside
            own = seen.pull[free] - np.einsum("tid,ti->d", cross, found[..., -1])
            pull = pull + seen.share * own
            follows.append(found[..., :-1])
        covariance = np.linalg.inv(total)
        step = np.zeros(self._away.size)
        step[free] = -covariance @ pull
        stated = np.zeros((step.size, step.size))
        stated[np.ix_(free, free)] = covariance
        along = np.zeros((len(sights[0].matrix), ALL.stop))
        for seen, follow in zip(sights, follows, strict=True):
            along[:, seen.columns] -= follow @ step[free]
        return CameraStep(
            step.reshape(self._away.shape), along, stated.reshape(self.covariance.shape)
        )
