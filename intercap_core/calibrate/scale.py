"""Scale of a rig without depth and without a board: from the subject's height."""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.body.loading import load_body_file

# Segments between joints that detectors place well, and their share of the stature's variation:
# the length of a segment at a given stature differs by about 4 % between people (Winter,
# Biomechanics and Motor Control of Human Movement, anthropometry), and the segments of one person
# differ together, so their mean is known to 2.5 %.
_SEGMENTS = [
    (f"{side}_{a}", f"{side}_{b}")
    for side in ("left", "right")
    for a, b in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
]
BUILD_SIGMA = 0.025
HEIGHT_M, HEIGHT_SIGMA_M = 1.70, 0.095  # of adults of both sexes (NCD-RisC, eLife 2016), if unknown
STATED_SIGMA_M = 0.02  # of a stated height, as in the table of subjects


def scale_by_height(joints: np.ndarray, height_m: float | None) -> tuple[float, float]:
    """Metres for one unit of joints (T, K, 3), and the relative standard deviation.

    Segments of the limbs are compared with those of the open body, scaled to the height.
    ``height_m`` None = unknown. NaN if no segment is known.
    """
    body = load_body_file(None, num_betas=0, num_expression=0)
    rest = body.joint_regressor @ body.template
    stature = float(np.ptp(body.template[:, 1]))
    ratios = []
    for a, b in _SEGMENTS:
        found = np.linalg.norm(joints[:, KEYPOINT_INDEX[a]] - joints[:, KEYPOINT_INDEX[b]], axis=1)
        if np.isfinite(found).any():
            expected = np.linalg.norm(rest[JOINT_INDEX[a]] - rest[JOINT_INDEX[b]])
            ratios.append(float(expected) / stature / float(np.nanmedian(found)))
    height = height_m or HEIGHT_M
    sigma = STATED_SIGMA_M if height_m else HEIGHT_SIGMA_M
    scale = float(np.median(ratios)) * height if ratios else float("nan")
    return scale, float(np.hypot(BUILD_SIGMA, sigma / height))
