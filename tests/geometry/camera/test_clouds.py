"""Depth to points and to colour pixels, on scenes whose answer is known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from intercap_core.geometry.camera.clouds import colour_lookup, depth_points, master_points
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply, invert, rigid
from tests.geometry.camera.test_projection import COLOUR, DEPTH
from tests.helpers.synthetic_capture import FURNITURE, ring, room_depth


def rotation_x(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


CAMERA = Camera(
    "k2",
    COLOUR,
    DEPTH,
    rigid(rotation_x(-0.1), np.array([-0.032, -0.002, 0.004])),
    rigid(rotation_x(0.4), np.array([1.0, -0.5, 0.25])),
)
WALL_M, PANEL_M, PANEL_HALF_M = 3.0, 1.0, 0.15


def wall_with_panel() -> np.ndarray:
    """A wall at 3 m behind a square panel at 1 m, both across the depth camera's axis; mm."""
    depth = np.full((DEPTH.height, DEPTH.width), WALL_M * 1000, np.uint16)
    depth[(np.abs(DEPTH.rays) * PANEL_M <= PANEL_HALF_M).all(-1)] = PANEL_M * 1000
    return depth


def truly_hidden(points: np.ndarray) -> np.ndarray:
    """Whether the panel is between points (N, 3), depth frame, and the colour camera's centre."""
    centre = invert(CAMERA.colour_from_depth)[:3, 3]
    share = (PANEL_M - centre[2]) / (points[:, 2] - centre[2])
    crossing = centre + share[:, None] * (points - centre)
    return (points[:, 2] > PANEL_M + 0.01) & (np.abs(crossing[:, :2]) <= PANEL_HALF_M).all(-1)


def test_points_reproject_to_their_pixels():
    depth = wall_with_panel()
    depth[:40] = 0
    points, index = depth_points(depth, CAMERA)
    assert len(index) == np.count_nonzero(depth)
    assert np.allclose(points[:, 2], depth.ravel()[index] / 1000)
    pixels = DEPTH.project(points.astype(np.float64))
    rows, columns = np.divmod(index, DEPTH.width)
    assert np.abs(pixels - np.stack([columns, rows], -1)).max() < 1e-3


def test_master_points_follow_the_chain_of_poses():
    depth = wall_with_panel()
    points = master_points(depth, CAMERA).points
    chain = CAMERA.master_from_colour @ CAMERA.colour_from_depth
    assert np.allclose(points, apply(chain, depth_points(depth, CAMERA).points), atol=1e-5)
    assert np.allclose(CAMERA.depth_from_master @ CAMERA.master_from_depth, np.eye(4))


def test_pixels_without_a_ray_are_left_out():
    depth = np.zeros((DEPTH.height, DEPTH.width), np.uint16)
    depth[10, 20] = 900
    assert depth_points(depth, CAMERA, np.array([0, 6420])).depth_index.tolist() == [6420]
    wide = Intrinsics(1024, 1024, 504.6, 504.7, 511.5, 511.5, DEPTH.distortion, 1.0)
    camera = Camera("k1", COLOUR, wide, np.eye(4), np.eye(4))
    points, _ = depth_points(np.full((1024, 1024), 1000, np.uint16), camera)
    assert np.hypot(points[:, 0], points[:, 1]).max() <= 1.0 + 1e-6
    assert 0 < len(points) < 1024 * 1024


def test_lookup_finds_the_colour_pixel_of_the_surface():
    depth = wall_with_panel()
    lookup = colour_lookup(depth, CAMERA)
    points = depth_points(depth, CAMERA).points.astype(np.float64)
    pixels = COLOUR.project(apply(CAMERA.colour_from_depth, points))
    row, column = np.divmod(lookup.colour_index, COLOUR.width)
    inside = lookup.colour_index >= 0
    assert inside.mean() > 0.5
    offset = np.stack([column, row], -1) - pixels
    assert np.abs(offset[inside]).max() <= 0.5 + 1e-2


def test_hidden_points_are_those_behind_the_panel():
    depth = wall_with_panel()
    lookup = colour_lookup(depth, CAMERA)
    points = depth_points(depth, CAMERA).points.astype(np.float64)
    truth = truly_hidden(points)
    inside = lookup.colour_index >= 0
    assert truth[inside].sum() > 1000
    assert not lookup.hidden[points[:, 2] < PANEL_M + 0.01].any()
    # All of the truly hidden; wrong flags only along the edge, where a seam of a few pixels is
    # given up on purpose.
    assert not (truth & ~lookup.hidden & inside).any()
    wrong = (lookup.hidden & ~truth)[inside].sum()
    edge = 4 * 2 * PANEL_HALF_M * DEPTH.fx / PANEL_M  # depth pixels
    assert wrong < 3 * edge


def test_an_image_of_another_size_is_refused():
    with pytest.raises(ValueError, match="does not fit camera k2"):
        depth_points(np.zeros((10, 10), np.uint16), CAMERA)


def test_aligned_depth_uses_its_own_pixel():
    rig, zup_from_master = ring(count=1)
    lens = rig[0].colour.scaled(0.1)
    camera = replace(rig[0], colour=lens, depth=lens, colour_from_depth=np.eye(4))
    assert camera.aligned and not rig[0].aligned
    depth = np.rint(room_depth(camera, zup_from_master, FURNITURE) * 1000).astype(np.uint16)
    # A hair's breadth of offset takes the long way, by projection.
    nudged = np.eye(4)
    nudged[0, 3] = 1e-9
    found = colour_lookup(depth, camera)
    projected = colour_lookup(depth, replace(camera, colour_from_depth=nudged))
    assert np.array_equal(found.depth_index, projected.depth_index)
    assert np.array_equal(found.colour_index, projected.colour_index)
    assert not found.hidden.any()
