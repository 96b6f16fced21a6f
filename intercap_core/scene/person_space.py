"""Which pixels of a depth image a person may be in, from the triangulated keypoints alone.

The depth of somebody who stands in one place for a whole recording is as constant as that of
furniture: only the keypoints tell them apart.
"""

from __future__ import annotations

import cv2
import numpy as np

from intercap_core.body.keypoints import LIMB_BONES, keypoint_pairs, of_side
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import apply
from intercap_core.scene.constants import LIMB_REACH_M, PERSON_MASK_REDUCTION, TRUNK_REACH_M

_BONES = (*TRUNK_REACH_M, *of_side("right", LIMB_BONES), *of_side("left", LIMB_BONES))
_FIRST, _SECOND = keypoint_pairs(_BONES).T
_REACH = np.array([*TRUNK_REACH_M.values(), *LIMB_REACH_M, *LIMB_REACH_M])


def person_pixels(
    depth: np.ndarray, lens: Intrinsics, depth_from_master: np.ndarray, joints: np.ndarray
) -> np.ndarray:
    """Tell for a depth image (H, W) uint16 mm which pixels (H, W) lie within a bone's reach.

    ``joints`` (K, 3): the keypoints of the 135-point order, at least the body's 25, master frame,
    metres, NaN = not known.
    """
    ends = [apply(depth_from_master, joints[index]) for index in (_FIRST, _SECOND)]
    known = np.isfinite(ends[0]).all(1) & np.isfinite(ends[1]).all(1)
    result = np.zeros(depth.shape, bool)
    if not known.any():
        return result
    start, along, reach = ends[0][known], (ends[1] - ends[0])[known], _REACH[known]
    small = np.s_[
        PERSON_MASK_REDUCTION // 2 :: PERSON_MASK_REDUCTION,
        PERSON_MASK_REDUCTION // 2 :: PERSON_MASK_REDUCTION,
    ]
    z = depth[small].astype(np.float64) * 1e-3
    points = np.dstack([lens.rays[small] * z[..., None], z])
    low = np.minimum(start, start + along).min(0) - reach.max()
    high = np.maximum(start, start + along).max(0) + reach.max()
    near = (z > 0) & ((points >= low) & (points <= high)).all(-1)
    chosen = points[near][:, None]
    length = np.maximum((along**2).sum(1), 1e-9)
    share = np.clip(((chosen - start) * along).sum(-1) / length, 0, 1)
    away = ((chosen - start - share[..., None] * along) ** 2).sum(-1)
    near[near] = (away < reach**2).any(1)
    size = (depth.shape[1], depth.shape[0])
    return cv2.resize(near.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
