"""Jacobians of the two terms of equation 1, and masks decoded on every n-th pixel."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.masks import encode
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.object_track import object_depth, object_silhouette
from intercap_core.object_track.reduced_mask import decode, reduced_lens
from intercap_core.object_track.view import ViewGeometry, distances
from tests.helpers.synthetic_capture import COLOUR, COLOUR_FROM_DEPTH, DEPTH

RNG = np.random.default_rng(0)
LENS = COLOUR.scaled(0.5)
STEPS = np.eye(6) * 1e-6


def _moved(points, origin, step):
    return (points - origin) @ Rotation.from_rotvec(step[:3]).as_matrix().T + origin + step[3:]


def test_depth_jacobian_against_finite_differences():
    observed, hit = RNG.normal(size=(2, 40, 3)) + np.array([0, 0, 3.0])
    normals = RNG.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    origin = RNG.normal(size=3) + np.array([0, 0, 3.0])

    def value(step):
        turned = normals @ Rotation.from_rotvec(step[:3]).as_matrix().T
        return object_depth.residuals(observed, _moved(hit, origin, step), turned, origin)[0]

    _, jacobian = object_depth.residuals(observed, hit, normals, origin)
    numeric = np.stack([(value(s) - value(-s)) / 2e-6 for s in STEPS], 1)
    np.testing.assert_allclose(jacobian, numeric, atol=1e-8)


def test_silhouette_jacobian_against_finite_differences():
    points = RNG.normal(size=(40, 3)) * 0.3 + (0, 0, 2.5)
    camera = rigid(Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.array([0.1, -0.2, 0.3]))
    targets = LENS.project(points @ camera[:3, :3].T + camera[:3, 3])
    targets = targets + RNG.normal(size=targets.shape) * 6
    origin = np.array([0.1, 0.0, 2.4])

    def value(step):
        moved = _moved(points, origin, step)
        return object_silhouette.residuals(moved, targets, LENS, camera, origin)[0]

    _, jacobian = object_silhouette.residuals(points, targets, LENS, camera, origin)
    numeric = np.stack([(value(s) - value(-s)) / 2e-6 for s in STEPS], 1)
    np.testing.assert_allclose(jacobian, numeric, atol=1e-5 * np.abs(numeric).max())


def test_rim_is_the_inner_border_and_not_the_image_edge():
    mask = np.zeros((9, 12), bool)
    mask[2:6, 5:] = True
    expected = np.zeros_like(mask)
    expected[2, 5:] = expected[5, 5:] = expected[2:6, 5] = True
    np.testing.assert_array_equal(object_silhouette.rim(mask), expected)


@pytest.mark.parametrize("step", [1, 2, 3])
def test_reduced_masks_equal_every_nth_pixel(step):
    lens = Intrinsics(97, 53, 50, 50, 48, 26)
    for number in range(12):
        mask = RNG.random((53, 97)) < (0.5 if number % 2 else 0.02)
        if number == 4:
            mask[:] = True
        if number == 6:
            mask[:] = False
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


def test_reduced_pixels_are_the_same_rays():
    small = reduced_lens(COLOUR, 3)
    pixels = np.array([[0, 0], [100, 50], [639, 359]])
    np.testing.assert_allclose(small.unproject(pixels), COLOUR.unproject(pixels * 3), atol=1e-12)


def test_a_mask_of_another_size_is_refused():
    with pytest.raises(ValueError, match="does not fit"):
        decode(encode(np.ones((5, 5), bool)), COLOUR, 2)


def _geometry(diameter: float, distance: float, scale: float = 1.0) -> ViewGeometry:
    camera = Camera("k1", COLOUR.scaled(scale), DEPTH, COLOUR_FROM_DEPTH, np.eye(4))
    return ViewGeometry.for_object(camera, diameter, distance_m=distance)


def test_images_are_reduced_by_how_large_the_object_appears():
    """Every pixel of a cup counts; a suitcase near by would be 400 px high: each fourth does."""
    assert (_geometry(0.1, 2.2).step, _geometry(0.1, 2.2).depth_step) == (1, 1)
    assert _geometry(0.1, 2.2, scale=2 / 3).step == 1
    assert [_geometry(0.62, distance).step for distance in (1.4, 3.0, 8.0)] == [4, 2, 1]
    assert _geometry(1.1, 1.0).step == 4
    for distance in (1.5, 2.0, 3.0, 4.0, 6.0):
        for diameter in (0.25, 0.6, 1.0):
            geometry = _geometry(diameter, distance)
            shown = geometry.camera.colour.fx * diameter / distance
            assert geometry.step in (1, 4) or 50 < shown / geometry.step < 125


def test_distance_of_each_camera_from_the_person():
    joints = np.full((2, 5, 3), np.nan)
    cameras = [_geometry(1.0, 1.0).camera]
    assert distances(cameras, joints) == [2.5]
    joints[1, :3] = (0, 0, 3.5), (0, 0, 4.0), (0, 0, 9.0)
    assert distances(cameras, joints) == [4.0]
