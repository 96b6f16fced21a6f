"""01 suitcase and 06 toolbox: boxes carried by handles with room for fingers."""

from __future__ import annotations

import numpy as np
from manifold3d import Manifold

from object_shapes.parts import Built, Part, box, disc, rod, rounded_box, tube, union

RED, DARK_RED = (178, 28, 34), (128, 18, 24)
BLACK, GREY, SILVER = (32, 32, 34), (96, 98, 102), (176, 180, 186)
BLUE, DARK_BLUE, YELLOW = (28, 72, 152), (20, 48, 104), (226, 178, 32)


def _handle(
    half_span: float, rise: float, thickness: float, flatten: float, segments: int = 10
) -> Manifold:
    """A flat arch in the x-z plane from (-half_span, 0) to (half_span, 0), ``rise`` high."""
    corner = min(rise, half_span) * 0.6
    turn = np.linspace(0, np.pi / 2, 5)
    left = np.stack(
        [-half_span + corner * (1 - np.cos(turn)), rise - corner * (1 - np.sin(turn))], 1
    )
    path = np.vstack([[-half_span, -0.012], left, left[::-1] * (-1, 1), [half_span, -0.012]])
    path3 = np.stack([path[:, 0], np.zeros(len(path)), path[:, 1]], 1)
    return tube(path3, thickness, segments, side=(0, 1, 0), flatten=flatten)


def suitcase() -> Built:
    """Cabin trolley: 55 cm high with wheels and top handle, 40 cm wide with the side handle."""
    bottom, top, half_width, depth = 0.045, 0.510, 0.18, 0.215
    height = top - bottom
    middle = (bottom + top) / 2
    shell = rounded_box((2 * half_width, depth, height), (0, 0, middle), 0.03, 12)
    for x in np.linspace(-0.115, 0.115, 4):
        for y in (-depth / 2, depth / 2):
            shell -= box((0.010, 0.006, height - 0.12), (x, y, middle))
    seam = rounded_box((2 * half_width + 0.004, 0.014, height + 0.004), (0, 0, middle), 0.005, 8)
    top_handle = _handle(0.075, 0.041, 0.013, 0.6).translate((0, 0, top - 0.003))
    side_handle = (
        _handle(0.070, 0.041, 0.013, 0.6)
        .rotate((0, 90, 0))
        .translate((half_width - 0.003, 0, middle))
    )
    bar = rounded_box((0.19, 0.024, 0.020), (0, -depth / 2 + 0.034, top + 0.006), 0.008, 8)
    parts = [Part("shell", shell, RED), Part("seam", seam, DARK_RED)]
    for x in (-0.135, 0.135):
        for y in (-0.072, 0.072):
            fork = box((0.026, 0.030, 0.030), (x, y, 0.042))
            parts.append(Part("fork", fork, GREY))
            for side in (-0.0135, 0.0135):
                parts.append(Part("wheel", disc((x + side, y, 0.022), 0, 0.022, 0.014, 14), BLACK))
    parts += [
        Part("trolley bar", bar, BLACK, True),
        Part("top handle", top_handle, BLACK, True),
        Part("side handle", side_handle, BLACK, True),
    ]
    return union(parts, 0.045)


def toolbox() -> Built:
    """40 x 20 x 20 cm with the handle over the lid; 35 mm of room under the grip."""
    tray = rounded_box((0.392, 0.190, 0.105), (0, 0, 0.0525), 0.012, 8)
    rim = rounded_box((0.400, 0.200, 0.016), (0, 0, 0.103), 0.006, 8)
    lid = rounded_box((0.388, 0.186, 0.052), (0, 0, 0.111), 0.016, 12)
    grip = rod((-0.085, 0, 0.186), (0.085, 0, 0.186), 0.014, segments=14)
    parts = [Part("tray", tray, BLUE), Part("lid", lid, DARK_BLUE), Part("rim", rim, DARK_BLUE)]
    for x in (-0.10, 0.10):
        latch = rounded_box((0.040, 0.012, 0.036), (x, -0.098, 0.099), 0.004, 8)
        parts.append(Part("latch", latch, SILVER, True))
    for x in (-0.092, 0.092):
        post = rounded_box((0.022, 0.036, 0.078), (x, 0, 0.161), 0.008, 8)
        parts.append(Part("post", post, YELLOW))
    parts.append(Part("grip", grip, YELLOW, True))
    return union(parts, 0.024)
