"""Surfaces that move: their speed, and what it tells of the cameras' times and poses."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.transforms import apply
from intercap_core.scene.background import camera_background
from intercap_core.scene.registration import MOVING, Registration, RigEstimate
from intercap_core.scene.surfaces import moving_surfaces
from tests.helpers.synthetic_capture import (
    FURNITURE,
    ring,
    room_depth,
    to_millimetres,
    write_frames,
)

TRUTH, UP = ring()
FPS, T = 15.0, 10
VELOCITY = np.array([0.7, -0.5, 0.2])
OFFSET = np.array([0.0, 0.006, -0.007, 0.004, 0.008, -0.003])


def box_at(seconds: float) -> np.ndarray:
    """A crate (1, 2, 3) on its way through the room; it turns back after a third of a second."""
    way = seconds if seconds < 1 / 3 else 2 / 3 - seconds
    middle, half = np.array([-0.1, 0.1, 0.9]) + VELOCITY * way, np.array([0.25, 0.3, 0.35])
    return np.stack([middle - half, middle + half])[None]


@pytest.fixture(scope="module")
def layers(tmp_path_factory):
    rng = np.random.default_rng(0)
    depths = []
    for c, camera in enumerate(TRUTH):
        clean = [
            room_depth(camera, UP, np.concatenate([FURNITURE, box_at(t / FPS + OFFSET[c])]))
            for t in range(T)
        ]
        depths.append(np.stack([to_millimetres(depth, rng, noise=0.5) for depth in clean]))
    path = tmp_path_factory.mktemp("moving") / "frames.h5"
    write_frames(path, TRUTH, num_sets=T, depths=depths)
    image_of = np.tile(np.arange(T)[:, None], len(TRUTH))
    nobody = np.full((T, 135, 3), np.nan)
    with Frames.open(path) as frames:
        backgrounds = [camera_background(frames, c, nobody) for c in range(len(TRUTH))]
        return moving_surfaces(frames, TRUTH, image_of, backgrounds)


def test_speed_is_that_of_the_crate_along_its_faces(layers):
    first = layers[1]  # before it turns back
    for c, surface in first.items():
        pose = UP @ TRUTH[c].master_from_depth
        expected = (surface.normals @ pose[:3, :3].T) @ VELOCITY
        assert np.median(np.abs(surface.speed - expected)) < 0.05
        world = apply(pose, surface.points)
        low, high = box_at(2 / FPS)[0]
        inside = ((world > low - 0.05) & (world < high + 0.05)).all(1)
        assert inside.mean() > 0.9


def test_offsets_come_out_of_the_motion(layers):
    registration = Registration(TRUTH, {MOVING: layers}, 0)
    solved = registration.solve(RigEstimate.start(TRUTH), free_poses=False)
    error = np.abs(solved.estimate.offset - OFFSET)
    assert error.max() < 0.002 and error.mean() < 0.001
    sigma = np.sqrt(np.diagonal(solved.covariance[:, 7, :, 7]))
    assert (error[1:] < 4 * sigma[1:]).all()
