"""Errors of triangulated keypoints against the true joints: arrays in, numbers out, metres."""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import BODY, KEYPOINT_NAMES

# Keypoints that lie in a joint of the same name; those of the skin have no true joint.
JOINT_KEYPOINTS = tuple(k for k, name in enumerate(KEYPOINT_NAMES[BODY]) if name in JOINT_INDEX)
SIDED = tuple(k for k in JOINT_KEYPOINTS if KEYPOINT_NAMES[k].startswith(("left_", "right_")))


def keypoint_errors(points: np.ndarray, true_joints: np.ndarray) -> np.ndarray:
    """Distance (T, K) of ``JOINT_KEYPOINTS`` of (T, 135, 3) from the joints of (T, 55, 3).

    NaN where the keypoint is not known. It contains what detector and body model mean differently
    by one name, 10 to 20 mm.
    """
    true = true_joints[:, [JOINT_INDEX[KEYPOINT_NAMES[k]] for k in JOINT_KEYPOINTS]]
    return np.linalg.norm(points[:, list(JOINT_KEYPOINTS)] - true, axis=-1)


def sides_right(points: np.ndarray, true_joints: np.ndarray) -> np.ndarray:
    """Which of ``SIDED`` (T, S) are nearer to the joint of their own side than to the other's.

    ``points`` (T, 135, 3) and ``true_joints`` (T, 55, 3); true where the keypoint is not known.
    """
    own, other = (
        np.linalg.norm(
            points[:, list(SIDED)] - true_joints[:, [JOINT_INDEX[n] for n in names]], axis=-1
        )
        for names in (
            [KEYPOINT_NAMES[k] for k in SIDED],
            [_mirrored(KEYPOINT_NAMES[k]) for k in SIDED],
        )
    )
    return ~(own > other)


def _mirrored(name: str) -> str:
    side, _, part = name.partition("_")
    return f"{'right' if side == 'left' else 'left'}_{part}"
