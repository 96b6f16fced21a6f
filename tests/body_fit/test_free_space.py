"""Points that stick out of the measured person; hidden and unknown ones have no residual."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.body_fit.free_space import DepthWindow, seen_through
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply, rigid

LENS = Intrinsics(320, 288, 252.0, 252.0, 159.5, 143.5)
CAMERA = Camera("k1", LENS, LENS, np.eye(4), np.eye(4))


def _window(person_mm: int, background_mm: int) -> DepthWindow:
    """A person whose right border, in the image, is at pixel 200: x = 0.32 m at two metres."""
    depth = np.full((288, 320), background_mm, np.uint16)
    depth[:, :200] = person_mm
    return DepthWindow(0, (0, 0), depth)


EDGE_ON = (0.98, 0.0, -0.199)  # the normal where the line of sight grazes a round limb
BORDER_M = (199.5 - 159.5) / 252 * 2.0


@pytest.mark.parametrize("out_m", [0.02, 0.03, 0.045])
def test_distance_of_a_point_outside_the_border(out_m: float) -> None:
    points = np.array([[BORDER_M + out_m, 0.0, 2.0]])
    index, away = seen_through(_window(2000, 4000), CAMERA, 0.0, points, np.array([EDGE_ON]))
    assert index.tolist() == [0]
    assert away[0] == pytest.approx(out_m, abs=0.014)  # of a step and of a pixel


@pytest.mark.parametrize(
    ("person_mm", "background_mm", "normal", "x"),
    [
        (2000, 4000, EDGE_ON, BORDER_M - 0.03),  # on the person
        (2000, 4000, EDGE_ON, BORDER_M + 0.30),  # too far from it
        (2000, 0, EDGE_ON, BORDER_M + 0.03),  # nothing measured
        (2000, 1200, EDGE_ON, BORDER_M + 0.03),  # hidden
        (2000, 2040, EDGE_ON, BORDER_M + 0.03),  # a surface where the point is: a mask too small
        (2000, 4000, (0.0, 0.0, 1.0), BORDER_M + 0.03),  # looks away
    ],
)
def test_other_points_have_no_residual(
    person_mm: int, background_mm: int, normal: tuple[float, float, float], x: float
) -> None:
    window, direction = _window(person_mm, background_mm), np.array([normal], float)
    points = np.array([[x, 0.0, 2.0]])
    assert len(seen_through(window, CAMERA, 0.0, points, direction)[0]) == 0


def _plain(
    window: DepthWindow, camera: Camera, points: np.ndarray, normals: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The same in NumPy: facing, seen through, and the first step inward that is not."""
    assert camera.depth is not None

    def past(local: np.ndarray) -> np.ndarray:
        place = camera.depth.project(local) - np.array(window.first[::-1])
        column, row = np.rint(np.moveaxis(place, -1, 0)).astype(int)
        height, width = window.depth.shape
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        found = window.depth[np.where(inside, row, 0), np.where(inside, column, 0)]
        return np.where(inside, found, 0) * 1e-3 > local[..., 2] + 0.06

    local = apply(camera.depth_from_master, points)
    outward = normals @ camera.depth_from_master[:3, :3].T
    cosine = (outward * local).sum(1) / np.linalg.norm(local, axis=1)
    steps = local[:, None] - np.arange(0, 6)[:, None] * 0.01 * outward[:, None]
    through = past(steps)
    sticks_out = (cosine < 0.1) & through[:, 0] & through[:, 1] & ~through.all(1)
    index = np.flatnonzero(sticks_out)
    return index, 0.01 * (through[index].argmin(1) - 0.5)


def test_a_distorted_lens_agrees_with_numpy() -> None:
    generator = np.random.default_rng(0)
    bent = np.array([0.5, -2.6, 1e-3, -5e-4, 1.5, 0.4, -2.4, 1.4])
    lens = Intrinsics(320, 288, 252.0, 252.0, 159.5, 143.5, bent)
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    camera = Camera("k2", lens, lens, np.eye(4), rigid(turn, np.array([-2.0, 0.1, 2.0])))
    window = DepthWindow(0, (30, 20), _window(2000, 4000).depth[30:250, 20:300])
    local = np.array([BORDER_M, 0.0, 2.0]) + generator.normal(0, [0.04, 0.3, 0.01], (2000, 3))
    points = apply(camera.master_from_depth, local)
    normals = generator.normal(size=(2000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    index, away = seen_through(window, camera, 0.0, points, normals)
    true_index, true_away = _plain(window, camera, points, normals)
    assert len(true_index) > 40
    np.testing.assert_array_equal(index, true_index)
    np.testing.assert_allclose(away, true_away, atol=1e-12)
