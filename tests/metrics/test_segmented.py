"""Person's and object's points of one depth image."""

from __future__ import annotations

import numpy as np

from intercap_core.camera.masks import Runs, encode
from intercap_core.camera.transforms import apply, invert
from intercap_core.metrics.segmented import ViewMasks, segmented_points
from tests.helpers.synthetic_capture import FURNITURE, ring, room_depth, to_millimetres

RIG, UP = ring()
NEAR = apply(invert(UP), np.array([[1.2, 1.35, 0.5], [0.9, 1.1, 1.1]]))


def everything() -> ViewMasks:
    lens = RIG[4].colour
    runs = Runs(encode(np.ones((lens.height, lens.width), bool)), lens.height, lens.width)
    return ViewMasks(runs, None)


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
