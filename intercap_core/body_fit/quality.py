"""Reliability of the parts of a fitted body.

A part (`BODY_PARTS`: trunk, face, and left and right arm, leg and hand) is undetermined if its
standard deviation is large or if most of its observations are outliers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import JOINT_INDEX, JOINT_NAMES
from intercap_core.body.keypoints import CONTOUR, FACE, KEYPOINT_NAMES, LEFT_HAND, RIGHT_HAND
from intercap_core.geometry.solve.robust import MEDIAN_CHI_3, OUTLIER_SIGMAS
from intercap_core.schemas import BAD_BODY_M, BODY_PARTS

# Standard deviation along one coordinate beyond which a part is undetermined, metres: half of its
# joints then have errors above that of a bad body.
LARGEST_SIGMA_M = BAD_BODY_M / MEDIAN_CHI_3
# The same for hands: half of the joints have errors above 20 mm, the distance between fingers
# (anatomy).
LARGEST_HAND_SIGMA_M = 0.013
# Smallest share of a part's skin samples with depth points at which depth determines the part. One
# view sees a third of a limb; this is about half of it. Tuned on the studio.
_MEASURED_SHARE = 0.15
# A limb in a single view without depth may lean towards the camera or away from it: both poses have
# the same image. The end of a forearm differs by up to 2 x 0.25 m between them, that of a leg's
# segment by 2 x 0.4 m, of a finger by 2 x 0.08 m (anatomy). These are the standard deviations along
# one coordinate, metres; estimated, not measured.
MIRRORED_SIGMA_M = {"arm": 0.10, "leg": 0.15, "hand": 0.03}
# Standard deviation along one coordinate of a limb that no view supports, metres. It may be
# anywhere within its reach: a wrist is up to 0.55 m from the shoulder, an ankle up to 0.85 m from
# the hip, a finger up to 0.08 m from the middle of its range (anatomy). The linearised covariance
# of prior and fit is smaller.
UNSEEN_SIGMA_M = {"arm": 0.20, "leg": 0.25, "hand": 0.035}


class _Part(NamedTuple):
    """A part of the body."""

    keypoints: list[int]
    """Indices among the 135 keypoints."""
    joints: list[int]
    """Indices among the 55 joints."""
    carriers: list[int]
    """Joints whose bones carry the skin of the part."""


def _find_part(name: str) -> _Part:
    """Return the keypoints and joints of one of `BODY_PARTS`; joints of the face: head, jaw."""
    side, _, limb = name.partition("_")
    if limb == "hand":
        first = JOINT_INDEX[f"{side}_index1"]
        fingers = list(range(first, first + 15))
        keypoints = LEFT_HAND if side == "left" else RIGHT_HAND
        return _Part(np.r_[keypoints].tolist(), fingers, [JOINT_INDEX[f"{side}_wrist"], *fingers])
    if name == "face":
        head = [JOINT_INDEX["head"], JOINT_INDEX["jaw"]]
        return _Part(np.r_[FACE, CONTOUR].tolist(), head, head)
    points, joints, carriers = {
        "trunk": (
            "neck left_shoulder right_shoulder mid_hip left_hip right_hip",
            "pelvis left_hip right_hip spine2 neck left_shoulder right_shoulder head",
            "pelvis left_hip right_hip spine2 neck left_shoulder right_shoulder head",
        ),
        "arm": ("elbow wrist", "elbow wrist", "shoulder elbow"),
        "leg": (
            "knee ankle big_toe small_toe heel", "knee ankle foot", "hip knee ankle foot"
        ),
    }[limb or name]  # fmt: skip
    prefix = f"{side}_" if limb else ""
    return _Part(
        [KEYPOINT_NAMES.index(prefix + point) for point in points.split()],
        [JOINT_INDEX[prefix + joint] for joint in joints.split()],
        [JOINT_INDEX[prefix + joint] for joint in carriers.split()],
    )


_PARTS = {name: _find_part(name) for name in BODY_PARTS}


class PartEvidence(NamedTuple):
    """Support of each of the 8 `BODY_PARTS` by the observations of N frames."""

    outlier_share: Tensor
    """(N, 8) share of outliers among the detections of the part's keypoints, weighted by
    confidence; for arms and legs that of the worst keypoint. NaN = no detection."""
    distance: Tensor
    """(N, 8) median distance of the detections from the fit, metres, NaN = no detection."""
    visible_share: Tensor
    """(N, 8) share of the part's keypoints that are inliers in at least one view."""
    views: Tensor
    """(N, 8) number of views in which a keypoint is an inlier, median over the keypoints."""
    measured_share: Tensor
    """(N, 8) share of the part's skin samples with depth points."""
    excess: Tensor
    """(N, 8) mean square residual of the part's detections over its assumed variance, weighted by
    confidence, at least 1. Outliers count up to `OUTLIER_SIGMAS`: views may agree on a wrong point,
    and those that contradict it may be right."""


