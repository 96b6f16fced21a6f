"""What sticks out of the measured person goes in; what is hidden or unknown does not."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.camera.intrinsics import Intrinsics
from intercap_core.camera.rig import Camera
from intercap_core.fitting.free_space import DepthWindow, seen_through

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
def test_a_point_outside_the_border_is_as_far_out_as_it_is(out_m: float) -> None:
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
def test_what_is_no_evidence_draws_nothing(
    person_mm: int, background_mm: int, normal: tuple[float, float, float], x: float
) -> None:
    window, direction = _window(person_mm, background_mm), np.array([normal], float)
    points = np.array([[x, 0.0, 2.0]])
    assert len(seen_through(window, CAMERA, 0.0, points, direction)[0]) == 0
