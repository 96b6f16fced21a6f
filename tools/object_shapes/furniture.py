"""07 chair and 10 stool."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from manifold3d import Manifold

from object_shapes.parts import Built, Part, box, disc, plate, revolve, rod, tube, union

OAK, DARK_OAK, LIGHT_OAK = (150, 98, 52), (108, 68, 36), (178, 124, 72)
TEAL, STEEL, GREY = (38, 118, 122), (150, 156, 164), (66, 70, 76)


def _facing_up(vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
    return normals[:, 2] > 0.3


def _square_rod(
    start: Sequence[float], end: Sequence[float], size: float, end_size: float
) -> Manifold:
    return tube([start, end], [size / np.sqrt(2), end_size / np.sqrt(2)], 4, side=(1, 0, 0))


def chair() -> Built:
    """Wooden chair: seat at 45 cm, 42 cm wide, back (towards +y) 86 cm high, rails and rungs."""
    outline = np.array([[-0.21, -0.21], [0.21, -0.21], [0.195, 0.20], [-0.195, 0.20]])
    seat = plate(outline, 0.030, 0.03).translate((0, 0, 0.42))
    parts = [Part("seat", seat.refine_to_length(0.045), LIGHT_OAK, _facing_up)]
    for x in (-0.18, 0.18):
        front = _square_rod((x, -0.18, 0.43), (x * 1.03, -0.19, 0.0), 0.040, 0.028)
        back_leg = _square_rod((x * 0.95, 0.175, 0.44), (x * 0.98, 0.215, 0.0), 0.040, 0.028)
        post = _square_rod((x * 0.95, 0.175, 0.40), (x * 0.95, 0.255, 0.850), 0.040, 0.030)
        rail = box((0.018, 0.36, 0.045), (x * 0.97, 0.0, 0.397))
        rung = rod((x * 1.0, -0.183, 0.18), (x * 0.965, 0.198, 0.18), 0.010, segments=8)
        parts += [
            Part("leg", front, OAK),
            Part("leg", back_leg, OAK),
            Part("post", post, OAK, lambda v, n: v[:, 2] > 0.55),
            Part("rail", rail, DARK_OAK),
            Part("rung", rung, DARK_OAK),
        ]
    parts += [
        Part("rail", box((0.35, 0.018, 0.045), (0, -0.178, 0.397)), DARK_OAK),
        Part("rail", box((0.34, 0.018, 0.045), (0, 0.176, 0.397)), DARK_OAK),
        Part("rung", rod((-0.178, 0.0, 0.18), (0.178, 0.0, 0.18), 0.010, segments=8), DARK_OAK),
    ]

    def slat(low: float, high: float, bow: float) -> Manifold:
        x = np.linspace(-0.175, 0.175, 9)
        middle = (low + high) / 2
        lean = 0.175 + 0.080 * (middle - 0.40) / 0.45
        y = lean + bow * (1 - (x / 0.175) ** 2)
        path = np.stack([x, y, np.full(9, middle)], 1)
        return tube(path, (high - low) / 2 * 1.3, 8, side=(0, 0.17, 1), flatten=0.28)

    for low, high in ((0.56, 0.61), (0.66, 0.71)):
        parts.append(Part("slat", slat(low, high, 0.020), OAK, True))
    parts.append(Part("top slat", slat(0.765, 0.855, 0.022), LIGHT_OAK, True))
    return union(parts, 0.055)


def stool() -> Built:
    """Round seat of 34 cm, top at 45 cm, four splayed legs and two levels of rungs."""
    rim = [
        (0.0, 0.0), (0.158, 0.0), (0.168, 0.008), (0.170, 0.022), (0.165, 0.033),
        (0.150, 0.038), (0.0, 0.038)
    ]  # fmt: skip
    seat = revolve(rim, 40).translate((0, 0, 0.412)).refine_to_length(0.03)
    parts = [Part("seat", seat, TEAL, lambda v, n: (n[:, 2] > 0.3) | (v[:, 2] > 0.425))]
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)

    def along(corner: np.ndarray, z: float) -> np.ndarray:
        reach = 0.165 - (0.165 - 0.100) * z / 0.43
        return np.array([*(corner * reach), z])

    for corner in corners:
        parts.append(
            Part("leg", rod(along(corner, 0.43), along(corner, 0.006), 0.0135, segments=10), STEEL)
        )
        foot = disc((*(corner * 0.165), 0.009), 2, 0.0175, 0.018, 12)
        parts.append(Part("foot", foot, GREY))
    for z, pairs in ((0.150, ((0, 1), (2, 3))), (0.210, ((1, 2), (3, 0)))):
        for a, b in pairs:
            parts.append(
                Part(
                    "rung",
                    rod(along(corners[a], z), along(corners[b], z), 0.0095, segments=8),
                    STEEL,
                    True,
                )
            )
    return union(parts, 0.038)
