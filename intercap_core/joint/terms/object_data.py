"""Object data: E_O of equation 6, the images' evidence on the object's pose in every frame.

The tracker ends at the minimum of equation 1, and its covariance gives the energy's curvature
there. E_O is taken as the quadratic form of the two,

    E_O = d^T C^-1 d / 2,    d = offset (turn, shift) from the tracked pose, C its covariance,

so the joint fit need not compare images again. What other possible poses add to a covariance is
left out: between two of them the images support nothing. A frame in which the object is lost has a
wide C: it stays near the interpolated pose unless contact or its neighbours move it; one whose pose
follows from annotated ones has theirs. No setting
weighs E_O: its strength is the covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.twist import moved, twists
from intercap_core.joint.constants import (
    AMBIGUOUS_SHIFT,
    AMBIGUOUS_TURN,
    BRIDGED_OBJECT_SHIFT,
    BRIDGED_OBJECT_TURN,
    TRACK_FLOOR_SHIFT,
    TRACK_FLOOR_TURN,
)
from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.state import OBJECT, State
from intercap_core.joint.terms.term import Term

# Standard deviations (6,) of turn and shift, rad and metres.
_FLOOR = np.repeat([TRACK_FLOOR_TURN, TRACK_FLOOR_SHIFT], 3)
_BRIDGED = np.repeat([BRIDGED_OBJECT_TURN, BRIDGED_OBJECT_SHIFT], 3)
_AMBIGUOUS = np.repeat([AMBIGUOUS_TURN, AMBIGUOUS_SHIFT], 3)


@dataclass(frozen=True)
class TrackedPoses:
    """``rotation`` (T, 3, 3), ``translation`` (T, 3) and ``information`` (T, 6, 6), the inverse
    covariance of (turn on the left, shift).

    ``twist`` (T, 6) is the motion in a second, ``share`` (T, C) each camera's part in the evidence
    for a pose and ``time_offset`` (C,) what the tracker took the cameras' to be, seconds. Frames
    (T,) that are ``seen`` and in which it is ``resting``, their ``times``, seconds; ``spread``
    (T, 6) the variance of a pose, beside what the images of a frame leave open.
    """

    rotation: np.ndarray
    translation: np.ndarray
    information: np.ndarray
    twist: np.ndarray
    share: np.ndarray
    time_offset: np.ndarray
    seen: np.ndarray
    resting: np.ndarray
    times: np.ndarray
    spread: np.ndarray

    @classmethod
    def from_track(
        cls,
        rotation: np.ndarray,
        translation: np.ndarray,
        covariance: np.ndarray,
        lost: np.ndarray,
        ambiguous: np.ndarray,
        resting: np.ndarray,
        *,
        carried: np.ndarray,
        visible: np.ndarray,
        times: np.ndarray,
        time_offset: np.ndarray,
    ) -> TrackedPoses:
        """Take over an object track whose lost frames are interpolated.

        ``covariance`` (T, 6, 6) around these poses alone; ``lost``, ``ambiguous``, ``resting`` and
        ``carried`` (T,), of which the images show nothing; ``visible`` (T, C) the views that show
        the object; ``times`` (T,) and ``time_offset`` (C,) seconds.
        """
        tracked = ~lost & np.isfinite(covariance).all(axis=(1, 2))
        total = np.where(tracked[:, None, None], covariance, 0.0)
        other = (ambiguous & ~carried)[:, None]  # of what is carried, the covariance says it
        floor = np.where(other, np.hypot(_FLOOR, _AMBIGUOUS), _FLOOR)
        spread = np.where(tracked[:, None], floor, _BRIDGED) ** 2
        total += np.eye(6) * spread[:, None, :]
        twist = twists(rigid(rotation, translation), ~lost, times)
        twist[resting] = 0
        share = visible / np.maximum(visible.sum(axis=1, keepdims=True), 1)
        return cls(
            rotation,
            translation,
            np.linalg.inv(total),
            twist,
            share,
            time_offset,
            tracked & ~carried,
            resting,
            times,
            spread,
        )

    def at(self, time_offset: np.ndarray) -> TrackedPoses:
        """The poses if the cameras had these offsets (C,), seconds: earlier by the mean change of
        the views that show the object."""
        late = self.share @ (time_offset - self.time_offset)
        poses = moved(rigid(self.rotation, self.translation), -late[:, None] * self.twist)
        return replace(
            self, rotation=poses[:, :3, :3], translation=poses[:, :3, 3], time_offset=time_offset
        )


class ObjectData(Term):
    """E_O about tracked poses, for the cameras' time offsets that were taken last."""

    name = "object_data"

    def __init__(self, tracked: TrackedPoses) -> None:
        self._tracked = self._poses = tracked

    def take_offsets(self, time_offset: np.ndarray) -> None:
        """Compare with the poses that offsets (C,), seconds, give from now on."""
        self._poses = self._tracked.at(time_offset)

    def add(self, state: State, equations: NormalEquations) -> None:
        """Add E_O at ``state``."""
        equations.add_blocks(self.name, OBJECT, *self._equations(self._poses.information, state))

    def of_views(self, used: np.ndarray, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """E_O's matrix (T, 6, 6), gradient (T, 6) and energy (T,) at ``state``, by the share of the
        evidence that the views ``used`` (T, C) have."""
        seen = self._poses.share.sum(axis=1) > 0
        kept = np.where(seen, (self._poses.share * used).sum(axis=1), 1.0)
        return self._equations(kept[:, None, None] * self._poses.information, state)

    def _equations(
        self, information: np.ndarray, state: State
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        poses = self._poses
        turn = Rotation.from_matrix(state.rotation @ poses.rotation.transpose(0, 2, 1))
        offset = np.concatenate([turn.as_rotvec(), state.translation - poses.translation], axis=1)
        gradient = np.einsum("tij,tj->ti", information, offset)
        return information, gradient, 0.5 * (offset * gradient).sum(axis=1)
