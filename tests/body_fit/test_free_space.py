"""Points that stick out of the measured person; hidden and unknown points have no residual."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.body_fit.free_space import DepthWindow, find_protruding
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply, rigid

LENS = Intrinsics(320, 288, 252.0, 252.0, 159.5, 143.5)
TURN = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
CAMERA = Camera("k1", LENS, LENS, np.eye(4), rigid(TURN, np.array([-2.0, 0.1, 2.0])))
EDGE_ON = (0.98, 0.0, -0.199)  # the normal where the line of sight grazes a round limb
BORDER_M = (199.5 - 159.5) / 252 * 2.0


def _protruding(
    person_mm: int, background_mm: int, normal: tuple[float, float, float], x: float
) -> tuple[np.ndarray, np.ndarray]:
    """Of a point at x and two metres, depth camera's frame, with noise along y.

    The right border of the person is at pixel 200 of the image, or ``BORDER_M``. The window leaves
    out 30 rows and 20 columns.
    """
    depth = np.full((288, 320), background_mm, np.uint16)
    depth[:, :200] = person_mm
    window = DepthWindow(0, (30, 20), depth[30:250, 20:300].copy())
    local = np.stack([np.full(9, x), np.linspace(-0.3, 0.3, 9), np.full(9, 2.0)], 1)
    points = apply(CAMERA.master_from_depth, local)
    normals = np.tile(CAMERA.master_from_depth[:3, :3] @ normal, (9, 1))
    return find_protruding(
        window, CAMERA, 0.0, points.astype(np.float32), normals.astype(np.float32)
    )


@pytest.mark.parametrize("out_m", [0.02, 0.03, 0.045])
def test_distance_of_a_point_outside_the_border(out_m: float) -> None:
    index, away = _protruding(2000, 4000, EDGE_ON, BORDER_M + out_m)
    assert index.tolist() == list(range(9))
    np.testing.assert_allclose(away, out_m, atol=0.014)  # of a step and of a pixel


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
    assert len(_protruding(person_mm, background_mm, normal, x)[0]) == 0