def compare_parts(
    whitened: Tensor,
    confidence: Tensor,
    index: Tensor,
    sigma: Tensor,
    samples: tuple[np.ndarray, Tensor] | None = None,
) -> PartEvidence:
    """Summarise the residuals of keypoints by part.

    Args:
        whitened: (N, C, K) residuals in standard deviations.
        confidence: (N, C, K), 0 = not detected.
        index: (K,) index of each keypoint among the 135.
        sigma: (K,) standard deviation of each keypoint, metres.
        samples: joint (S,) of each sample of the cloud, and whether depth measured it (N, S) bool;
            None without clouds.
    """
    size = (len(whitened), len(BODY_PARTS))
    unknown, none = whitened.new_full(size, torch.nan), whitened.new_zeros(size)
    result = PartEvidence(unknown, unknown.clone(), none, none.clone(), none.clone(), none + 1)
    square = whitened.clamp(max=OUTLIER_SIGMAS) ** 2 / 2
    metres = torch.where(confidence > 0, whitened * sigma, torch.nan)
    for column, part in enumerate(BODY_PARTS):
        at = torch.isin(index, torch.as_tensor(_PARTS[part].keypoints))
        if not bool(at.any()):
            continue
        weight, good = confidence[:, :, at], whitened[:, :, at] <= OUTLIER_SIGMAS
        # axes of the sums: views, and keypoints except for arms and legs
        over = (1,) if part.endswith(("arm", "leg")) else (1, 2)
        share = 1 - (weight * good).sum(over) / weight.sum(over)
        # a correct elbow does not imply a correct wrist
        result.outlier_share[:, column] = share if share.ndim == 1 else _worst(share)
        result.distance[:, column] = metres[:, :, at].flatten(1).nanmedian(1).values
        mean_square = (weight * square[:, :, at]).sum((1, 2)) / weight.sum((1, 2))
        result.excess[:, column] = mean_square.nan_to_num(nan=1.0).clamp_min(1.0)
        inliers = ((weight > 0) & good).sum(1)
        result.visible_share[:, column] = (inliers > 0).to(weight).mean(1)
        result.views[:, column] = inliers.to(weight).median(1).values
        if samples is not None:
            on_part = np.isin(samples[0], _PARTS[part].carriers)
            result.measured_share[:, column] = samples[1][:, on_part].to(weight).mean(1)
    return result


def joint_excess(evidence: PartEvidence) -> Tensor:
    """Return the excess (N, 55) of each joint's part; that of the trunk for other joints.

    A hand has at least the excess of its arm.
    """
    excess = dict(zip(BODY_PARTS, evidence.excess.unbind(1), strict=True))
    result = excess["trunk"][:, None].repeat(1, len(JOINT_NAMES))
    for part, own in excess.items():
        side, _, limb = part.partition("_")
        larger = torch.maximum(own, excess[f"{side}_arm"]) if limb == "hand" else own
        result[:, _PARTS[part].joints] = larger[:, None]
    return result


def _worst(share: Tensor) -> Tensor:
    """Return the largest (N,) of (N, K), ignoring NaN; NaN if all are."""
    largest = share.nan_to_num(nan=-1.0).amax(1)
    return torch.where(largest < 0, torch.nan, largest)


def trunk_distance(evidence: PartEvidence) -> np.ndarray:
    """Return the median distance (N,) of the trunk's keypoints, metres; NaN = none visible."""
    return evidence.distance[:, BODY_PARTS.index("trunk")].numpy()


