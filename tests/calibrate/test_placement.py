"""First poses of cameras: from joints with and without distances, lags, outliers; their scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.body.loading import load_body_file
from intercap_core.calibrate.adjust import JointTerm, adjust
from intercap_core.calibrate.evidence import JOINTS, NUM_JOINTS, Views
from intercap_core.calibrate.placement import Placement, place_all, reference_points
from intercap_core.calibrate.scale import scale_by_height
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import invert
from tests.calibrate.synthetic_views import views_of_walker
from tests.helpers.synthetic_capture import extrinsics_error


def improve(rig: Rig, views: Views, placed: Sequence[int]) -> Rig:
    joints = reference_points(rig, views, placed, None)[:, JOINTS]
    hidden = [c for c in range(len(rig)) if c not in placed]
    confidence = views.confidence.copy()
    confidence[:, hidden] = 0.0
    pixels = np.where(confidence[..., None] > 0, views.pixels, np.nan)
    term = JointTerm(rig, replace(views, pixels=pixels, confidence=confidence), joints)
    return rig.moved(adjust([term], rig.master_from_colour, placed[1:], steps=5)[0])


def place(
    rig: Rig, views: Views, max_lag: int = 1
) -> tuple[Rig, Views, list[int], list[Placement]]:
    """Placed cameras in the frame of the first one, as :func:`place_all`."""
    unknown = rig.moved(np.tile(np.eye(4), (len(rig), 1, 1)))
    found, views, placed, left = place_all(unknown, views, None, max_lag, improve)
    poses = found.master_from_colour
    return rig.moved(invert(poses[0]) @ poses), views, placed, left


def error_m(found: Rig, truth: Rig, joints: np.ndarray, *, scaled: bool = False) -> float:
    """Largest displacement of a cube at the joints' centre; ``scaled``: at the best scale."""
    poses, true = found.master_from_colour, truth.master_from_colour
    if scaled:
        poses = poses.copy()
        poses[:, :3, 3] *= (poses[:, :3, 3] * true[:, :3, 3]).sum() / (poses[:, :3, 3] ** 2).sum()
    return float(extrinsics_error(found.moved(poses), truth, joints.mean((0, 1))).max())


@pytest.mark.parametrize(("noise_px", "most_m"), [(0.0, 1e-3), (3.0, 0.02)])
def test_poses_follow_from_joints_up_to_scale(noise_px: float, most_m: float) -> None:
    rig, joints, views = views_of_walker(noise_px=noise_px)
    found, _, placed, _ = place(rig, views)
    assert sorted(placed) == [0, 1, 2, 3]
    assert error_m(found, rig, joints, scaled=True) < most_m


@pytest.mark.parametrize(("noise_px", "most_m"), [(0.0, 1e-3), (3.0, 0.02)])
def test_distances_give_the_scale(noise_px: float, most_m: float) -> None:
    rig, joints, views = views_of_walker(noise_px=noise_px, depth=True)
    found, _, placed, _ = place(rig, views)
    assert len(placed) == 4
    assert error_m(found, rig, joints) < most_m


@pytest.mark.parametrize("depth", [False, True])
def test_cameras_that_started_late_are_moved_in_time(depth: bool) -> None:
    rig, joints, views = views_of_walker(3, 50, noise_px=2.0, depth=depth)
    late = {1: 4, 2: -3}
    for camera, sets in late.items():
        views = views.late(camera, 0, -sets)
    found, _, placed, _ = place(rig, views, max_lag=6)
    assert len(placed) == 3
    assert error_m(found, rig, joints, scaled=not depth) < 0.02


def test_a_fifth_of_outliers_does_not_move_the_poses() -> None:
    rig, joints, views = views_of_walker(noise_px=2.0)
    rng = np.random.default_rng(7)
    wrong = rng.random(views.confidence.shape) < 0.2
    anywhere = rng.uniform(0, (1920, 1080), views.pixels.shape)
    pixels = np.where(wrong[..., None], anywhere, views.pixels)
    found, _, placed, _ = place(rig, replace(views, pixels=pixels))
    assert len(placed) == 4
    assert error_m(found, rig, joints, scaled=True) < 0.03


def test_cameras_without_a_common_view_are_left_out() -> None:
    """Two pairs of cameras that never see the person at the same time."""
    rig, _, views = views_of_walker(noise_px=1.0)
    half = len(views.times) // 2
    confidence = views.confidence.copy()
    confidence[half:, :2], confidence[:half, 2:] = 0.0, 0.0
    pixels = np.where(confidence[..., None] > 0, views.pixels, np.nan)
    _, _, placed, left = place(rig, replace(views, pixels=pixels, confidence=confidence))
    assert sorted(placed) in ([0, 1], [2, 3])
    assert not any(option.fits for option in left)


def test_the_open_body_has_scale_one() -> None:
    """Its own joints, upright in all sets, at its own stature."""
    body = load_body_file(None, num_betas=0, num_expression=0)
    rest = body.joint_regressor @ body.template
    joints = np.full((30, NUM_JOINTS, 3), np.nan)
    for k, name in enumerate(KEYPOINT_NAMES[:NUM_JOINTS]):
        if name in JOINT_INDEX:
            joints[:, k] = rest[JOINT_INDEX[name]]
    stature = float(np.ptp(body.template[:, 1]))
    scale, sigma = scale_by_height(2.0 * joints, stature)
    assert abs(2 * scale - 1) < 0.02 and sigma < 0.04
    assert scale_by_height(joints, None)[1] > sigma
    assert np.isnan(scale_by_height(np.full_like(joints, np.nan), 1.7)[0])
