"""Person's and object's points of one depth image."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.evaluation.proximity import DEEPEST_M
from intercap_core.evaluation.segmented import segmented_points
from intercap_core.geometry.camera.clouds import colour_lookup, depth_points
from intercap_core.geometry.camera.masks import Runs, encode
from intercap_core.geometry.camera.transforms import apply, invert
from tests.helpers.synthetic_capture import FURNITURE, ring, room_depth, to_millimetres

RIG, UP = ring()
NEAR = apply(invert(UP), np.array([[1.2, 1.35, 0.5], [0.9, 1.1, 1.1]]))


def everything() -> tuple[Runs, None]:
    lens = RIG[4].colour
    runs = Runs(encode(np.ones((lens.height, lens.width), bool)), lens.height, lens.width)
    return runs, None


def test_points_lie_on_the_surface_that_the_camera_sees():
    depth = room_depth(RIG[4], UP, FURNITURE)
    image = to_millimetres(depth, np.random.default_rng(0), noise=0.0)
    person, thing = segmented_points(image, RIG[4], everything(), NEAR, 0.0)
    world = apply(UP, person)
    on_floor = np.abs(world[:, 2]) < 0.01
    on_box = ((world > FURNITURE[1, 0] - 0.01) & (world < FURNITURE[1, 1] + 0.01)).all(1)
    assert len(person) > 50 and (on_floor | on_box).mean() > 0.95 and on_box.any()
    assert len(thing) == 0


def test_an_image_without_a_measurement_has_no_points():
    empty = np.zeros((RIG[4].depth.height, RIG[4].depth.width), np.uint16)
    person, thing = segmented_points(empty, RIG[4], everything(), NEAR, 0.0)
    assert len(person) == 0 and len(thing) == 0


@pytest.mark.parametrize("bias", [0.0, 0.013])
def test_points_are_those_of_the_plain_lookup_around_the_meshes(bias: float):
    camera = RIG[4]
    lens = camera.depth
    depth = to_millimetres(room_depth(camera, UP, FURNITURE), np.random.default_rng(1), noise=0.0)
    person, _ = segmented_points(depth, camera, everything(), NEAR, bias)

    local = apply(camera.depth_from_master, NEAR)
    pixels = lens.project(local)
    margin = lens.fx * DEEPEST_M / local[:, 2].min()
    low, high = np.floor(pixels.min(0) - margin), np.ceil(pixels.max(0) + margin)
    row, column = np.mgrid[: lens.height, : lens.width]
    around = (column >= low[0]) & (column <= high[0]) & (row >= low[1]) & (row <= high[1])
    around &= (depth > 1e3 * (local[:, 2].min() - DEEPEST_M)) & (
        depth < 1e3 * (local[:, 2].max() + DEEPEST_M)
    )
    lookup = colour_lookup(depth, camera)
    shown = lookup.shown & around.ravel()[lookup.depth_index]
    expected = depth_points(depth, camera, lookup.depth_index[shown]).points.astype(float)
    expected -= bias * expected / expected[:, 2:]
    expected = apply(camera.master_from_depth, expected)
    assert len(person) > 50
    np.testing.assert_allclose(person, expected, atol=2e-6)
