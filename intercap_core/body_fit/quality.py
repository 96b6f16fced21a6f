"""Which parts of a fitted body are reliable: determined by observations and in line with them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import JOINT_INDEX, JOINT_NAMES
from intercap_core.body.keypoints import (
    CONTOUR,
    FACE,
    KEYPOINT_NAMES,
    LEFT_HAND,
    RIGHT_HAND,
)
from intercap_core.body_fit.constants import (
    DISAGREEING_SHARE,
    FACE_VISIBLE_SHARE,
    LARGEST_HAND_SIGMA_M,
    LARGEST_SIGMA_M,
    MEASURED_SHARE,
    MIRRORED_SIGMA_M,
    UNSEEN_SIGMA_M,
)
from intercap_core.schemas import BODY_PARTS

MEDIAN_CHI_3 = 1.5382  # median length of a three-dimensional normal error, in deviations
_MEDIAN_CHI_2 = 1.1774  # median length of a two-dimensional normal error, in deviations
_MEAN_CHI_3 = 1.5958  # mean length of a three-dimensional normal error, in deviations

_LIMBS = {"arm": ("elbow", "wrist"), "leg": ("knee", "ankle", "big_toe", "small_toe", "heel")}
_JOINTED = ("arm", "leg")
_TRUNK = ("neck", "left_shoulder", "right_shoulder", "mid_hip", "left_hip", "right_hip")
_JOINTS = {"arm": ("elbow", "wrist"), "leg": ("knee", "ankle", "foot")}
_TRUNK_JOINTS = ("pelvis", "left_hip", "right_hip", "spine2", "neck", "left_shoulder",
                 "right_shoulder", "head")  # fmt: skip


def _keypoints_of(part: str) -> np.ndarray:
    """(K,) indices of the part's keypoints."""
    side, _, limb = part.partition("_")
    if part == "trunk":
        return np.array([KEYPOINT_NAMES.index(name) for name in _TRUNK])
    if part == "face":
        return np.r_[FACE, CONTOUR]
    if limb == "hand":
        return np.r_[LEFT_HAND if side == "left" else RIGHT_HAND]
    return np.array([KEYPOINT_NAMES.index(f"{side}_{name}") for name in _LIMBS[limb]])


def _joints_of(part: str) -> list[int]:
    """Indices of the part's joints; of the face the head."""
    side, _, limb = part.partition("_")
    if part == "trunk":
        return [JOINT_INDEX[name] for name in _TRUNK_JOINTS]
    if part == "face":
        return [JOINT_INDEX["head"], JOINT_INDEX["jaw"]]
    if limb == "hand":
        first = JOINT_NAMES.index(f"{side}_index1")
        return list(range(first, first + 15))
    return [JOINT_INDEX[f"{side}_{name}"] for name in _JOINTS[limb]]


def _carriers_of(part: str) -> list[int]:
    """Joints whose bones carry the part's skin."""
    side, _, limb = part.partition("_")
    if limb == "hand":
        return [JOINT_INDEX[f"{side}_wrist"], *_joints_of(part)]
    bones = {"arm": ("shoulder", "elbow"), "leg": ("hip", "knee", "ankle", "foot")}
    if limb in bones:
        return [JOINT_INDEX[f"{side}_{name}"] for name in bones[limb]]
    return _joints_of(part)


class PartEvidence(NamedTuple):
    """How the observations of N frames support each of the 8 parts.

    against (N,8): share of a part's observations that are outliers, weighted by confidence, of arms
    and legs that of their worst point; NaN = nothing of it was seen. distance (N,8): their median
    distance, metres, NaN likewise. seen (N,8): share of a part's keypoints that some view bears
    out. views (N,8): how many do, in the median. measured (N,8): share of the part's samples that
    have points.
    """

    against: Tensor
    distance: Tensor
    seen: Tensor
    views: Tensor
    measured: Tensor


def compare(
    whitened: Tensor,
    confidence: Tensor,
    index: Tensor,
    sigma: Tensor,
    scale: float,
    samples: tuple[np.ndarray, Tensor] | None = None,
) -> PartEvidence:
    """Residuals (N,C,K), in sigmas (K,) metres, of the keypoints ``index`` (K,), part by part.

    confidence (N,C,K), 0 = not seen; what is more than ``scale`` sigmas off is an outlier.
    ``samples``: the joint (S,) that each of the cloud's samples hangs on and whether depth measured
    it (N,S) bool; None without clouds.
    """
    size = (len(whitened), len(BODY_PARTS))
    unknown, none = whitened.new_full(size, torch.nan), whitened.new_zeros(size)
    result = PartEvidence(unknown, unknown.clone(), none, none.clone(), none.clone())
    metres = torch.where(confidence > 0, whitened * sigma, torch.nan)
    for column, part in enumerate(BODY_PARTS):
        at = torch.isin(index, torch.as_tensor(_keypoints_of(part), device=index.device))
        if not bool(at.any()):
            continue
        weight, good = confidence[:, :, at], whitened[:, :, at] <= scale
        over = (1,) if part.endswith(_JOINTED) else (1, 2)
        share = 1 - (weight * good).sum(over) / weight.sum(over)
        # a correct elbow does not imply a correct wrist
        result.against[:, column] = share if share.ndim == 1 else _worst(share)
        result.distance[:, column] = metres[:, :, at].flatten(1).nanmedian(1).values
        inliers = ((weight > 0) & good).sum(1)
        result.seen[:, column] = (inliers > 0).to(weight).mean(1)
        result.views[:, column] = inliers.to(weight).median(1).values
        if samples is not None:
            on_part = np.isin(samples[0], _carriers_of(part))
            result.measured[:, column] = samples[1][:, on_part].to(weight).mean(1)
    return result


