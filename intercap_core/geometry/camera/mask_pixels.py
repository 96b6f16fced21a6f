"""The depth pixels that show what a mask of the colour image covers."""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.camera import mask_pixels_kernel
from intercap_core.geometry.camera.clouds import CELL_SPACINGS, HIDDEN_BEHIND_M
from intercap_core.geometry.camera.masks import Runs
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply

Window = tuple[slice, slice]

_PROBED_M = (0.7, 2.0, 6.0)  # depths at which the window's corners are looked for
_WINDOW_MARGIN_PX = 6
_NO_BACKGROUND = np.zeros((0, 0), np.uint16)


def mask_window(depth: np.ndarray, camera: Camera, mask: Runs) -> Window | None:
    """The rows and columns of the depth image (H, W) that can show the mask: its box, through both
    lenses; None where there are none."""
    x, y, w, h = mask.box
    if w == 0 or camera.depth is None or camera.colour_from_depth is None:
        return None
    corners = np.array([[x + i * w / 4, y + j * h / 4] for i in range(5) for j in range(5)])
    rays = camera.colour.unproject(corners)
    rays = rays[np.isfinite(rays).all(1)]
    depth_from_colour = np.linalg.inv(camera.colour_from_depth)
    placed = np.concatenate([apply(depth_from_colour, z * rays) for z in _PROBED_M])
    pixels = camera.depth.project(placed)
    height, width = depth.shape
    x0, y0 = np.floor(pixels.min(0)).astype(int) - _WINDOW_MARGIN_PX
    x1, y1 = np.ceil(pixels.max(0)).astype(int) + _WINDOW_MARGIN_PX
    rows = slice(max(int(y0), 0), min(int(y1), height))
    columns = slice(max(int(x0), 0), min(int(x1), width))
    return None if rows.start >= rows.stop or columns.start >= columns.stop else (rows, columns)


def mask_pixels(
    depth: np.ndarray,
    camera: Camera,
    mask: Runs,
    window: Window,
    *,
    background: np.ndarray | None = None,
    before_m: float = 0.0,
    every: int = 1,
) -> np.ndarray:
    """Flat pixels (M,), ascending, of one depth image (H, W) mm, within ``window``, that show what
    the mask, which is not empty, covers.

    A depth pixel counts when the colour pixel that shows the same surface lies in the mask. With a
    ``background`` (H, W) mm, 0 = not known, only what is ``before_m`` nearer counts, and nothing
    else hides anything. Every ``every``-th pixel of as many rows is looked at; all of them hide.
    """
    assert camera.depth is not None and camera.colour_from_depth is not None
    colour, (rows, columns) = camera.colour, window
    spacing = max(colour.fx / camera.depth.fx, colour.fy / camera.depth.fy, 1.0)
    return mask_pixels_kernel.mask_pixels(
        depth,
        _NO_BACKGROUND if background is None else background,
        int(1000 * before_m),
        (rows.start, rows.stop),
        (columns.start, columns.stop),
        every,
        camera.depth.rays,
        camera.colour_from_depth.astype(np.float32),
        tuple(colour.parameters.astype(np.float32)),
        (colour.height, colour.width),
        mask.ends,
        mask.box,
        np.float32(CELL_SPACINGS * spacing),
        # on the colour grid nothing hides: the pixels are the colour image's
        np.float32(np.inf if camera.aligned else HIDDEN_BEHIND_M),
    )
