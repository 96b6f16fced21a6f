"""Object poses for frames in which the object was lost: between its neighbours."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp


def bridge_poses(
    rotation: np.ndarray, translation: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (T, 3, 3) and translations (T, 3) with the frames that are not ``known`` (T,)
    filled in: shortest turn and straight line between known neighbours, held at the ends."""
    at = np.flatnonzero(known)
    if not len(at) or len(at) == len(known):
        return rotation, translation
    frames = np.clip(np.arange(len(known)), at[0], at[-1])
    moved = np.stack([np.interp(frames, at, translation[at, axis]) for axis in range(3)], axis=1)
    if len(at) == 1:
        turned = np.repeat(rotation[at], len(known), axis=0)
    else:
        turned = Slerp(at, Rotation.from_matrix(rotation[at]))(frames).as_matrix()
    turned[at], moved[at] = rotation[at], translation[at]
    return turned, moved
