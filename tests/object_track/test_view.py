"""Reduced masks, reductions of images, and the cache of views."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.masks import encode
from intercap_core.geometry.camera.rig import Camera
from intercap_core.object_track.recording import ViewCache
from intercap_core.object_track.reduced_mask import (
    EMPTY,
    ReducedMask,
    decode,
    reduced_lens,
    remove_person,
)
from intercap_core.object_track.view import View, ViewGeometry, camera_distances
from tests.helpers.synthetic_capture import COLOUR, COLOUR_FROM_DEPTH, DEPTH

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("step", [1, 2, 3])
def test_reduced_masks_equal_every_nth_pixel(step):
    lens = Intrinsics(97, 53, 50, 50, 48, 26)
    full, empty = np.ones((53, 97), bool), np.zeros((53, 97), bool)
    for mask in (full, empty, *(RNG.random((10, 53, 97)) < [[[0.5]], [[0.02]]] * 5)):
        reduced = decode(encode(mask), lens, step)
        expected = mask[::step, ::step]
        small = reduced_lens(lens, step)
        assert (small.height, small.width) == expected.shape
        np.testing.assert_array_equal(reduced.window(0, 0, *expected.shape), expected)
        assert reduced.area == expected.sum()
        y, x = np.mgrid[-2:5, -3:9].reshape(2, -1)
        inside = (x >= 0) & (y >= 0)
        want = np.zeros(len(x), bool)
        want[inside] = expected[y[inside], x[inside]]
        np.testing.assert_array_equal(reduced.sample(x, y), want)


def test_a_mask_of_another_size_is_refused():
    with pytest.raises(ValueError, match="its runs hold 25 pixels"):
        decode(encode(np.ones((5, 5), bool)), COLOUR, 2)


def test_reduced_pixels_have_the_same_rays():
    small = reduced_lens(COLOUR, 3)
    pixels = np.array([[0, 0], [100, 50], [639, 359]])
    np.testing.assert_allclose(small.unproject(pixels), COLOUR.unproject(pixels * 3), atol=1e-12)


PERSON = np.zeros((300, 200), np.uint8)
cv2.ellipse(PERSON, (90, 150), (40, 130), 0, 0, 360, 1, -1)
OBJECT = np.zeros_like(PERSON)
OBJECT[140:180, 125:160] = 1


def reduced(mask: np.ndarray) -> ReducedMask:
    return ReducedMask(0, 0, mask.astype(bool))


@pytest.mark.parametrize("border", [0, 3])
def test_the_object_remains_of_a_joint_candidate(border):
    size = np.ones((2 * border + 1, 2 * border + 1), np.uint8)
    joint = cv2.dilate(PERSON, size) | OBJECT
    part = remove_person(reduced(joint), reduced(PERSON), 1)
    assert part is not None
    found = part.window(0, 0, *PERSON.shape)
    outside = (OBJECT > 0) & (PERSON == 0)
    assert (found & outside).sum() > 0.9 * outside.sum()
    assert (found & ~outside).sum() < 0.35 * outside.sum()


def test_person_and_object_alone_are_not_joint_candidates():
    wider = cv2.dilate(PERSON, np.ones((7, 7), np.uint8))
    assert remove_person(reduced(wider), reduced(PERSON), 1) is None
    assert remove_person(reduced(OBJECT), reduced(PERSON), 1) is None
    assert remove_person(reduced(OBJECT), reduced(np.zeros_like(PERSON)), 1) is None


def geometry_of(diameter: float, distance: float, scale: float = 1.0) -> ViewGeometry:
    camera = Camera("k1", COLOUR.scaled(scale), DEPTH, COLOUR_FROM_DEPTH, np.eye(4))
    return ViewGeometry.for_object(camera, diameter, distance_m=distance)


def test_reductions_follow_the_apparent_size():
    """All pixels of a cup are used, and each fourth of a near suitcase of 400 pixels."""
    assert (geometry_of(0.1, 2.2).step, geometry_of(0.1, 2.2).depth_step) == (1, 1)
    assert geometry_of(0.1, 2.2, scale=2 / 3).step == 1
    assert [geometry_of(0.62, distance).step for distance in (1.4, 3.0, 8.0)] == [4, 2, 1]
    assert geometry_of(1.1, 1.0).step == 4
    for distance in (1.5, 2.0, 3.0, 4.0, 6.0):
        for diameter in (0.25, 0.6, 1.0):
            geometry = geometry_of(diameter, distance)
            shown = geometry.camera.colour.fx * diameter / distance
            assert geometry.step in (1, 4) or 50 < shown / geometry.step < 125


def test_distances_of_cameras_are_medians_over_known_joints():
    joints = np.full((2, 5, 3), np.nan)
    cameras = [geometry_of(1.0, 1.0).camera]
    assert camera_distances(cameras, joints) == [2.5]
    joints[1, :3] = (0, 0, 3.5), (0, 0, 4.0), (0, 0, 9.0)
    assert camera_distances(cameras, joints) == [4.0]


def test_the_cache_evicts_the_least_recently_used_frames():
    loaded = []
    person = ReducedMask(2, 3, np.ones((8, 100), bool))

    def load(t: int) -> list[View]:
        loaded.append(t)
        return [View(None, None, person, ()) for _ in range(2)]

    views = ViewCache(load, max_bytes=4800)  # three frames of 1600 bytes
    for t in (0, 1, 2, 0, 1, 2):
        assert views(t) is views(t)
    assert loaded == [0, 1, 2]
    for t in (0, 3, 0):
        views(t)
    assert loaded == [0, 1, 2, 3]
    views(1)
    assert loaded == [0, 1, 2, 3, 1]
    small = ViewCache(load, max_bytes=10)  # it keeps one frame, however large
    assert small(0) is small(0)


def test_windows_of_depth_are_metres_without_bias():
    depth_mm = RNG.integers(1, 9000, (DEPTH.height, DEPTH.width)).astype(np.uint16)
    depth_mm[RNG.random(depth_mm.shape) > 0.8] = 0  # invalid
    camera = Camera("k1", COLOUR, DEPTH, COLOUR_FROM_DEPTH, np.eye(4))
    geometry = ViewGeometry.for_object(camera, 0.3, 2.5, depth_bias_m=0.00731)
    view = View(geometry, geometry.reduced_depth(depth_mm), EMPTY, ())
    every = slice(None, None, geometry.depth_step)
    reduced = depth_mm[every, every]
    assert view.depth.shape == reduced.shape and view.nbytes == reduced.nbytes
    window = slice(3, 40), slice(5, 17)
    for bias in (0.00731, -0.02):
        seen = view.through(replace(geometry, depth_bias_m=bias)).depth[window]
        expected = np.where(reduced > 0, reduced * 1e-3 - bias, 0)[window]
        np.testing.assert_allclose(seen, expected, atol=1e-6)
        assert seen.dtype == np.float32
