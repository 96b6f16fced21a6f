"""Cameras with each other's lenses, detected by the background."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.scene.background import steady_background
from intercap_core.scene.lens_exchange import exchange_lenses, swap_lenses
from intercap_core.scene.subject_views import triangulate_views
from tests.helpers.synthetic_capture import (
    DEPTH,
    FURNITURE,
    perturbed,
    ring,
    room_depth,
    to_millimetres,
)

ONE_SET = np.zeros(1)
RING, UP = ring(5)


def with_lenses(rig: Rig, change: np.ndarray) -> Rig:
    """The rig with focal lengths and principal points changed by (C, 3) px."""
    cameras = []
    for camera, (focal, cx, cy) in zip(rig, change, strict=True):
        lens = camera.colour
        lens = replace(
            lens, fx=lens.fx + focal, fy=lens.fy + focal, cx=lens.cx + cx, cy=lens.cy + cy
        )
        cameras.append(replace(camera, colour=lens, depth=lens if camera.aligned else camera.depth))
    return Rig(tuple(cameras))


@pytest.fixture(scope="module")
def seen():
    """Five cameras with depth on the colour grid, and lenses of 151 px."""
    change = np.random.default_rng(1).normal(0, 1.5, (5, 3))
    change[2], change[3] = (3, 4, -3), (-3, -2, 4)
    aligned = [Camera(c.name, DEPTH, DEPTH, np.eye(4), c.master_from_colour) for c in RING]
    rig, rng = with_lenses(Rig(tuple(aligned)), change), np.random.default_rng(0)
    images = [to_millimetres(room_depth(c, UP, FURNITURE), rng, noise=0.3)[None] for c in rig]
    backgrounds = [steady_background(image, np.zeros(image.shape, bool)) for image in images]
    nobody = triangulate_views(np.zeros((1, 5, 135, 3)), rig)
    return perturbed(rig, rng, 0.005, 0.2), backgrounds, nobody


def test_right_lenses_are_unchanged(seen):
    rig, backgrounds, nobody = seen
    result, exchanges = exchange_lenses(rig, backgrounds, nobody, ONE_SET, 0)
    assert exchanges == [] and result is rig


def test_exchanged_lenses_are_corrected(seen):
    rig, backgrounds, nobody = seen
    given = swap_lenses(rig, 2, 3)
    result, exchanges = exchange_lenses(given, backgrounds, nobody, ONE_SET, 0)
    assert [exchange.cameras for exchange in exchanges] == [(2, 3)]
    assert exchanges[0].after < 0.5 * exchanges[0].before
    for c in (2, 3):
        np.testing.assert_array_equal(result[c].depth.parameters, rig[c].colour.parameters)
        assert result[c].aligned


def test_devices_with_their_own_lenses_are_not_tested(seen):
    rig, backgrounds, nobody = seen
    given = swap_lenses(rig, 2, 3)
    apart = Rig(tuple(replace(c, colour_from_depth=RING[0].colour_from_depth) for c in given))
    assert exchange_lenses(apart, backgrounds, nobody, ONE_SET, 0) == (apart, [])
