"""Lenses that a calibration gave to the wrong cameras, told by the background."""

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

TIMES = np.zeros(1)
RING, UP = ring(5)
CHANGES = np.random.default_rng(1).normal(0, 1.5, (5, 3))
CHANGES[2], CHANGES[3] = (3, 4, -3), (-3, -2, 4)  # px of a lens of 151 px


def aligned_rig() -> Rig:
    """Five cameras with depth on the colour grid and lenses of their own."""
    cameras = []
    for camera, (focal, cx, cy) in zip(RING, CHANGES, strict=True):
        lens = replace(
            DEPTH, fx=DEPTH.fx + focal, fy=DEPTH.fy + focal, cx=DEPTH.cx + cx, cy=DEPTH.cy + cy
        )
        cameras.append(Camera(camera.name, lens, lens, np.eye(4), camera.master_from_colour))
    return Rig(tuple(cameras))


@pytest.fixture(scope="module")
def seen():
    rig, rng = aligned_rig(), np.random.default_rng(0)
    images = [to_millimetres(room_depth(c, UP, FURNITURE), rng, noise=0.3)[None] for c in rig]
    backgrounds = [steady_background(image, np.zeros(image.shape, bool)) for image in images]
    nobody = triangulate_views(np.zeros((1, 5, 135, 3)), rig)
    return perturbed(rig, rng, 0.005, 0.2), backgrounds, nobody


def test_right_lenses_are_left_alone(seen):
    rig, backgrounds, nobody = seen
    result, found = exchange_lenses(rig, backgrounds, nobody, TIMES, 0)
    assert found == [] and result is rig


@pytest.mark.parametrize("whole", [True, pytest.param(False, marks=pytest.mark.full)])
def test_exchanged_lenses_are_put_right(seen, whole):
    rig, backgrounds, nobody = seen
    given = swap_lenses(rig, 2, 3, whole=whole)
    result, found = exchange_lenses(given, backgrounds, nobody, TIMES, 0)
    assert [exchange.cameras for exchange in found] == [(2, 3)]
    assert found[0].after < 0.5 * found[0].before
    for c in (2, 3):
        np.testing.assert_array_equal(result[c].depth.parameters, rig[c].colour.parameters)
        assert result[c].aligned


def test_devices_with_lenses_of_their_own_are_not_asked(seen):
    rig, backgrounds, nobody = seen
    given = swap_lenses(rig, 2, 3, whole=True)
    apart = Rig(tuple(replace(c, colour_from_depth=RING[0].colour_from_depth) for c in given))
    assert exchange_lenses(apart, backgrounds, nobody, TIMES, 0) == (apart, [])
