"""Parts of a body that the observations do not determine."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.body_fit import quality
from intercap_core.geometry.solve.robust import OUTLIER_SIGMAS
from intercap_core.schemas import BODY_PARTS

ALL = torch.arange(135)
LEG = ("knee", "ankle", "toe", "heel")
SIGMA = torch.full((135,), 0.02)


def _evidence(whitened: torch.Tensor, confidence: torch.Tensor) -> quality.PartEvidence:
    return quality.compare_parts(whitened, confidence, ALL, SIGMA)


def _undetermined(evidence: quality.PartEvidence, sigma: np.ndarray) -> list[str]:
    found = quality.flag_undetermined(sigma, evidence)
    return [part for part, at in zip(BODY_PARTS, found[0], strict=True) if at]


@pytest.fixture
def fine() -> tuple[torch.Tensor, torch.Tensor, np.ndarray]:
    """Residuals and confidences (1,4,135) of a good fit, and deviations (1,55)."""
    return torch.full((1, 4, 135), 0.7), torch.full((1, 4, 135), 0.8), np.full((1, 55), 0.008)


def test_a_good_fit_has_no_undetermined_part(fine):
    whitened, confidence, sigma = fine
    evidence = _evidence(whitened, confidence)
    assert _undetermined(evidence, sigma) == []
    assert torch.equal(evidence.outlier_share, torch.zeros(1, 8))
    assert torch.equal(evidence.visible_share, torch.ones(1, 8))
    assert quality.trunk_distance(evidence) == pytest.approx(0.014)
    np.testing.assert_array_equal(quality.widen_sigma(sigma, evidence), sigma)


def test_a_wrist_that_most_views_contradict(fine):
    """The elbow is right; the wrist is 8 sigmas, 160 mm, off in three of four views."""
    whitened, confidence, sigma = fine
    whitened[:, :3, KEYPOINT_NAMES.index("left_wrist")] = 8.0
    evidence = _evidence(whitened, confidence)
    assert _undetermined(evidence, sigma) == ["left_arm"]
    confidence[:, :3, KEYPOINT_NAMES.index("left_wrist")] = 0.2  # less than the fourth alone
    assert _undetermined(_evidence(whitened, confidence), sigma) == []


def test_a_contradicted_hand_is_widened_by_its_distance(fine):
    whitened, confidence, sigma = fine
    whitened[:, :, 46:67] = 10.0
    evidence = _evidence(whitened, confidence)
    widened = quality.widen_sigma(sigma, evidence)
    right = JOINT_INDEX["right_index1"]
    assert widened[0, right] == pytest.approx(np.hypot(0.008, 0.2 / 1.1774))
    assert widened[0, JOINT_INDEX["left_index1"]] == 0.008
    assert _undetermined(evidence, widened) == ["right_hand"]


def test_views_that_agree_on_another_wrist_widen_arm_and_hand(fine):
    """Half of the views are 3 sigmas off: no outliers, and the median of all keypoints is small."""
    whitened, confidence, _ = fine
    whitened[:, :2, [KEYPOINT_NAMES.index(f"left_{name}") for name in ("elbow", "wrist")]] = 3.0
    excess = quality.joint_excess(_evidence(whitened, confidence))[0]
    for name in ("left_elbow", "left_wrist", "left_index1"):
        assert excess[JOINT_INDEX[name]] == pytest.approx((3.0**2 + 0.7**2) / 4)
    for name in ("right_wrist", "right_index1", "spine1", "left_knee", "head"):
        assert excess[JOINT_INDEX[name]] == 1


def test_one_wrong_view_of_four_counts_as_far_as_the_scale_of_outliers(fine):
    whitened, confidence, _ = fine
    whitened[:, 0, KEYPOINT_NAMES.index("left_wrist")] = 100.0
    excess = quality.joint_excess(_evidence(whitened, confidence))[0, JOINT_INDEX["left_wrist"]]
    assert excess == pytest.approx((OUTLIER_SIGMAS**2 + 7 * 0.7**2) / 16)


def test_unseen_parts_are_undetermined_by_their_deviation(fine):
    whitened, confidence, sigma = fine
    confidence[:, :, 67:] = 0
    assert _undetermined(_evidence(whitened, confidence), sigma) == ["face"]
    confidence[:] = 0
    evidence = _evidence(whitened, confidence)
    assert (
        torch.isnan(evidence.outlier_share).all()
        and np.isnan(quality.trunk_distance(evidence)).all()
    )
    sigma[0, [JOINT_INDEX["right_knee"], JOINT_INDEX["right_ankle"]]] = 0.09
    assert _undetermined(evidence, sigma) == ["right_leg", "left_hand", "right_hand", "face"]


def test_unseen_limbs_may_be_anywhere_in_their_reach(fine):
    """With points or without; an arm and two legs make a bad body likely."""
    whitened, confidence, sigma = fine
    share = np.ones(55) / 55
    forearm = [KEYPOINT_NAMES.index(f"left_{name}") for name in ("elbow", "wrist")]
    confidence[:, :, forearm] = 0
    widened = quality.widen_sigma(sigma, _evidence(whitened, confidence))
    assert widened[0, JOINT_INDEX["left_wrist"]] > 0.2
    assert widened[0, JOINT_INDEX["right_wrist"]] == 0.008
    joints = np.arange(55)
    legs = [k for k, name in enumerate(KEYPOINT_NAMES[:25]) if name.split("_")[-1] in LEG]
    confidence[:, :, legs] = 0
    points = (joints, torch.ones(1, 55, dtype=torch.bool))
    evidence = quality.compare_parts(whitened, confidence, ALL, SIGMA, points)
    widened = quality.widen_sigma(sigma, evidence)
    assert set(_undetermined(evidence, widened)) >= {"left_arm", "left_leg", "right_leg"}
    assert quality.expected_error(widened, share)[0] > 0.04


def test_each_depth_point_narrows_a_limb_that_one_view_sees(fine):
    whitened, confidence, sigma = fine
    confidence[:, 1:] = 0
    joints, wrist = np.array([JOINT_INDEX["left_elbow"]] * 100), JOINT_INDEX["left_wrist"]
    stated = []
    for points in (0, 2, 5, 10, 16):
        measured = torch.arange(100)[None] < points
        evidence = quality.compare_parts(whitened, confidence, ALL, SIGMA, (joints, measured))
        stated.append(quality.widen_sigma(sigma, evidence)[0, wrist])
        flags = quality.flag_unmeasured(evidence)[0]
        assert flags[BODY_PARTS.index("left_arm")] == (points < 15)
        assert not flags[BODY_PARTS.index("trunk")]
        assert quality.flag_unmeasured_joints(evidence)[0, wrist] == (points < 15)
    assert stated[0] > 0.1 and stated[-1] == 0.008
    assert (np.diff(stated) < 0).all()


def test_expected_error_is_the_mean_of_normal_errors():
    random = np.random.default_rng(0)
    errors = np.linalg.norm(random.normal(0, 0.03, (200_000, 3)), axis=1)
    share = np.full(55, 1 / 55)
    expected = quality.expected_error(np.full((1, 55), 0.03), share)
    assert expected == pytest.approx(errors.mean(), rel=0.01)
