"""02 skateboard, 03 football and 05 tennis racquet."""

from __future__ import annotations

import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold

from object_shapes.parts import Built, Part, box, disc, plate, rod, tube, union

BLACK, GREY, WHITE = (34, 34, 36), (150, 154, 160), (236, 236, 230)
WOOD, CREAM, YELLOW, RED = (172, 120, 70), (232, 222, 190), (236, 190, 40), (190, 40, 40)


def skateboard() -> Built:
    """80 x 20 cm deck with kicked ends and a slight concave, on two trucks and four wheels."""
    half_length, half_width, thickness = 0.40, 0.10, 0.011
    angle = np.radians(np.linspace(-90, 90, 15))
    nose = np.stack([0.30 + 0.105 * np.cos(angle), half_width * np.sin(angle)], 1)
    outline = np.vstack([nose, -nose])
    deck = plate(outline, thickness).refine_to_length(0.03)

    def bend(points: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        over = np.maximum(np.abs(x) - 0.245, 0)
        kick = np.tan(np.radians(22)) * over**2 / (over + 0.03)
        concave = 0.008 * (y / half_width) ** 2 * np.clip((0.32 - np.abs(x)) / 0.08, 0, 1)
        reach = half_length / 0.405
        return np.stack([x * reach, y, z + 0.092 + kick + concave], 1)

    deck = deck.warp_batch(bend)

    def on_top(vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return normals[:, 2] > 0.5

    def at_edge(vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return np.abs(vertices[:, 1]) > 0.085

    parts = [Part("deck", deck, WOOD, lambda v, n: on_top(v, n) | at_edge(v, n))]
    for x in (-0.205, 0.205):
        parts += [
            Part("base plate", box((0.075, 0.055, 0.012), (x, 0, 0.090)), GREY),
            Part("hanger", box((0.034, 0.060, 0.050), (x, 0, 0.064)), GREY),
            Part("axle", rod((x, -0.098, 0.026), (x, 0.098, 0.026), 0.008), GREY),
            Part("hanger", rod((x, -0.055, 0.030), (x, 0.055, 0.030), 0.016), GREY),
        ]
        for y in (-0.078, 0.078):
            parts.append(Part("wheel", disc((x, y, 0.026), 1, 0.026, 0.032, 20), CREAM))
    built = union(parts, 0.034)
    grip_tape = (np.all(built.colours == WOOD, axis=1)) & (_up(built) > 0.5)
    built.colours[grip_tape] = BLACK
    return built


def _up(built: Built) -> np.ndarray:
    mesh = trimesh.Trimesh(built.vertices, built.faces, process=False)
    return np.asarray(mesh.vertex_normals)[:, 2]


def football() -> Built:
    """22 cm in diameter; 642 vertices; the twelve pentagons black."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.110)
    # the flat triangles lie inside the sphere: grow until the volume is the sphere's
    growth = (4 / 3 * np.pi * 0.110**3 / ball.volume) ** (1 / 3)
    vertices = np.asarray(ball.vertices) * growth
    corners = np.asarray(trimesh.creation.icosahedron().vertices)
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    nearness = (vertices / np.linalg.norm(vertices, axis=1, keepdims=True) @ corners.T).max(1)
    colours = np.where((nearness > np.cos(np.radians(21.5)))[:, None], BLACK, WHITE)
    return Built(
        vertices, np.asarray(ball.faces), colours.astype(np.uint8), np.arange(len(vertices))
    )


def tennis_racquet() -> Built:
    """68.5 cm: head with pierced string bed, open throat, octagonal grip; z along the handle."""
    centre, half_width, half_height, radius = 0.505, 0.118, 0.168, 0.011
    turn = np.linspace(0, 2 * np.pi, 49)[:-1]
    ring = np.stack(
        [half_width * np.cos(turn), np.zeros(48), centre + half_height * np.sin(turn)], 1
    )
    head = tube(ring, radius, 8, closed=True, side=(0, 1, 0))

    strings = CrossSection()
    width = 0.0026
    for x in np.linspace(-0.10, 0.10, 11):
        strings += CrossSection.square((width, 0.4), True).translate((x, 0))
    for z in np.linspace(-0.15, 0.15, 15):
        strings += CrossSection.square((0.3, width), True).translate((0, z))
    oval = CrossSection(
        [np.stack([half_width * np.cos(turn), half_height * np.sin(turn)], 1).tolist()]
    )
    bed = Manifold.extrude(strings ^ oval, width).translate((0, 0, -width / 2))
    bed = bed.rotate((90, 0, 0)).translate((0, 0, centre))

    # the two arms of the throat leave the head where its slope matches theirs
    arms = []
    for sign in (-1, 1):
        start = np.array([0.0095 * sign, 0, 0.185])
        end = np.array(
            [
                half_width * np.cos(np.radians(-128 if sign < 0 else -52)),
                0,
                centre + half_height * np.sin(np.radians(-52)),
            ]
        )
        bow = np.array([0.030 * sign, 0, 0.260])
        s = np.linspace(0, 1, 7)[:, None]
        arms.append(
            tube(
                (1 - s) ** 2 * start + 2 * s * (1 - s) * bow + s**2 * end, radius, 8, side=(0, 1, 0)
            )
        )
    shaft = rod((0, 0, 0.170), (0, 0, 0.200), 0.0150, 0.0170, 8)
    grip = rod((0, 0, 0.004), (0, 0, 0.180), 0.0172, 0.0158, 8)
    butt = rod((0, 0, 0.0), (0, 0, 0.012), 0.0205, 0.0195, 8)
    parts = [
        Part("strings", bed, CREAM),
        Part("throat", arms[0] + arms[1], RED),
        Part("shaft", shaft, RED),
        Part("head", head, RED, lambda v, n: v[:, 2] > centre + 0.10),
        Part("grip", grip.refine_to_length(0.012), BLACK, True),
        Part("butt", butt, BLACK, True),
    ]
    return union(parts, 0.030)
