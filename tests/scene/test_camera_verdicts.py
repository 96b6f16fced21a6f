"""Each camera's own verdict, and the direction in which it can slide."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import rigid
from intercap_core.scene.camera_verdicts import (
    HeldOutComparison,
    PoseVerdict,
    describe_direction,
    weakest_motion,
)

UP = np.array([0.0, 0.0, 1.0])
LEVEL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # looks along +x, its image is upright


def _evidence(*ratios: float) -> HeldOutComparison:
    return HeldOutComparison("background", np.log(ratios))


def test_camera_is_refined_only_if_significantly_better() -> None:
    assert PoseVerdict.of([_evidence(0.1, 0.2, 0.15)]).refined
    assert not PoseVerdict.of([_evidence(0.9, 1.1, 0.95, 1.0)]).refined
    # better on one kind, undecided on the other: both count the same, however many units one has
    assert PoseVerdict.of([_evidence(0.1, 0.1), _evidence(*[1.02] * 100)]).refined
    assert not PoseVerdict.of([_evidence(0.9, 0.9), _evidence(*[1.02] * 100)]).refined
    nothing = PoseVerdict.of([])
    assert nothing.refined and not nothing.doubtful and "no held-out data" in str(nothing)


def test_evidence_pairs_units_that_both_have() -> None:
    errors = {1: 2.0, 2: 4.0, 3: 1.0}, {1: 1.0, 2: 2.0, 4: 9.0}
    comparison = HeldOutComparison.of("keypoints", *errors)
    np.testing.assert_allclose(comparison.log_ratio, np.log([0.5, 0.5]))
    assert str(comparison) == "keypoints -50 %" and comparison.sigma > 0


def test_weakest_motion_matches_sampled_poses() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(7, 7)) * np.array([2e-3] * 3 + [4e-3] * 3 + [1e-3])
    covariance = root.T @ root
    pose, centre = rigid(LEVEL, np.array([-2.0, 0.5, 1.2])), np.array([0.1, 0.0, 0.9])
    sigma, way = weakest_motion(covariance, pose, centre)
    drawn = rng.multivariate_normal(np.zeros(7), covariance, 40000)
    arm = centre - pose[:3, 3]
    moved = Rotation.from_rotvec(drawn[:, :3]).apply(arm) - arm + drawn[:, 3:6]
    values, vectors = np.linalg.eigh(np.cov(moved.T))
    assert sigma == pytest.approx(np.sqrt(values[-1]), rel=0.03)
    assert abs(vectors[:, -1] @ way) > 0.99
    assert weakest_motion(np.zeros((7, 7)), pose, centre)[0] == 0.0


@pytest.mark.parametrize(
    ("direction", "words"),
    [
        ((0.0, 0.0, -1.0), "up and down"),
        ((-1.0, 0.0, 0.0), "along the floor, along its view"),
        ((0.0, 1.0, 0.1), "along the floor, across its view"),
        ((0.7, 0.7, 0.1), "along the floor, oblique to its view"),
        ((0.0, 0.7, 0.7), "oblique to the floor, across its view"),
    ],
)
def test_directions_are_named_as_the_camera_sees_them(
    direction: tuple[float, float, float], words: str
) -> None:
    unit = np.array(direction) / np.linalg.norm(direction)
    pose = rigid(Rotation.from_euler("y", 0.3).as_matrix() @ LEVEL, np.zeros(3))  # looks down a bit
    assert describe_direction(unit, pose, UP) == words
