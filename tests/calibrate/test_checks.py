"""Evidence that contradicts the poses, the board or the lens is refused or corrected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from intercap_core.calibrate.checks import check_agreement, check_gravity
from intercap_core.calibrate.evidence import CORNERS
from intercap_core.calibrate.found_rig import FoundRig, Residuals
from intercap_core.calibrate.lenses import estimate_lens
from intercap_core.calibrate.scale import check_board_size
from intercap_core.errors import UserError
from intercap_core.formats.calibration.boards import parse_board
from intercap_core.geometry.camera.transforms import apply, rigid, rotation_exp
from tests.calibrate.synthetic_views import board_poses_around, views_of_walker, with_board

BOARD = parse_board("checkerboard:3x4:0.1")


@pytest.mark.parametrize("kind", ["joints", "corners"])
def test_a_camera_whose_points_disagree_is_named(kind: str) -> None:
    rig, joints, _ = views_of_walker(4, 2)
    good, bad = np.array([3.0, 4.0, 3.5, 3.0]), np.array([3.0, 4.0, 3.5, 30.0])
    errors = (bad, good) if kind == "joints" else (good, bad)
    found = FoundRig(rig, np.zeros((4, 6, 4, 6)), Residuals(*errors, [], joints), *[good] * 3, "")
    with pytest.raises(UserError, match=rf"camera k4: its {kind} are 30.0 px"):
        check_agreement(found)
    found.residuals = Residuals(good, good, [], joints)
    check_agreement(found)


def test_a_gravity_sensor_that_contradicts_its_pose_is_named() -> None:
    rig, _, _ = views_of_walker(4, 2)
    down = np.array([0.0, 1.0, 0.0])  # of the master
    gravity = rig.master_from_colour[:, :3, :3].transpose(0, 2, 1) @ down
    check_gravity(rig, gravity)
    gravity[3] = np.nan
    check_gravity(rig, gravity)
    gravity[2] = rotation_exp(np.radians([[9.0, 0.0, 0.0]]))[0] @ gravity[2]
    with pytest.raises(UserError, match=r"camera k3: its gravity sensor .* by \d+ degrees"):
        check_gravity(rig, gravity)


def test_depth_contradicts_a_board_of_another_size() -> None:
    rig, joints, views = views_of_walker(4, 12)
    poses = board_poses_around(joints.mean((0, 1)), 12)
    views = with_board(views, rig, BOARD, poses)
    for t, pose in enumerate(poses):
        for c, camera in enumerate(rig):
            corners = apply(pose, BOARD.corners) - camera.master_from_colour[:3, 3]
            seen = np.isfinite(views.pixels[t, c, CORNERS, 0])
            views.distance[t, c, CORNERS] = np.where(seen, np.linalg.norm(corners, axis=1), np.nan)
    check_board_size(rig, views, BOARD)
    with pytest.raises(UserError, match=r"the board is 0\.80 times as large"):
        check_board_size(rig, views, parse_board("checkerboard:3x4:0.125"))


def test_a_wrong_stated_lens_is_replaced_and_a_right_one_kept() -> None:
    rig, _, views = views_of_walker(2, 40)
    rng = np.random.default_rng(11)
    turns = rotation_exp(rng.uniform(-0.5, 0.5, (40, 3)))
    places = rng.uniform((-0.7, -0.45, 0.7), (0.5, 0.25, 1.0), (40, 3))
    poses = np.stack([rigid(turn, place) for turn, place in zip(turns, places, strict=True)])
    views = with_board(views, rig, BOARD, poses, noise_px=0.2)  # close to the master
    true = rig[0].colour
    wrong = replace(true, fx=1.03 * true.fx, fy=1.03 * true.fy)
    found = estimate_lens(views, 0, BOARD, wrong, stated=True).lens
    assert abs(found.fx / true.fx - 1) < 0.005
    assert estimate_lens(views, 0, BOARD, true, stated=True).lens is true
