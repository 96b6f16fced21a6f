"""Azure Kinect calibrations: modes against closed forms, a real device against OpenCV."""

from __future__ import annotations

import json
from itertools import cycle

import cv2
import numpy as np
import pytest

from intercap_core.errors import UserError
from intercap_core.formats.calibration.k4a import (
    COLOUR_MODES,
    DEPTH_MODES,
    colour_from_accelerometer,
    parse_camera,
)

RADIAL = (0.01, 0.02, 0.03, 0.04, 0.05, 0.06)  # k1 to k6


def make_calibration(lens: dict | None = None, sensor: int = 1, **changes) -> bytes:
    """A calibration with round numbers: centre in the middle, focal lengths 0.5 and 0.7.

    ``lens`` has other parameters by number, ``changes`` other entries of the ``sensor``: 0 for
    depth, 1 for colour.
    """

    def camera(location, fx, fy, translation):
        return {
            "Intrinsics": {
                "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
                "ModelParameters": [0.5, 0.5, fx, fy, *RADIAL, 0, 0, 0.008, 0.007],
            },
            "Location": f"CALIBRATION_CameraLocation{location}",
            "MetricRadius": 0,
            "Rt": {"Rotation": [1, 0, 0, 0, 1, 0, 0, 0, 1], "Translation": translation},
        }

    cameras = [camera("D0", 0.5, 0.5, [0, 0, 0]), camera("PV0", 0.6, 0.8, [-0.032, -0.002, 0.004])]
    for number, value in (lens or {}).items():
        cameras[sensor]["Intrinsics"]["ModelParameters"][number] = value
    cameras[sensor].update(changes)
    return json.dumps({"CalibrationInformation": {"Cameras": cameras}}).encode()


def moved(translation: object) -> bytes:
    return make_calibration(Rt={"Rotation": np.eye(3).ravel().tolist(), "Translation": translation})


def read(content: bytes, colour_mode="1080P", depth_mode="NFOV_UNBINNED"):
    return parse_camera(
        content, colour_mode=colour_mode, depth_mode=depth_mode, name="k1", source="k1.mkv"
    )


def test_order_of_the_lens_parameters_and_default_radius():
    lens = read(make_calibration()).colour
    assert lens.distortion.tolist() == [0.01, 0.02, 0.007, 0.008, *RADIAL[2:]]  # k1 k2 p1 p2 k3 ...
    assert lens.metric_radius == 1.7
    assert read(make_calibration(MetricRadius=1.25)).colour.metric_radius == 1.25


@pytest.mark.parametrize("mode", COLOUR_MODES)
def test_a_centred_lens_is_centred_in_every_mode(mode):
    lens = read(make_calibration(), colour_mode=mode).colour
    assert (lens.cx, lens.cy) == ((lens.width - 1) / 2, (lens.height - 1) / 2)
    full_height = lens.width * 3 // 4  # every mode is cut from a 4:3 image
    assert np.allclose((lens.fx, lens.fy), (0.6 * lens.width, 0.8 * full_height), rtol=1e-12)


def test_depth_modes_are_crops_of_one_sensor():
    lenses = {m: read(make_calibration(), depth_mode=m).depth for m in DEPTH_MODES}
    wide, narrow = lenses["WFOV_UNBINNED"], lenses["NFOV_UNBINNED"]
    rays = np.array([[0.1, -0.2, 1.0], [0, 0, 1.0]])
    assert np.allclose(wide.project(rays) - (192, 180), narrow.project(rays))
    for fine, binned in (("WFOV_UNBINNED", "WFOV_2X2BINNED"), ("NFOV_UNBINNED", "NFOV_2X2BINNED")):
        half = lenses[fine].scaled(0.5)
        assert (half.width, half.height) == (lenses[binned].width, lenses[binned].height)
        assert np.allclose(half.parameters, lenses[binned].parameters)


def test_baseline_is_metres_from_depth_to_colour():
    camera = read(make_calibration())
    assert np.allclose(camera.colour_from_depth[:3, 3], [-0.032, -0.002, 0.004])
    assert camera.depth is not None
    assert read(make_calibration(), depth_mode=None).depth is None


@pytest.mark.parametrize(("colour_mode", "depth_mode"), zip(COLOUR_MODES, cycle(DEPTH_MODES)))
def test_real_lenses_project_as_opencv_and_invert(real_calibration, colour_mode, depth_mode):
    camera = read(real_calibration, colour_mode, depth_mode)
    for lens in (camera.colour, camera.depth):
        u, v = np.meshgrid(np.linspace(0, lens.width - 1, 23), np.linspace(0, lens.height - 1, 19))
        pixels = np.stack([u.ravel(), v.ravel()], -1)
        rays = lens.unproject(pixels)
        covered = lens.inside_model(rays)
        assert covered.mean() > (0.7 if depth_mode.startswith("WFOV") else 0.999)
        assert np.abs(lens.project(rays) - pixels).max() < 1e-6
        peer, _ = cv2.projectPoints(
            rays[covered] * 2, np.zeros(3), np.zeros(3), lens.matrix, lens.distortion
        )
        assert np.abs(peer[:, 0] - pixels[covered]).max() < 1e-6


def test_lenses_of_a_real_device_are_32_mm_apart(real_calibration):
    camera = read(real_calibration)
    assert np.linalg.norm(camera.colour_from_depth[:3, 3]) == pytest.approx(0.032, abs=0.002)
    assert camera.depth.metric_radius == pytest.approx(1.74, abs=1e-4)
    rotation = colour_from_accelerometer(real_calibration, source="k1.mkv")
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    # The accelerometer's z axis points down, as the colour camera's y axis does.
    assert rotation[1, 2] > 0.95


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"no json", "k1.mkv"),
        (b"{}", "lacks 'CalibrationInformation'"),
        (b"[]", "k1.mkv"),
        (make_calibration(Location="elsewhere"), "PV0"),
        (make_calibration(Intrinsics={"ModelType": "Other", "ModelParameters": []}), "'Other'"),
        (make_calibration(Rt={"Rotation": [2] * 9, "Translation": [0] * 3}), "rigid"),
        (b'{"CalibrationInformation": null}', "expected an object"),
        (make_calibration({2: 10**400}), "finite numbers"),
        (make_calibration({2: 1e308}), "fx|finite"),
        (make_calibration({2: 1e-9}), "fx is 1.*e-06 px"),
        (make_calibration({2: 1e9}, sensor=0), "fx is 1.024e.12 px"),
        (make_calibration({0: 50}), "cx is"),
        (make_calibration({4: 1e9}), "distortion"),
        (make_calibration({12: 5}), "tangential distortion"),
        (make_calibration(MetricRadius=10**400), "radius|finite"),
        (moved([10**400, 0, 0]), "rigid"),
        (moved([1e300, 0, 0]), "rigid|moves"),
        (moved(0.1), "rigid"),
    ],
)
def test_broken_calibrations_are_refused(content, words):
    with pytest.raises(UserError, match=words):
        read(content)
