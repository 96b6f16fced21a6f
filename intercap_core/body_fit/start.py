"""Where the fit of a frame starts: a rigid placement of the trunk, facing both ways."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.parameters import NUM_POSE
from intercap_core.body_fit.bridge import bridge
from intercap_core.body_fit.observations import TRUNK_KEYPOINTS


def place_trunk(rest: np.ndarray, joints: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
    """Rotation vectors and translations (T,6) that lay the rest body on triangulated keypoints.

    rest (K,3) keypoints of the rest pose, joints (T,K,3) with NaN = unknown, pelvis (3,) the rest
    pelvis, about which SMPL-X turns. Least squares over the trunk's known keypoints (Kabsch 1976).
    NaN where fewer than three are known.
    """
    trunk = list(TRUNK_KEYPOINTS)
    result = np.full((len(joints), 6), np.nan)
    for t, frame in enumerate(joints[:, trunk]):
        known = np.isfinite(frame).all(1)
        if known.sum() < 3:
            continue
        source, target = rest[trunk][known] - pelvis, frame[known]
        centre_s, centre_t = source.mean(0), target.mean(0)
        u, _, vt = np.linalg.svd((target - centre_t).T @ (source - centre_s))
        flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        rotation = u @ flip @ vt
        result[t, :3] = Rotation.from_matrix(rotation).as_rotvec()
        result[t, 3:] = centre_t - rotation @ centre_s - pelvis
    return result


def between(placement: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The same placements (N,6), at times (N,) s, with the unknown ones (NaN) filled in from those
    around. At least one is known."""
    known = np.isfinite(placement).all(1)
    vectors = np.zeros((len(placement), NUM_POSE + 3))
    vectors[:, :3], vectors[:, NUM_POSE:] = placement[:, :3], placement[:, 3:]
    filled = bridge(np.nan_to_num(vectors), known, times)
    return np.hstack([filled[:, :3], filled[:, NUM_POSE:]])


def turned_around(placement: np.ndarray) -> np.ndarray:
    """The same placements (T,6) with the body facing the other way (half a turn about its y)."""
    result = placement.copy()
    known = np.isfinite(placement).all(1)
    turn = Rotation.from_rotvec([0.0, np.pi, 0.0])
    result[known, :3] = (Rotation.from_rotvec(placement[known, :3]) * turn).as_rotvec()
    return result
