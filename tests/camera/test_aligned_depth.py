"""Depth resampled to the colour grid, against rays cast from the colour camera itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic_capture import FURNITURE, ring, room_depth

from intercap_core.camera.aligned_depth import depth_on_colour
from intercap_core.camera.clouds import colour_lookup


def test_it_is_what_the_colour_camera_would_measure():
    rig, zup_from_master = ring(count=3)
    for camera in rig:
        camera = replace(camera, colour=camera.colour.scaled(0.3))
        depth = np.rint(room_depth(camera, zup_from_master, FURNITURE) * 1000).astype(np.uint16)
        found = depth_on_colour(depth, camera)
        colour_as_depth = replace(camera, depth=camera.colour, colour_from_depth=np.eye(4))
        truth = room_depth(colour_as_depth, zup_from_master, FURNITURE) * 1000
        both = (found > 0) & (truth > 0)
        error = np.abs(found[both] - truth[both])
        assert both.mean() > 0.5  # the depth image is narrower than the colour image
        assert np.median(error) < 1.2 and np.percentile(error, 90) < 4
        # Beyond that only silhouettes differ, where the two cameras see different surfaces.
        assert (error > 100).mean() < 0.02


def test_a_surface_has_no_holes_and_a_near_one_covers_a_far_one():
    rig, _ = ring(count=1)
    camera = replace(rig[0], colour=rig[0].colour.scaled(0.5))
    far = np.full((camera.depth.height, camera.depth.width), 3000, np.uint16)
    middle = depth_on_colour(far, camera)[200:340, 350:610]
    assert (middle > 0).all()
    near = far.copy()
    near[70:110, 80:120] = 1000
    found = depth_on_colour(near, camera)
    assert ((found > 900) & (found < 1100)).sum() > 40 * 40


def test_an_image_of_another_size_is_refused():
    camera = ring(count=1)[0][0]
    with pytest.raises(ValueError, match="does not fit camera k1"):
        depth_on_colour(np.zeros((4, 4), np.uint16), camera)
    with pytest.raises(ValueError, match="does not fit"):
        depth_on_colour(np.zeros((4, 4), np.uint16), replace(camera, depth=None))


def test_depth_on_the_colour_grid_is_looked_up_at_its_own_pixel():
    rig, zup_from_master = ring(count=1)
    lens = rig[0].colour.scaled(0.1)
    camera = replace(rig[0], colour=lens, depth=lens, colour_from_depth=np.eye(4))
    assert camera.aligned and not rig[0].aligned
    depth = np.rint(room_depth(camera, zup_from_master, FURNITURE) * 1000).astype(np.uint16)
    # A hair's breadth of offset takes the long way, by projection.
    nudged = np.eye(4)
    nudged[0, 3] = 1e-9
    index = np.arange(500, 15000, 7)
    for pixels in (None, index):
        found = colour_lookup(depth, camera, pixels)
        projected = colour_lookup(depth, replace(camera, colour_from_depth=nudged), pixels)
        assert np.array_equal(found.depth_index, projected.depth_index)
        assert np.array_equal(found.colour_index, projected.colour_index)
        assert not found.hidden.any()