def flag_unmeasured(evidence: PartEvidence) -> np.ndarray:
    """Flag limbs and hands (N, 8) that a single view supports, with few depth points or none."""
    flags = (evidence.views < 2) & (evidence.visible_share > 0)
    result = np.asarray((flags & (_measured(evidence) < 1)).numpy())
    result[:, [BODY_PARTS.index(part) for part in ("trunk", "face")]] = False
    return result


def _measured(evidence: PartEvidence) -> Tensor:
    """Share (N, 8) to which depth determines each part; 0 for hands.

    Depth does not tell where the fingers of a hand point.
    """
    share = (evidence.measured_share / _MEASURED_SHARE).clamp(0, 1)
    share[:, [BODY_PARTS.index("left_hand"), BODY_PARTS.index("right_hand")]] = 0
    return share


def flag_unmeasured_joints(evidence: PartEvidence) -> np.ndarray:
    """Flag the joints (N, 55) of the parts of :func:`flag_unmeasured`."""
    flags = flag_unmeasured(evidence)
    result = np.zeros((len(flags), len(JOINT_NAMES)), bool)
    for column, part in enumerate(BODY_PARTS):
        result[:, _PARTS[part].joints] |= flags[:, column, None]
    return result


def _leaning(evidence: PartEvidence) -> np.ndarray:
    """Return the standard deviation (N, 8), metres, of parts that one view or no view supports.

    In one view, the pose mirrored in depth is as likely: `MIRRORED_SIGMA_M`, reduced by depth
    points. In no view it is `UNSEEN_SIGMA_M`. For other parts it is 0.
    """
    known = _measured(evidence).numpy()
    limbs = [part.partition("_")[2] for part in BODY_PARTS]
    mirrored = np.array([MIRRORED_SIGMA_M.get(limb, 0.0) for limb in limbs])
    unseen = np.array([UNSEEN_SIGMA_M.get(limb, 0.0) for limb in limbs])
    leaning = np.where(flag_unmeasured(evidence), mirrored * (1 - known) ** 2, 0.0)
    return np.where(evidence.visible_share.numpy() == 0, unseen, leaning)


def widen_sigma(sigma: np.ndarray, evidence: PartEvidence) -> np.ndarray:
    """Return standard deviations (N, 55), metres, that allow for fits in a wrong local minimum.

    The larger of two deviations is added to ``sigma`` (N, 55) in quadrature:
    - of a part whose detections are mostly outliers: their median distance, as a deviation;
    - of a limb that one view or no view supports: the possible lean (`_leaning`).
    A hand has at least the added deviation of its arm.
    """
    # the median length of a normal error in two dimensions is 1.1774 standard deviations
    disputed = evidence.outlier_share.numpy() > 0.5
    distance = np.where(disputed, np.nan_to_num(evidence.distance.numpy()), 0) / 1.1774
    distance = np.maximum(distance, _leaning(evidence))
    for side in ("left", "right"):
        arm, hand = BODY_PARTS.index(f"{side}_arm"), BODY_PARTS.index(f"{side}_hand")
        distance[:, hand] = np.maximum(distance[:, hand], distance[:, arm])
    result = sigma.copy()
    for column, part in enumerate(BODY_PARTS):
        joints = _PARTS[part].joints
        result[:, joints] = np.hypot(result[:, joints], distance[:, column, None])
    return result


def flag_undetermined(sigma: np.ndarray, evidence: PartEvidence) -> np.ndarray:
    """Flag parts (N, 8) that the observations do not determine, or that most of them contradict.

    sigma (N, 55): standard deviation of the joints, metres.
    """
    flags = evidence.outlier_share.numpy() > 0.5
    for column, part in enumerate(BODY_PARTS):
        limit = LARGEST_SIGMA_M
        if part.endswith("hand"):
            limit = LARGEST_HAND_SIGMA_M
            flags[:, column] |= evidence.visible_share[:, column].numpy() == 0
        flags[:, column] |= _rms(sigma[:, _PARTS[part].joints]) > limit
    face = BODY_PARTS.index("face")
    flags[:, face] |= evidence.visible_share[:, face].numpy() < 0.5  # tuned on the studio
    return flags


def expected_error(sigma: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return the expected mean error (N,) of the surface for ``sigma`` (N, 55), metres.

    share (55,): share of the surface that follows each joint.
    """
    # 1.5958 = sqrt(8 / pi): mean length of a normal error in three dimensions, in sigmas
    return 1.5958 * sigma @ share


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(1))
