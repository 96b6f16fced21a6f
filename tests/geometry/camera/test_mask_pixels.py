"""Depth pixels of a mask against the plain look-up of the colour image."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.geometry.camera.clouds import ColourLookup, colour_lookup
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.mask_pixels import mask_pixels, mask_window
from intercap_core.geometry.camera.masks import Runs, encode
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import rigid

BENT = np.array([0.5, -2.6, 1e-3, -5e-4, 1.5, 0.4, -2.4, 1.4])
DEPTH = Intrinsics(320, 288, 252.0, 252.0, 159.5, 143.5, BENT)
COLOUR = Intrinsics(640, 360, 306.0, 306.0, 319.5, 179.5, BENT)
BESIDE = Camera("k1", COLOUR, DEPTH, rigid(np.eye(3), np.array([-0.032, 0.002, 0])), np.eye(4))
ALIGNED = Camera("k1", DEPTH, DEPTH, np.eye(4), np.eye(4))
WINDOW = (slice(20, 271), slice(30, 301))


def _scene() -> tuple[np.ndarray, np.ndarray]:
    """Depth and background (288,320) mm: somebody before a wall, and a pole before them; some
    pixels unknown."""
    generator = np.random.default_rng(0)
    row, column = np.mgrid[:288, :320]
    background = np.full((288, 320), 3500, np.uint16)
    depth = background.copy()
    person = ((row - 150) / 110) ** 2 + ((column - 160) / 50) ** 2 < 1
    depth[person] = (2000 + 2 * np.abs(column - 160))[person]
    depth[:, 150:158] = 1100
    for image in (depth, background):
        image[generator.random(image.shape) < 0.05] = 0
    return depth, background


def _mask(camera: Camera) -> Runs:
    height, width = camera.colour.height, camera.colour.width
    row, column = np.mgrid[:height, :width]
    across = 60 * camera.colour.fx / 252
    drawn = ((row - height / 2) / 140) ** 2 + ((column - width / 2) / across) ** 2 < 1
    return Runs(encode(drawn), height, width)


def _within(mask: Runs, lookup: ColourLookup) -> np.ndarray:
    """Flat depth pixels that the colour image shows within the mask."""
    shown = lookup.shown
    inside = mask.decode().ravel()[lookup.colour_index[shown]]
    return lookup.depth_index[shown][inside]


@pytest.mark.parametrize("camera", [BESIDE, ALIGNED], ids=["beside", "aligned"])
@pytest.mark.parametrize(("with_background", "every"), [(True, 2), (False, 2), (False, 1)])
def test_pixels_are_those_of_the_plain_lookup(
    camera: Camera, with_background: bool, every: int
) -> None:
    depth, background = _scene()
    mask = _mask(camera)
    behind = background if with_background else None
    found = mask_pixels(depth, camera, mask, WINDOW, background=behind, before_m=0.04, every=every)

    before = np.zeros_like(depth)
    before[WINDOW] = depth[WINDOW]
    if with_background:
        nearer = depth.astype(int) < background.astype(int) - 40
        before[~nearer & (background > 0)] = 0
    chosen = np.zeros(depth.shape, bool)
    chosen[20:271:every, 30:301:every] = True
    lookup = colour_lookup(before, camera)
    expected = _within(mask, lookup)
    np.testing.assert_array_equal(found, expected[chosen.ravel()[expected]])
    assert len(found) > 3000
    if camera is BESIDE:
        assert (lookup.hidden & (depth.ravel()[lookup.depth_index] < 2200)).any()


@pytest.mark.parametrize("camera", [BESIDE, ALIGNED], ids=["beside", "aligned"])
def test_the_window_holds_all_pixels_of_the_mask(camera: Camera) -> None:
    depth, _ = _scene()
    mask = _mask(camera)
    window = mask_window(depth, camera, mask)
    assert window is not None
    found = mask_pixels(depth, camera, mask, window)
    np.testing.assert_array_equal(found, _within(mask, colour_lookup(depth, camera)))
    height, width = camera.colour.height, camera.colour.width
    nothing = Runs(encode(np.zeros((height, width), bool)), height, width)
    assert mask_window(depth, camera, nothing) is None
