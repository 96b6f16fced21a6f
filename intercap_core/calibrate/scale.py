"""Scale of a rig without depth and without a board: from the subject's height."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.body.loading import load_body_file

_SEGMENTS = [
    (f"{side}_{a}", f"{side}_{b}")
    for side in ("left", "right")
    for a, b in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
]
# Shoulders over ankles when the person is most upright, over its height in the body's T-pose. The
# relative error of the scale that remains: errors of the detector, and build. Both measured on
# recordings of the studio (config/rig) with a known height.
UPRIGHT, BUILD_SIGMA = 0.97, 0.025
HEIGHT_M, HEIGHT_SIGMA_M = 1.70, 0.095  # of adults of both sexes (NCD-RisC, eLife 2016), if unknown
STATED_SIGMA_M = 0.02  # of a stated height, as in the table of subjects


def scale_by_height(joints: np.ndarray, height_m: float | None) -> tuple[float, float]:
    """Metres for one unit of joints (T, K, 3), and the relative standard deviation.

    Two estimates are averaged, each by comparison with the open body scaled to the height: the
    median over the segments of the limbs, and the distance of the shoulders from the ankles.
    ``height_m`` None = unknown. NaN if no segment is known.
    """
    body = load_body_file(None, num_betas=0, num_expression=0)
    rest = body.joint_regressor @ body.template
    stature = float(np.ptp(body.template[:, 1]))

    def found(name: str) -> np.ndarray:
        return joints[:, KEYPOINT_INDEX[name]]

    def expected(name: str) -> np.ndarray:
        return rest[JOINT_INDEX[name]] / stature

    ratios = []
    for a, b in _SEGMENTS:
        length = np.linalg.norm(found(a) - found(b), axis=1)
        if np.isfinite(length).any():
            ratios.append(np.linalg.norm(expected(a) - expected(b)) / np.nanmedian(length))
    ways = [float(np.median(ratios))] if ratios else []

    def trunk(of: Callable[[str], np.ndarray]) -> np.ndarray:
        both = ("left", "right")
        return sum(of(f"{side}_shoulder") - of(f"{side}_ankle") for side in both) / 2

    long = np.linalg.norm(trunk(found), axis=1)
    known: np.ndarray = long[np.isfinite(long)]
    if len(known) >= 20:  # sets; the most upright of fewer may be a bent one
        upright = UPRIGHT * np.linalg.norm(trunk(expected))
        ways.append(float(upright / np.quantile(known, 0.98)))
    height = height_m or HEIGHT_M
    sigma = STATED_SIGMA_M if height_m else HEIGHT_SIGMA_M
    scale = float(np.mean(ways)) * height if ways else float("nan")
    return scale, float(np.hypot(BUILD_SIGMA, sigma / height))
