"""A ring of cameras with real distortion."""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import invert

DISTORTION = np.array([0.08, -0.14, 0.0003, -0.0005, 0.05, 0, 0, 0])


def ring(count: int, size: tuple[int, int] = (1280, 720)) -> Rig:
    """Cameras 2.5 m around the origin at heights of 1 and 2 m, the first one the master."""
    cameras = []
    for c in range(count):
        angle = 2 * np.pi * c / count
        eye = np.array([2.5 * np.cos(angle), 2.5 * np.sin(angle), 1.0 + c % 2])
        ahead = np.array([0, 0, 1.0]) - eye
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], -1)
        pose[:3, 3] = eye
        width, height = size
        focal = 0.5 * width
        lens = Intrinsics(width, height, focal, focal, width / 2 + 3, height / 2 - 5, DISTORTION)
        cameras.append(Camera(f"k{c + 1}", lens, None, None, pose))
    rig = Rig(tuple(cameras))
    return rig.moved(invert(rig[0].master_from_colour) @ rig.master_from_colour)
