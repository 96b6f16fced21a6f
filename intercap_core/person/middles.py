"""Neck and middle of the hips in space, where no two views show them or no detector gives them."""

from __future__ import annotations

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_NAMES

_INDEX = {name: index for index, name in enumerate(KEYPOINT_NAMES)}
# OpenPose learnt both points as these middles of COCO's.
_MIDDLES = tuple(
    (_INDEX[middle], [_INDEX[f"left_{end}"], _INDEX[f"right_{end}"]])
    for middle, end in (("neck", "shoulder"), ("mid_hip", "hip"))
)


def fill_middles(points: np.ndarray) -> None:
    """Fill in place what is NaN in ``points`` (..., 135, 3) from shoulders and hips, if known.

    Only in space, not in the images: the body's initial pose and its volume use them, while the
    fit, whose evidence is the keypoints in images, does not count the shoulders' and hips' errors
    twice.
    """
    for middle, ends in _MIDDLES:
        at = points[..., middle, :]
        at[...] = np.where(np.isnan(at), points[..., ends, :].mean(-2), at)
