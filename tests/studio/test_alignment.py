"""Depth on the colour grid, two ways, against rays cast from the colour camera itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from intercap_core.geometry.camera.rig import Camera
from intercap_core.studio.capture_folder import Aligner
from tests.helpers.aligned_depth import depth_on_colour as mean_of_samples
from tests.helpers.synthetic_capture import FURNITURE, ring, room_depth


def studio(depth: np.ndarray, camera: Camera) -> np.ndarray:
    return Aligner(camera).align(depth)


@pytest.mark.parametrize("align", [mean_of_samples, studio])
def test_it_is_what_the_colour_camera_would_measure(align):
    rig, zup_from_master = ring(count=3)
    for camera in rig:
        camera = replace(camera, colour=camera.colour.scaled(0.3))
        depth = np.rint(room_depth(camera, zup_from_master, FURNITURE) * 1000).astype(np.uint16)
        found = align(depth, camera)
        colour_as_depth = replace(camera, depth=camera.colour, colour_from_depth=np.eye(4))
        truth = room_depth(colour_as_depth, zup_from_master, FURNITURE) * 1000
        both = (found > 0) & (truth > 0)
        error = np.abs(found[both] - truth[both])
        assert both.mean() > 0.5  # the depth image is narrower than the colour image
        assert np.median(error) < 1.2 and np.percentile(error, 90) < 4
        # Beyond that only silhouettes differ, where the two cameras see different surfaces.
        assert (error > 100).mean() < 0.02


@pytest.mark.parametrize("align", [mean_of_samples, studio])
def test_a_surface_has_no_holes_and_a_near_one_covers_a_far_one(align):
    rig, _ = ring(count=1)
    camera = replace(rig[0], colour=rig[0].colour.scaled(0.5))
    far = np.full((camera.depth.height, camera.depth.width), 3000, np.uint16)
    middle = align(far, camera)[200:340, 350:610]
    assert (middle > 0).all()
    near = far.copy()
    near[70:110, 80:120] = 1000
    found = align(near, camera)
    assert ((found > 900) & (found < 1100)).sum() > 40 * 40
