"""The room: floor, walls and furniture with procedural looks; all of it static.

Materials give the colour of a surface point from its place alone, so the same wall looks the same
in every camera. Colours are RGB in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from intercap_core.studio.skeleton import about_z

FLOOR_HALF_M = 6.0  # half the side of the floor


@dataclass(frozen=True)
class Box:
    """A piece of static furniture: an upright box."""

    low: tuple[float, float, float]
    """Lower corner before the rotation, metres."""
    high: tuple[float, float, float]
    """Upper corner before the rotation, metres."""
    heading: float = 0.0
    """Rotation about the vertical through its middle, rad."""
    material: str = "wood"
    """Name of its look in :func:`_look`."""

    def moved(self, transform: np.ndarray) -> Box:
        """The box rotated about the vertical and shifted by a transform (4, 4)."""
        middle = (np.array(self.low) + self.high) / 2
        shift = transform[:3, :3] @ middle + transform[:3, 3] - middle
        low, high = np.array(self.low) + shift, np.array(self.high) + shift
        turned = np.arctan2(transform[1, 0], transform[0, 0])
        return Box(tuple(low), tuple(high), self.heading + float(turned), self.material)


Mesh = tuple[np.ndarray, np.ndarray]  # vertices (V, 3) and faces (F, 3)
Furnishing = Literal["furnished", "sparse", "bare"]


@dataclass(frozen=True)
class Room:
    """Static surfaces in the stage frame."""

    vertices: np.ndarray
    """(V, 3)."""
    faces: np.ndarray
    """(F, 3)."""
    material: np.ndarray
    """(F,) index of ``materials``."""
    materials: tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], ...]
    """Functions of points (N, 3) and normals (N, 3) to colours (N, 3)."""
    distractor: int
    """Material of an object that detectors take for the tracked one, or -1."""


def build_room(
    rng: np.random.Generator,
    furniture: Sequence[Box],
    eyes: np.ndarray,
    *,
    furnishing: Furnishing,
    twin: Mesh | None = None,
    hidden: np.ndarray | None = None,
) -> Room:
    """Make a room around the stage with the script's ``furniture``.

    Args:
        eyes: (C, 2) places of the cameras; their view of the middle stays free.
        furnishing: "bare" adds only a floor, "sparse" also two low pieces, "furnished" walls,
            posters and five pieces.
        twin: mesh of another object of the tracked object's class, to stand in the room.
        hidden: (2,) place that a few pillars hide from some cameras.
    """
    boxes, mesh = list(furniture), None
    if furnishing == "sparse":
        boxes += [
            replace(box, high=(*box.high[:2], box.high[2] / 2)) for box in _pieces(rng, eyes)[1:3]
        ]
    elif furnishing == "furnished":
        boxes += _walls(rng) + _pieces(rng, eyes)
        if hidden is not None:
            boxes += _pillars(rng, eyes, hidden)
        if twin is not None:
            stand, mesh = _twin(rng, eyes, *twin)
            boxes += stand
    corners = np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)]) * FLOOR_HALF_M
    surfaces = [("floor", corners, np.array([[0, 2, 1], [1, 2, 3]]))]
    surfaces += [(box.material, *_box_mesh(box)) for box in boxes]
    surfaces += [("distractor", *mesh)] if mesh is not None else []
    names = list(dict.fromkeys(name for name, _, _ in surfaces))
    first = np.cumsum([0, *(len(vertices) for _, vertices, _ in surfaces)])
    return Room(
        np.vstack([vertices for _, vertices, _ in surfaces]),
        np.vstack([faces + start for (*_, faces), start in zip(surfaces, first, strict=False)]),
        np.concatenate([np.full(len(faces), names.index(name)) for name, _, faces in surfaces]),
        tuple(_look(name, rng) for name in names),
        names.index("distractor") if mesh is not None else -1,
    )


def _walls(rng: np.random.Generator) -> list[Box]:
    """Two or three walls, 3.0 to 3.7 m from the middle, each with a poster."""
    walls = []
    heading = rng.uniform(0, 2 * np.pi)
    for turn_by in (0, np.pi / 2, np.pi)[: int(rng.integers(2, 4))]:
        far = rng.uniform(3.0, 3.7)
        angle = heading + turn_by
        x, y = far * np.cos(angle), far * np.sin(angle)
        walls.append(Box((x - 0.05, y - 4.0, 0.0), (x + 0.05, y + 4.0, 2.7), angle, "wall"))
        px, py = (far - 0.06) * np.cos(angle), (far - 0.06) * np.sin(angle)
        side = rng.uniform(-1.2, 1.2)
        px, py = px - side * np.sin(angle), py + side * np.cos(angle)
        low, high = (px - 0.015, py - 0.45, 1.0), (px + 0.015, py + 0.45, 1.7)
        walls.append(Box(low, high, angle, "poster"))
    return walls


def _pieces(rng: np.random.Generator, eyes: np.ndarray) -> list[Box]:
    """Shelves, boxes and a table, between the cameras and outside the ring of action."""
    between, gaps = _between(eyes)
    pieces = []
    for index, kind in enumerate(("shelf", "cardboard", "wood", "cardboard", "wood")):
        size = {
            "shelf": (0.13, 0.36, rng.uniform(0.9, 1.3)),
            "cardboard": (rng.uniform(0.15, 0.25), rng.uniform(0.15, 0.3), rng.uniform(0.25, 0.6)),
            "wood": (rng.uniform(0.22, 0.3), rng.uniform(0.25, 0.4), rng.uniform(0.4, 0.7)),
        }[kind]
        gap = index % len(between)
        angle = between[gap] + gaps[gap] * rng.uniform(-0.12, 0.12)
        if len(between) < 6:
            angle += np.pi / 3 * (index // len(between))
        far = rng.uniform(1.85, 2.2) + (0.25 if kind == "shelf" else 0.0)
        x, y = far * np.cos(angle), far * np.sin(angle)
        pieces.append(
            Box((x - size[0], y - size[1], 0), (x + size[0], y + size[1], size[2]), angle, kind)
        )
    return pieces


def _between(eyes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuths (C,) in the middle between neighbouring cameras, and the width of each gap."""
    azimuths = np.sort(np.arctan2(eyes[:, 1], eyes[:, 0]))
    gaps = np.diff(np.append(azimuths, azimuths[0] + 2 * np.pi))
    return azimuths + gaps / 2, gaps