def _worst(share: Tensor) -> Tensor:
    """Largest (N,) of (N,K), NaN left out; NaN where all are."""
    largest = share.nan_to_num(nan=-1.0).amax(1)
    return torch.where(largest < 0, torch.nan, largest)


def trunk_distance(evidence: PartEvidence) -> np.ndarray:
    """Median distance (N,) of the trunk's keypoints, metres; NaN = none seen."""
    return evidence.distance[:, BODY_PARTS.index("trunk")].cpu().numpy()


def unmeasured(evidence: PartEvidence) -> np.ndarray:
    """Limbs and hands (N,8) bool that one view alone bears out, without points of theirs."""
    found = (evidence.views < 2) & (evidence.measured < MEASURED_SHARE) & (evidence.seen > 0)
    result = np.asarray(found.cpu().numpy())
    result[:, [BODY_PARTS.index(part) for part in ("trunk", "face")]] = False
    return result


def unmeasured_joints(evidence: PartEvidence) -> np.ndarray:
    """Joints (N,55) bool of those limbs and hands."""
    found = unmeasured(evidence)
    result = np.zeros((len(found), len(JOINT_NAMES)), bool)
    for column, part in enumerate(BODY_PARTS):
        result[:, _joints_of(part)] |= found[:, column, None]
    return result


def _leaning(evidence: PartEvidence) -> np.ndarray:
    """Standard deviation (N,8), metres, of parts that one view alone supports, whose mirrored pose
    is as likely, or that no view supports."""
    known = np.clip(evidence.measured.cpu().numpy() / MEASURED_SHARE, 0, 1)
    limbs = [part.partition("_")[2] for part in BODY_PARTS]
    mirrored = np.array([MIRRORED_SIGMA_M.get(limb, 0.0) for limb in limbs])
    unseen = np.array([UNSEEN_SIGMA_M.get(limb, 0.0) for limb in limbs])
    leaning = np.where(unmeasured(evidence), mirrored * (1 - known) ** 2, 0.0)
    return np.where(evidence.seen.cpu().numpy() == 0, unseen, leaning)


def widened_sigma(sigma: np.ndarray, evidence: PartEvidence) -> np.ndarray:
    """Deviations (N,55), metres, widened for parts whose fit is one of several minima.

    Where most observations contradict a part, the truth may be where they are: the deviation that
    corresponds to their distance, seen in two dimensions, is added in quadrature. A limb that one
    view alone sees may lean towards it or away, the more the fewer points it has. What is wrong of
    an arm is wrong of its hand.
    """
    disputed = evidence.against.cpu().numpy() > DISAGREEING_SHARE
    distance = np.where(disputed, np.nan_to_num(evidence.distance.cpu().numpy()), 0) / _MEDIAN_CHI_2
    distance = np.hypot(distance, _leaning(evidence))
    for side in ("left", "right"):
        arm, hand = BODY_PARTS.index(f"{side}_arm"), BODY_PARTS.index(f"{side}_hand")
        distance[:, hand] = np.maximum(distance[:, hand], distance[:, arm])
    result = sigma.copy()
    for column, part in enumerate(BODY_PARTS):
        joints = _joints_of(part)
        result[:, joints] = np.hypot(result[:, joints], distance[:, column, None])
    return result


def undetermined(sigma: np.ndarray, evidence: PartEvidence) -> np.ndarray:
    """Parts (N,8) bool that the observations do not determine, or that most of them contradict.

    sigma (N,55): stated deviation of the joints, metres.
    """
    found = evidence.against.cpu().numpy() > DISAGREEING_SHARE
    for column, part in enumerate(BODY_PARTS):
        limit = LARGEST_SIGMA_M
        if part.endswith("hand"):
            limit = LARGEST_HAND_SIGMA_M
            found[:, column] |= evidence.seen[:, column].cpu().numpy() == 0
        found[:, column] |= _rms(sigma[:, _joints_of(part)]) > limit
    face = BODY_PARTS.index("face")
    found[:, face] |= evidence.seen[:, face].cpu().numpy() < FACE_VISIBLE_SHARE
    return found


def expected_error(sigma: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Mean error (N,) of the surface that ``sigma`` (N,55) makes likely, metres.

    share (55,) of the surface that hangs on each joint.
    """
    return _MEAN_CHI_3 * sigma @ share


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(1))
