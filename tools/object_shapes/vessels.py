"""04 umbrella, 08 bottle and 09 cup."""

from __future__ import annotations

import numpy as np

from object_shapes.parts import Built, Part, arc, revolve, ring_stack, rod, tube, union

NAVY, DARK_NAVY, WOOD, STEEL = (30, 40, 92), (20, 26, 62), (126, 74, 36), (170, 174, 180)
GREEN, WHITE, PALE, ORANGE = (40, 118, 78), (238, 236, 228), (206, 222, 208), (214, 108, 44)


def umbrella() -> Built:
    """Closed, tip down: ferrule, eight furled pleats, shaft, crook; 90 cm along z."""
    heights = np.array([0.060, 0.10, 0.22, 0.40, 0.56, 0.645, 0.660])
    radii = np.array([0.008, 0.013, 0.022, 0.030, 0.034, 0.036, 0.026])
    canopy = ring_stack(heights, radii, lobes=8, depth=0.24, twist_deg=50)
    ferrule = rod((0, 0, 0.0), (0, 0, 0.075), 0.0035, 0.0055, 10)
    shaft = rod((0, 0, 0.640), (0, 0, 0.745), 0.0055, segments=10)
    collar = rod((0, 0, 0.735), (0, 0, 0.750), 0.0125, segments=14)
    strap = rod((0, 0, 0.435), (0, 0, 0.455), 0.0335, segments=20)
    bend = arc((0.048, 0, 0.841), 0.048, 180, -10, 15)
    handle = tube(
        np.vstack([[0, 0, 0.738], [0, 0, 0.770], [0, 0, 0.805], bend]), 0.0110, 12, side=(0, 1, 0)
    )
    parts = [
        Part("shaft", shaft, STEEL, True),
        Part("canopy", canopy, NAVY),
        Part("ferrule", ferrule, STEEL),
        Part("strap", strap, DARK_NAVY, True),
        Part("handle", handle, WOOD, True),
        Part("collar", collar, STEEL, True),
    ]
    return union(parts, 0.028)


def bottle() -> Built:
    """26 cm, 7 cm in diameter, closed by its cap."""
    body = revolve([
        (0.0, 0.004), (0.022, 0.004), (0.026, 0.0), (0.032, 0.002), (0.035, 0.008),
        (0.035, 0.150), (0.0335, 0.163), (0.029, 0.178), (0.0225, 0.194), (0.0165, 0.208),
        (0.0145, 0.218), (0.0145, 0.238), (0.0, 0.238)
    ], 32)  # fmt: skip
    label = revolve([(0.0, 0.055), (0.0353, 0.055), (0.0353, 0.125), (0.0, 0.125)], 32)
    cap = revolve([
        (0.0, 0.234), (0.0155, 0.234), (0.0165, 0.236), (0.0165, 0.257), (0.0150, 0.260),
        (0.0, 0.260)
    ], 24)  # fmt: skip

    def wall(vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return np.abs(normals[:, 2]) < 0.9

    parts = [
        Part("body", body, GREEN, wall),
        Part("label", label, WHITE, wall),
        Part("cap", cap, ORANGE, True),
    ]
    return union(parts, 0.020)


def cup() -> Built:
    """Mug: 9.5 cm high, 8 cm in diameter, wall 3.5 mm, floor 5 mm, handle towards +x."""
    outer, inner = 0.040, 0.0365
    solid = revolve([
        (0.0, 0.002), (0.030, 0.002), (0.032, 0.0), (0.037, 0.0), (outer, 0.004),
        (outer, 0.0935), (outer - 0.0008, 0.095), (0.0, 0.095)
    ], 40)  # fmt: skip
    hollow = revolve([
        (0.0, 0.007), (inner - 0.004, 0.007), (inner, 0.012), (inner, 0.0935),
        (inner + 0.001, 0.096), (0.0, 0.096)
    ], 40)  # fmt: skip
    wall = solid - hollow
    ear = np.vstack(
        [[0.0375, 0, 0.080], arc((0.042, 0, 0.0495), 0.0295, 80, -80, 13), [0.0375, 0, 0.019]]
    )
    handle = tube(ear, 0.0058, 10, side=(0, 1, 0), flatten=0.8)
    # the handle must not reach into the hollow
    handle = handle - revolve(
        [(0.0, -0.1), (inner + 0.001, -0.1), (inner + 0.001, 0.2), (0.0, 0.2)], 40
    )

    def held(vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
        radius = np.linalg.norm(vertices[:, :2], axis=1)
        outside = (radius > outer - 0.0015) & (vertices[:, 2] > 0.008)
        return outside | (vertices[:, 2] > 0.090)

    band = revolve([
        (inner + 0.001, 0.040), (outer + 0.0003, 0.040), (outer + 0.0003, 0.052),
        (inner + 0.001, 0.052)
    ], 40)  # fmt: skip
    parts = [
        Part("wall", wall, PALE, held),
        Part("band", band, ORANGE, held),
        Part("handle", handle, PALE, True),
    ]
    return union(parts, 0.0125)
