"""E_O in the joint energy: the images' evidence on the object's pose, frame by frame.

The tracker ends at the minimum of equation 1 with that energy's curvature there. Around it E_O is
the quadratic form of the two, so the joint fit needs no second look at the images. A frame that the
tracker does not believe stays near where it was bridged unless contact and its neighbours pull.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.camera.transforms import rigid
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.state import OBJECT, State
from intercap_core.rigid.twist import moved, twists

# The meshes differ from the things themselves: no track is surer than this.
_FLOOR = np.repeat([np.radians(0.1), 0.001], 3)
_BRIDGED = np.repeat([0.5, 0.15], 3)  # rad, metres
# Where poses apart explain a frame alike it is nearly always the turn (on which side a handle is).
_DOUBTFUL = np.repeat([np.radians(10.0), 0.002], 3)


@dataclass(frozen=True)
class TrackedPoses:
    """``rotation`` (T, 3, 3), ``translation`` (T, 3) and ``information`` (T, 6, 6), the inverse
    covariance of (turn on the left, shift).

    ``twist`` (T, 6) is the motion in a second, ``share`` (T, C) how far a pose rests on each camera
    and ``time_offset`` (C,) what the tracker took the cameras' to be, seconds.
    """

    rotation: np.ndarray
    translation: np.ndarray
    information: np.ndarray
    twist: np.ndarray
    share: np.ndarray
    time_offset: np.ndarray

    @classmethod
    def from_track(
        cls,
        rotation: np.ndarray,
        translation: np.ndarray,
        covariance: np.ndarray,
        lost: np.ndarray,
        doubtful: np.ndarray,
        resting: np.ndarray,
        *,
        seen: np.ndarray,
        times: np.ndarray,
        time_offset: np.ndarray,
    ) -> TrackedPoses:
        """Take over an object track whose lost frames are bridged; ``covariance`` (T, 6, 6),
        ``lost``, ``doubtful`` and ``resting`` (T,), ``seen`` (T, C) the views that show the object,
        ``times`` (T,) s."""
        known = ~lost & np.isfinite(covariance).all(axis=(1, 2))
        total = np.where(known[:, None, None], covariance, 0.0)
        floor = np.where(doubtful[:, None], np.hypot(_FLOOR, _DOUBTFUL), _FLOOR)
        total += np.eye(6) * np.where(known[:, None], floor, _BRIDGED)[:, None, :] ** 2
        twist = twists(rigid(rotation, translation), ~lost, times)
        twist[resting] = 0
        share = seen / np.maximum(seen.sum(axis=1, keepdims=True), 1)
        return cls(rotation, translation, np.linalg.inv(total), twist, share, time_offset)

    def at(self, time_offset: np.ndarray) -> TrackedPoses:
        """The poses had the cameras these offsets (C,): as much earlier as their views are later
        in the mean."""
        late = self.share @ (time_offset - self.time_offset)
        poses = moved(rigid(self.rotation, self.translation), -late[:, None] * self.twist)
        return replace(
            self, rotation=poses[:, :3, :3], translation=poses[:, :3, 3], time_offset=time_offset
        )

    def add(self, state: State, out: NormalEquations) -> None:
        """Add E_O at ``state``."""
        turn = Rotation.from_matrix(state.rotation @ self.rotation.transpose(0, 2, 1))
        away = np.concatenate([turn.as_rotvec(), state.translation - self.translation], axis=1)
        pull = np.einsum("tij,tj->ti", self.information, away)
        energy = 0.5 * float(np.einsum("ti,ti->", away, pull))
        out.add_blocks("object_data", OBJECT, self.information, pull, energy)