def _twin(
    rng: np.random.Generator, eyes: np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> tuple[list[Box], Mesh]:
    """The twin at another scale, and the box on which it stands."""
    between, gaps = _between(eyes)
    gap = int(rng.integers(len(between)))
    angle = between[gap] + gaps[gap] * rng.uniform(-0.2, 0.2)
    far, heading = rng.uniform(1.5, 1.75), rng.uniform(0, 2 * np.pi)
    points = rng.choice((0.87, 0.94, 1.07, 1.15)) * vertices
    x, y = far * np.cos(angle), far * np.sin(angle)
    stand = []
    height = 0.0
    if np.ptp(points[:, 2]) < 0.35:
        height = rng.uniform(0.45, 0.75)
        half = 0.03 + np.abs(points[:, :2]).max()
        stand.append(Box((x - half, y - half, 0), (x + half, y + half, height), angle, "cardboard"))
    turned = points @ about_z(heading).T
    place = np.array([x, y, height - points[:, 2].min()])
    return stand, (turned + place, faces)


def _pillars(rng: np.random.Generator, eyes: np.ndarray, place: np.ndarray) -> list[Box]:
    """Pillars that hide ``place`` (2,) from some of the cameras."""
    count = min(int(rng.integers(1, 4)), len(eyes) // 2)
    pillars = []
    for eye in eyes[rng.permutation(len(eyes))[:count]]:
        towards = eye - place
        far, half = rng.uniform(1.2, 1.5), rng.uniform(0.03, 0.05)
        x, y = place + towards / np.linalg.norm(towards) * far
        low, high = (x - half, y - half, 0.0), (x + half, y + half, 1.9)
        pillars.append(Box(low, high, float(np.arctan2(towards[1], towards[0])), "wood"))
    return pillars


def _box_mesh(box: Box) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (8, 3) and faces (12, 3) of a box."""
    low, high = np.array(box.low), np.array(box.high)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    corners = low + corners * (high - low)
    middle = (low + high)[:2] / 2
    cos, sin = np.cos(box.heading), np.sin(box.heading)
    turned = (corners[:, :2] - middle) @ np.array([[cos, sin], [-sin, cos]])
    corners[:, :2] = middle + turned
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return corners, np.array(faces)


NOISE_TABLE = np.random.default_rng(0).random((256, 256)).astype(np.float32)


def value_noise(points: np.ndarray, scale: float, seed: int) -> np.ndarray:
    """Smooth pseudo-random values in [0, 1] of points (N, 3); they change over ``scale`` metres.

    Values are interpolated in a periodic table along two slanted directions, so that no wall looks
    striped.
    """
    start = np.random.default_rng(seed).uniform(0, 256, 2)
    u = (points[:, 0] + 0.53 * points[:, 2]) / scale + start[0]
    v = (points[:, 1] - 0.71 * points[:, 2]) / scale + start[1]
    width = 1024
    rows = -(-len(points) // width)
    at = np.zeros((2, rows * width), np.float32)
    at[0, : len(points)], at[1, : len(points)] = u % 256, v % 256
    maps = at.reshape(2, rows, width)
    values = np.empty((rows, width), np.float32)
    for top in range(0, rows, 16384):  # the look-up takes images of up to 32767 rows
        part = slice(top, top + 16384)
        values[part] = cv2.remap(
            NOISE_TABLE, maps[0, part], maps[1, part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        )
    return values.ravel()[: len(points)]


def _hash(cell: np.ndarray, seed: int) -> np.ndarray:
    """A value in [0, 1] for each cell (N, 3) of integers."""
    start = np.random.default_rng(seed).integers(0, 256, 2)
    i = cell[:, 0] * 7 + cell[:, 2] * 101 + start[0]
    j = cell[:, 1] * 13 + cell[:, 2] * 57 + start[1]
    return NOISE_TABLE[i & 255, j & 255]


def _look(name: str, rng: np.random.Generator) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """The function of a material that returns colours (N, 3) of points and normals (N, 3).

    Its numbers are sizes of the pattern, metres, and colours, chosen by eye.
    """
    seed = int(rng.integers(1 << 30))
    tint = rng.uniform(-0.06, 0.06, 3)

    def grain(points: np.ndarray, *scales: float) -> np.ndarray:
        layers = [value_noise(points, s, seed + i) - 0.5 for i, s in enumerate(scales)]
        return np.sum(layers, 0)

    def floor(p: np.ndarray, n: np.ndarray) -> np.ndarray:
        plank = np.floor(p[:, 0] / 0.14)
        along = p[:, 1] + 0.7 * np.sin(plank * 12.9898)
        board = np.stack([plank, np.floor(along / 1.1), 0 * plank], 1).astype(np.int64)
        shade = 0.80 + 0.25 * (_hash(board, seed) - 0.5)
        shade = shade + 0.10 * grain(p * (1, 0.12, 1), 0.02, 0.006)
        edge = np.minimum(p[:, 0] / 0.14 % 1, 1 - p[:, 0] / 0.14 % 1) * 0.14
        shade = shade * np.where(edge < 0.002, 0.55, 1.0)
        return np.clip(shade[:, None] * (np.array([0.60, 0.45, 0.32]) + tint), 0, 1)

    def wall(p: np.ndarray, n: np.ndarray) -> np.ndarray:
        shade = 0.86 + 0.05 * grain(p, 0.5, 0.05) + 0.03 * grain(p, 0.008)
        skirting = np.where(p[:, 2] < 0.09, 0.5, 1.0)
        return np.clip((shade * skirting)[:, None] * (np.array([0.86, 0.86, 0.82]) + tint), 0, 1)

    def poster(p: np.ndarray, n: np.ndarray) -> np.ndarray:
        channels = [value_noise(p, 0.16, seed + i) > 0.5 for i in range(3)]
        return 0.2 + 0.6 * np.stack(channels, 1) + 0.1 * grain(p, 0.02)[:, None]

    def wood(p: np.ndarray, n: np.ndarray) -> np.ndarray:
        rings = np.sin(60 * (p[:, 0] + 0.5 * p[:, 2]) + 6 * grain(p, 0.15))
        shade = 0.75 + 0.08 * rings + 0.08 * grain(p, 0.01)
        return np.clip(shade[:, None] * (np.array([0.66, 0.50, 0.34]) + tint), 0, 1)

    def shelf(p: np.ndarray, n: np.ndarray) -> np.ndarray:
        board = p[:, 2] % 0.32 < 0.025
        book = np.floor((p[:, 0] + p[:, 1]) / 0.035).astype(np.int64)
        row = np.floor(p[:, 2] / 0.32).astype(np.int64)
        colour = np.stack(
            [_hash(np.stack([book, row, 0 * book + k], 1), seed) for k in range(3)], 1
        )
        return np.where(board[:, None], (0.45, 0.35, 0.27), 0.15 + 0.6 * colour)

    def cardboard(p: np.ndarray, n: np.ndarray) -> np.ndarray:
        shade = 0.8 + 0.06 * np.sin(p[:, 2] * 900) + 0.15 * grain(p, 0.08, 0.01)
        return np.clip(shade[:, None] * (np.array([0.70, 0.55, 0.38]) + tint), 0, 1)

    def distractor(p: np.ndarray, n: np.ndarray) -> np.ndarray:
        stripes = (p[:, 2] % 0.08 < 0.012)[:, None]
        return np.where(stripes, 0.10, np.clip(np.array([0.50, 0.14, 0.16]) + 2 * tint, 0, 1))

    looks = {"floor": floor, "wall": wall, "poster": poster, "wood": wood, "shelf": shelf,
             "cardboard": cardboard, "distractor": distractor}  # fmt: skip
    return looks[name]
