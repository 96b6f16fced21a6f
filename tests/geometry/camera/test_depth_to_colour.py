"""Depth to colour on a real recording: against OpenCV's own chain, and against the image itself."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from intercap_core.formats.recordings.k4a import KinectFile
from intercap_core.geometry.camera.clouds import colour_lookup, depth_points


@pytest.fixture
def real_frame(real_recording):
    """The recording's camera, calibration, depth (H, W) mm, and grey image (H, W)."""
    with KinectFile(real_recording) as recording:
        packets = {packet.kind: packet for packet in recording.packets()}
        depth = recording.depth_image(packets["depth"].content)
        jpeg = np.frombuffer(packets["colour"].content, np.uint8)
        grey = cv2.imdecode(jpeg, cv2.IMREAD_GRAYSCALE)
        return recording.camera("k1"), json.loads(recording.info.calibration), depth, grey


def opencv_lens(entry: dict, size: tuple[int, int], crop: tuple[int, int]):
    """Matrix and coefficients straight from the JSON, by the format's description."""
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = entry["Intrinsics"]["ModelParameters"][
        :14
    ]
    matrix = np.array(
        [
            [fx * size[0], 0, cx * size[0] - crop[0] - 0.5],
            [0, fy * size[1], cy * size[1] - crop[1] - 0.5],
            [0, 0, 1],
        ]
    )
    return matrix, np.array([k1, k2, p1, p2, k3, k4, k5, k6])


def test_depth_pixels_land_where_opencv_puts_them(real_frame):
    camera, calibration, depth, _ = real_frame
    entries = calibration["CalibrationInformation"]["Cameras"]
    cameras = {entry["Location"].rpartition("Location")[2]: entry for entry in entries}
    lens, bend = opencv_lens(cameras["D0"], (1024, 1024), (192, 180))
    colour, colour_bend = opencv_lens(cameras["PV0"], (1280, 960), (0, 120))
    turn = np.array(cameras["PV0"]["Rt"]["Rotation"]).reshape(3, 3)
    shift = np.array(cameras["PV0"]["Rt"]["Translation"])

    cloud = depth_points(depth, camera)
    some = np.arange(0, len(cloud.depth_index), 97)
    rows, columns = np.divmod(cloud.depth_index[some], depth.shape[1])
    pixels = np.stack([columns, rows], -1).astype(np.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    iterate = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
    rays = iterate(pixels[:, None], lens, bend, R=np.eye(3), P=np.eye(3), criteria=criteria)
    z = depth.ravel()[cloud.depth_index[some]] / 1000
    points = np.concatenate([rays.reshape(-1, 2), np.ones((len(z), 1))], axis=1) * z[:, None]
    assert np.abs(cloud.points[some] - points).max() < 1e-6 * z.max() + 1e-5
    expected = cv2.projectPoints(points, cv2.Rodrigues(turn)[0], shift, colour, colour_bend)[0]
    in_colour = points @ camera.colour_from_depth[:3, :3].T + camera.colour_from_depth[:3, 3]
    assert np.abs(camera.colour.project(in_colour) - expected[:, 0]).max() < 1e-3

    lookup = colour_lookup(depth, camera)
    row, column = np.divmod(lookup.colour_index[some], camera.colour.width)
    inside = lookup.colour_index[some] >= 0
    assert inside.mean() > 0.5
    off = np.stack([column, row], -1) - expected[:, 0]
    assert np.abs(off[inside]).max() < 0.5 + 1e-2


def test_edges_of_depth_fall_on_edges_of_the_image(real_frame):
    """A wrong lens, crop or pose would move the one against the other."""
    camera, _, depth, grey = real_frame
    z = depth.astype(np.float32)
    far = cv2.dilate(z, np.ones((7, 7)))
    edge = (z > 0) & (far - z > 150)  # the nearer side of a step
    lookup = colour_lookup(depth, camera)
    shown = lookup.shown & edge.ravel()[lookup.depth_index]
    rows, columns = np.divmod(lookup.colour_index[shown], camera.colour.width)
    image = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.5)
    strength = np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0), cv2.Sobel(image, cv2.CV_32F, 0, 1))
    strength = np.minimum(strength, np.percentile(strength, 95))
    reach = 20
    inner = (
        (rows >= reach) & (columns >= reach)
        & (rows < grey.shape[0] - reach) & (columns < grey.shape[1] - reach)
    )  # fmt: skip
    rows, columns = rows[inner], columns[inner]
    shifts = np.arange(-reach, reach + 1)
    score = np.array([[strength[rows + dy, columns + dx].mean() for dx in shifts] for dy in shifts])
    dy, dx = (shifts[at] for at in np.unravel_index(score.argmax(), score.shape))
    assert len(rows) > 500 and max(abs(dy), abs(dx)) <= 3
