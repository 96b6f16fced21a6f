"""The person's bones as each camera shows them: at its own exposure, as uncertain as they are.

A fast forearm moves by centimetres between a set's time and a camera's exposure, and is known to
centimetres where few views agree: more than how uncertain its surface is.
"""

from __future__ import annotations

import numpy as np

from intercap_core.artefacts import Artefact
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.solve.velocity import limited_velocity
from intercap_core.person.segmentation.constants import (
    MAX_HAND_SPEED_M_S,
    MAX_KEYPOINT_GAP_S,
    UNTOLD_OFFSET_S,
)
from intercap_core.person.segmentation.person_volume import bones_of


class MovingPerson:
    """Keypoints over time; ``joints`` (T, K, 3), metres, short gaps filled, NaN = not known."""

    def __init__(
        self,
        joints: np.ndarray,
        sigma: np.ndarray,
        scene: Artefact,
        frame_from_master: np.ndarray | None = None,
    ) -> None:
        """Of ``joints`` (T, K, 3), master frame, at the times of the ``scene`` artefact.

        ``sigma`` (T, K) metres, what each is off by; in another frame where ``frame_from_master``
        (4, 4) is given.
        """
        times = scene["times"]
        if frame_from_master is not None:
            joints = apply(frame_from_master, joints.reshape(-1, 3)).reshape(joints.shape)
        self.joints = fill_short_gaps(joints, times, max_gap_s=MAX_KEYPOINT_GAP_S)
        self._sigma = np.nan_to_num(sigma)
        self._velocity = np.nan_to_num(
            limited_velocity(self.joints, times, max_speed=MAX_HAND_SPEED_M_S)
        )
        self._late = scene["time_offset"]
        self._late_sigma = np.nan_to_num(scene["time_offset_sigma"], nan=UNTOLD_OFFSET_S)

    def bones(self, t: int, c: int) -> np.ndarray:
        """Bones (B, 9) of :func:`bones_of` when camera c exposes the image of moment t."""
        off = self._late_sigma[c] * np.linalg.norm(self._velocity[t], axis=-1)
        joints = self.joints[t] + self._late[c] * self._velocity[t]
        return bones_of(joints, np.hypot(self._sigma[t], off))

    def bones_at(self, t: int) -> np.ndarray:
        """The same at the moment itself."""
        return bones_of(self.joints[t], self._sigma[t])


def fill_short_gaps(joints: np.ndarray, times: np.ndarray, *, max_gap_s: float) -> np.ndarray:
    """Keypoints (T, K, 3), NaN = not known, with short gaps filled by linear interpolation.

    A gap is filled up to ``max_gap_s`` from its nearest known time of ``times`` (T,) seconds; at
    the beginning and the end the nearest known place is held.
    """
    result = joints.copy()
    for k in range(joints.shape[1]):
        known = np.flatnonzero(np.isfinite(joints[:, k]).all(1))
        if not len(known):
            continue
        for t in np.flatnonzero(~np.isfinite(joints[:, k]).all(1)):
            after = int(np.searchsorted(known, t))
            around = known[max(after - 1, 0) : after + 1]
            if np.abs(times[around] - times[t]).min() > max_gap_s:
                continue
            result[t, k] = [
                np.interp(times[t], times[around], joints[around, k, i]) for i in range(3)
            ]
    return result
