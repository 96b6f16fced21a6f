"""The unit of depth is compared with the triangulated person."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.scene.depth_scale import depth_ratios, describe_factor

LENS = Intrinsics(160, 120, 120.0, 120.0, 79.5, 59.5)
CAMERA = Camera("k1", LENS, LENS, np.eye(4), np.eye(4))


def body_and_depth(unit_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """25 joints on a slab of 0.3 x 1.4 m at 2.6 m, 5 cm below its surface; a wall at 4.5 m."""
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, 5), np.linspace(-0.6, 0.6, 5))
    joints = np.stack([x, y, np.full_like(x, 2.65)], -1).reshape(-1, 3)
    depth_mm = np.full((120, 160), 4500.0)
    rays = LENS.rays * 2.6
    depth_mm[(np.abs(rays[..., 0]) < 0.15) & (np.abs(rays[..., 1]) < 0.7)] = 2600
    return joints, np.rint(depth_mm / unit_mm).astype(np.uint16)


@pytest.mark.parametrize(
    ("unit_mm", "expected"),
    [
        (1, ""), (0.5, "is 2 times"), (0.25, "is 4 times"), (0.2, "is 5 times"),
        (0.1, "is 10 times"), (2, "is 0.5 times"), (10, "is 0.1 times"), (1000, "is 0.001 times"),
    ],
)  # fmt: skip
def test_the_unit_is_named(unit_mm, expected):
    joints, depth = body_and_depth(unit_mm)
    ratios = depth_ratios(depth, CAMERA, joints)
    assert len(ratios) == 25 and np.allclose(ratios * unit_mm, 2.6 / 2.65, rtol=0.2)
    note = describe_factor(ratios)
    assert expected in note and bool(expected) == bool(note)
    assert ("depth_unit" in note) == ("calibration_scale" in note) == bool(note)


@pytest.mark.parametrize(
    ("elsewhere", "words"),
    [(0.4, "is 2 or 5 times"), (0.49, "is 5 times"), (1.95, "is 5 or 10 times")],
)
def test_an_object_or_a_wall_at_most_points_is_no_unit(elsewhere, words):
    ratios = np.r_[np.full(75, elsewhere), np.full(25, 0.98)]
    assert describe_factor(ratios) == ""
    assert words in describe_factor(5 * ratios)


@pytest.mark.parametrize("ratios", [[], [0.98] * 11, [3.0] * 100, [0.98, *[3.0] * 99]])
def test_the_unit_is_not_determined_without_points_on_the_body(ratios):
    assert "not determined" in describe_factor(np.array(ratios))


def test_unknown_joints_and_pixels_without_depth_are_left_out():
    joints, depth = body_and_depth(1)
    joints[:20] = np.nan
    depth[:, :80] = 0
    assert len(depth_ratios(depth, CAMERA, joints)) < 5
