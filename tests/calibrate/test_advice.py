"""Instructions for weak cameras: the partner, a place that both see, and the scale."""

from __future__ import annotations

import numpy as np

from intercap_core.calibrate.advice import advise
from intercap_core.calibrate.found_rig import FoundRig, Pair, Residuals
from intercap_core.geometry.camera.transforms import apply
from intercap_core.output.site.calibration_page import calibration_page
from intercap_core.scene.floor import floor_under_feet
from tests.calibrate.synthetic_views import views_of_walker
from tests.helpers.synthetic_capture import ring

TRUTH, UP = ring(4)


def found_with(sigma_m: float, *, scale_sigma: float = 0.0) -> FoundRig:
    """A rig whose fourth camera is known to ``sigma_m`` and shares least with the second."""
    _, joints, _ = views_of_walker(4, 30)
    covariance = np.zeros((4, 6, 4, 6))
    covariance[3, 3:, 3, 3:] = sigma_m**2 / 3 * np.eye(3)
    offset = np.zeros((4, 6))
    offset[:, 3:] = scale_sigma * TRUTH.master_from_colour[:, :3, 3]
    covariance += np.einsum("ai,bj->aibj", offset, offset)
    nothing = np.full(4, np.nan)
    pairs = [
        Pair((a, 3), 40 if a == 1 else 500, 0, 2.0, np.nan, np.nan) for a in range(3)
    ]  # fmt: skip
    residuals = Residuals(nothing, nothing, pairs, joints)
    return FoundRig(TRUTH, covariance, residuals, *[nothing] * 3, "", scale_sigma)


def test_a_weak_camera_gets_a_partner_and_a_place_that_both_see() -> None:
    found = found_with(0.05)
    ground, up = floor_under_feet(TRUTH, found.residuals.body, np.full((4, 3), np.nan))
    (advice,) = advise(found, ground, up.direction)
    assert advice.camera == "k4" and "k4 is known to 50 mm only" in advice.text
    assert "least with k2: 40 joints" in advice.text and "in front of k4" in advice.text
    assert advice.place is not None
    place = apply(UP, advice.place[None])[0]
    assert abs(place[2]) < 0.05  # on the floor
    for camera in (TRUTH[1], TRUTH[3]):
        for height in (0.2, 1.6):
            point = apply(np.linalg.inv(UP), (place + np.array([0, 0, height]))[None])
            in_camera = apply(camera.colour_from_master, point)
            pixel = camera.colour.project(in_camera)[0]
            assert in_camera[0, 2] > 0
            assert (pixel > 0).all() and (pixel < (camera.colour.width, camera.colour.height)).all()
    page = calibration_page("walk", found, up.direction, [], [advice], "the floor")
    assert page.count('class="advised"') == 2 and "for k4" in page and "the floor" in page
    way = apply(UP, found.residuals.walk)
    assert np.linalg.norm(way[:, :2] - place[:2], axis=1).min() > 0.4


def test_a_weak_scale_is_not_blamed_on_cameras() -> None:
    found = found_with(0.005, scale_sigma=0.03)
    ground, up = floor_under_feet(TRUTH, found.residuals.body, np.full((4, 3), np.nan))
    (advice,) = advise(found, ground, up.direction)
    assert "3.0 %" in advice.text and "--distance" in advice.text and "board" in advice.text
    assert advice.place is None


def test_accurate_cameras_need_no_advice() -> None:
    found = found_with(0.005)
    ground, up = floor_under_feet(TRUTH, found.residuals.body, np.full((4, 3), np.nan))
    assert advise(found, ground, up.direction) == []
