"""Pictures of one capture: the fused cloud from two sides, and a slice by camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from intercap_core import artefacts
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.output.site import charts
from intercap_core.output.site.drawing import EncodedImage, encode_jpeg, encode_png, pinhole
from intercap_core.output.site.point_cloud import (
    FusedCloud,
    Viewpoint,
    fuse,
    measured_points,
    splat,
)

# A colour per camera, distinguishable on light and dark background
CAMERA_COLOURS = (
    "#4e9bde", "#f28e2b", "#59a14f", "#e15759", "#b07aa1", "#d4b13a", "#3fa7a3", "#ff7fa5",
    "#9c755f", "#8c8c8c", "#7570b3", "#a0c15a", "#c0448f", "#5b7fd1", "#c97b3d", "#4f8f74",
)  # fmt: skip
_GROUND = np.array((0.075, 0.086, 0.105), np.float32)  # RGB of the background
_INK, _SHADOW = (235, 235, 235), (10, 12, 16)  # RGB
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4  # fractional bits of the coordinates that OpenCV draws
# Name, azimuth from the first camera and elevation of each viewpoint, degrees
_SIDES = (("front", 22.0, 20.0), ("other side, from above", 200.0, 48.0))
_SLICE_SIZE = (840, 520)  # px
_SLICE_THICK_M = 0.05


def draw_capture(images: Frames, scene: artefacts.Artefact) -> dict[str, Any]:
    """Draw the frame set that most cameras recorded, nearest to the middle of the sequence.

    It is drawn before and after refinement if refinement changed a pose. Raises UserError if a
    recorded image does not decode.

    Returns:
        ``frame``: index of the drawn set.
        ``pictures``: rows of pictures, before and after; a row for each side, and one for the slice
            if two cameras measure points at the same height.
        ``profiles``: caption and chart of the floor, before and after; empty without a floor.
    """
    rig = Rig.from_artefact(scene)
    start = rig.moved(scene["master_from_colour_start"])
    bias = scene["depth_bias"]
    states = [("", rig, bias)]
    if not np.allclose(start.master_from_colour, rig.master_from_colour) or bias.any():
        states = [
            ("before refinement", start, np.zeros_like(bias)), ("after refinement", rig, bias)
        ]  # fmt: skip
    shown = images.showing(scene["image_of"])
    t = choose_set(shown)
    measured = measured_points(shown, rig, t)
    world = scene["zup_from_master"]
    clouds = [fuse(measured, cameras, world, shift) for _, cameras, shift in states]
    room = _ShownRoom(clouds[-1], rig, world)
    drawn = [
        (when, cameras, cloud.where(room.contains(cloud.points)))
        for (when, cameras, _), cloud in zip(states, clouds, strict=True)
    ]
    rows = [
        [room.picture(side, cloud, cameras, world, when) for when, cameras, cloud in drawn]
        for side in _SIDES
    ]
    chosen = _choose_slice(drawn[-1][-1], room.centre)
    if chosen is not None:
        rows.append([_draw_slice(cloud, *chosen, when) for when, _, cloud in drawn])
    profiles = {when: floor_profiles(cloud, room.centre) for when, _, cloud in drawn}
    floor = _profile_charts(profiles) if scene.attributes["ground_found"] else []
    return {"frame": t, "pictures": rows, "profiles": floor}


def choose_set(images: Frames) -> int:
    """Return the set with most depth images, nearest to the middle; without depth, colour."""
    count = images.depth_available.sum(1)
    if not count.any():
        count = images.colour_available.sum(1)
    best = np.flatnonzero(count == count.max())
    return int(best[np.argmin(np.abs(best - (len(count) - 1) / 2))])


def floor_profiles(cloud: FusedCloud, centre: np.ndarray) -> list[charts.Series]:
    """Return median heights (mm) of the floor along a strip (m) parallel to x, camera by camera.

    Five strips near ``centre`` (2,) are compared. The one with the fewest points between 0.08 and
    0.4 m above the floor is used, because such points belong to legs and furniture.
    """
    half_width, bin_m, highest = 0.15, 0.08, 0.08  # metres; points above are not floor
    height, offset = cloud.points[:, 2], cloud.points[:, 1] - centre[1]
    standing = offset[(height > highest) & (height < 0.4)]
    strips = (0.0, 0.3, -0.3, 0.6, -0.6)  # y of their middle from the centre, metres
    least = min(strips, key=lambda at: int((np.abs(standing - at) < half_width).sum()))
    low = (np.abs(height) < highest) & (cloud.normals[:, 2] > 0.9)
    low &= np.abs(offset - least) < half_width
    profiles = []
    for c in np.unique(cloud.camera[low]):
        points = cloud.points[low & (cloud.camera == c)]
        bins = np.floor((points[:, 0] - centre[0]) / bin_m).astype(int)
        order = np.lexsort((points[:, 2], bins))
        places, first, count = np.unique(bins[order], return_index=True, return_counts=True)
        kept = count >= 5  # fewer points give no reliable median
        middle = (first + count // 2)[kept]
        if kept.sum() >= 2:
            along = (places[kept] + 0.5) * bin_m
            height_mm = 1e3 * points[order][middle, 2].astype(float)
            profiles.append(charts.Series("", camera_colour(c), along, height_mm))
    return profiles


def _profile_charts(profiles: Mapping[str, Sequence[charts.Series]]) -> list[tuple[str, str]]:
    """Plot the floor before and after refinement with one scale: (caption, SVG)."""
    every = [line for lines in profiles.values() for line in lines]
    if not every:
        return []
    top = 10 * float(np.ceil(max(10.0, *(np.abs(line.y).max() for line in every)) / 10))
    low, high = (float(f(np.concatenate([line.x for line in every]))) for f in (np.min, np.max))
    axes = ("along the strip, m", low, high), ("height over the floor, mm", -top, top)
    name = "the floor along a strip near the middle"
    return [
        (_captioned(name, when), charts.line_chart(lines, *axes))
        for when, lines in profiles.items()
    ]


class _ShownRoom:
    """The part of the room that is shown, z up: a circle on the floor around ``centre`` (2,)."""

    def __init__(self, cloud: FusedCloud, rig: Rig, world_from_master: np.ndarray) -> None:
        eyes = apply(world_from_master, rig.master_from_colour[:, :3, 3])
        centre = np.median(cloud.points[:, :2], 0) if len(cloud.points) else eyes[:, :2].mean(0)
        reach = np.linalg.norm(eyes[:, :2] - centre, axis=1).max() + 0.35
        first = eyes[0, :2] - centre
        bright = float(np.percentile(cloud.colours, 98)) if len(cloud.colours) else 1.0
        self.centre = centre.astype(np.float64)
        self.radius = float(np.clip(reach, 1.0, 4.0))  # metres
        self.azimuth = float(np.arctan2(first[1], first[0]))  # of the first camera, radians
        self.gain = float(np.clip(0.95 / max(bright, 1e-3), 1, 1.5))  # brightens dark images

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return a mask (N,) of the points (N, 3) within the radius and -0.25 to 2.6 m high."""
        near = np.linalg.norm(points[:, :2] - self.centre.astype(points.dtype), axis=1)
        return (near < self.radius) & (points[:, 2] > -0.25) & (points[:, 2] < 2.6)

    def picture(
        self,
        side: tuple[str, float, float],
        cloud: FusedCloud,
        rig: Rig,
        world: np.ndarray,
        when: str,
    ) -> EncodedImage:
        """Draw the coloured cloud with the floor's grid and the cameras."""
        name, azimuth, elevation = side
        target, lens = np.append(self.centre, 0.65), pinhole(840, 560, 900.0)  # 0.65 m high
        places = [_frustum(camera, world @ camera.master_from_colour) for camera in rig]
        for distance in np.arange(2.2, 4.0, 0.1) * self.radius:  # the nearest that shows all
            view = Viewpoint.towards(
                target, self.azimuth + np.radians(azimuth), np.radians(elevation), distance, lens
            )
            if view.contains(np.concatenate(places), 24):
                break
        colours, depth = splat(cloud, view)
        colours *= self.gain
        picture = np.where(np.isfinite(depth)[..., None], colours, _GROUND)
        picture = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)
        self._draw_floor(picture, depth, view)
        for c, (camera, corners) in enumerate(zip(rig, places, strict=True)):
            _draw_frustum(picture, view, corners, c, camera.name)
        return encode_jpeg(picture / np.float32(255), _captioned(name, when))

    def _draw_floor(self, picture: np.ndarray, depth: np.ndarray, view: Viewpoint) -> None:
        """Blend the grid over the floor where it is visible."""
        cell_m = 0.5
        lines = np.arange(-np.floor(self.radius / cell_m), self.radius / cell_m) * cell_m
        layer = np.zeros(depth.shape, np.uint8)
        for offset in lines:
            half = np.sqrt(max(self.radius**2 - offset**2, 0))
            for axis in (0, 1):
                ends = np.zeros((2, 3))
                ends[:, :2] = self.centre
                ends[:, axis] += offset
                ends[:, 1 - axis] += (-half, half)
                _draw_lines(layer, view, ends[None], 255)
        rows, columns = np.nonzero(layer)
        local = np.column_stack([view.lens.rays[rows, columns], np.ones(len(rows))])
        up = view.view_from_world[:3, 2]
        # depth at which each pixel's ray meets the plane z = 0
        floor_z = -(view.eye[2]) / np.minimum(local @ up, -1e-6)
        shown = floor_z < depth[rows, columns] + 0.04
        share = 0.30 * layer[rows, columns][shown, None] / np.float32(255)
        at = (rows[shown], columns[shown])
        picture[at] = np.rint((1 - share) * picture[at] + share * 255)


def _frustum(camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Return apex and corners (5, 3) of a camera's viewing pyramid, 0.28 m long.

    ``pose``: (4, 4) transform of the camera to the frame of the result.
    """
    lens = camera.colour
    half = 0.5 * np.array([lens.width / lens.fx, lens.height / lens.fy])
    corners = [[x * half[0], y * half[1], 1] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return apply(pose, 0.28 * np.array([[0, 0, 0], *corners]))


def _draw_frustum(
    picture: np.ndarray, view: Viewpoint, corners: np.ndarray, c: int, name: str
) -> None:
    """Draw a camera's viewing pyramid in its colour, with its name above."""
    pairs = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
    at, z = view.project(corners)
    for shade, thick in ((_SHADOW, 3), (_rgb(c), 1)):
        _draw_lines(picture, view, corners[np.array(pairs)], shade, thick)
    if not (z > 0.1).all():
        return
    text = name[:12].encode("ascii", "replace").decode()
    (width, height), _ = cv2.getTextSize(text, _FONT, 0.5, 1)
    x, y = int(at[:, 0].mean()) - width // 2, int(at[:, 1].min()) - 8
    cv2.rectangle(picture, (x - 4, y - height - 4), (x + width + 4, y + 4), _SHADOW, -1)
    cv2.putText(picture, text, (x, y), _FONT, 0.5, _rgb(c), 1, cv2.LINE_AA)


def _draw_lines(
    picture: np.ndarray,
    view: Viewpoint,
    ends: np.ndarray,
    colour: int | tuple[int, ...],
    thick: int = 1,
) -> None:
    """Draw anti-aliased lines (N, 2, 3); lines that reach behind the viewer are skipped."""
    at, z = view.project(ends.reshape(-1, 3))
    kept = (z > 0.1).reshape(-1, 2).all(1) & (np.abs(at.reshape(-1, 4)).max(1) < 1e4)
    for a, b in np.rint(at.reshape(-1, 2, 2)[kept] * 2**_SHIFT).astype(int).tolist():
        cv2.line(picture, a, b, colour, thick, cv2.LINE_AA, _SHIFT)


def _choose_slice(cloud: FusedCloud, centre: np.ndarray) -> tuple[float, np.ndarray, float] | None:
    """Choose the height, from 0.3 to 1.7 m, at which most cameras see points near the centre.

    A camera counts with 40 points. Among equal heights, the one with most points is chosen. Returns
    height (m), middle (2,) (m) and scale (pixels per metre) of a picture; None if no two cameras
    see points at the same height.
    """
    near = np.abs(cloud.points[:, :2] - centre).max(1) < 0.9
    best, chosen = (1, 0), None
    for height in (0.1 * n for n in range(3, 18)):
        inside = near & (np.abs(cloud.points[:, 2] - height) < _SLICE_THICK_M / 2)
        counts = np.bincount(cloud.camera[inside])
        score = (int((counts >= 40).sum()), int(inside.sum()))
        if score[0] >= 2 and score > best:
            best, chosen = score, (height, cloud.points[inside, :2])
    if chosen is None:
        return None
    low, high = np.percentile(chosen[1], (1, 99), axis=0)
    extent = np.maximum(1.15 * (high - low), 0.5)
    return chosen[0], (low + high) / 2, float((np.array(_SLICE_SIZE) / extent).min())


def _draw_slice(
    cloud: FusedCloud, level: float, middle: np.ndarray, scale: float, when: str
) -> EncodedImage:
    """Draw the points at a height from above in their cameras' colours, with a scale."""
    inside = np.abs(cloud.points[:, 2] - level) < _SLICE_THICK_M / 2
    at = (cloud.points[inside, :2] - middle) * [scale, -scale]
    at = np.rint(2**_SHIFT * (at + np.array(_SLICE_SIZE) / 2)).astype(int)
    cameras = cloud.camera[inside]
    picture = np.full((*_SLICE_SIZE[::-1], 3), np.rint(_GROUND * 255), np.uint8)
    # Drawn in a pseudo-random order (multiplicative hash), so that no camera covers the others
    order = np.argsort(np.arange(len(at)) * 2654435761 % 2**32, kind="stable")
    for place, c in zip(at[order].tolist(), cameras[order].tolist(), strict=True):
        cv2.circle(picture, place, 2 << _SHIFT, _rgb(c), -1, cv2.LINE_AA, _SHIFT)
    x, y, bar = 18, _SLICE_SIZE[1] - 20, round(0.1 * scale)
    cv2.line(picture, (x, y), (x + bar, y), _INK, 2)
    cv2.putText(picture, "10 cm", (x, y - 8), _FONT, 0.5, _INK, 1, cv2.LINE_AA)
    name = _captioned(f"slice at {level:.1f} m", when)
    return encode_png(picture / np.float32(255), name)


def camera_colour(c: int) -> str:
    """Return the colour of a camera as "#rrggbb"."""
    return CAMERA_COLOURS[c % len(CAMERA_COLOURS)]


def _rgb(c: int) -> tuple[int, ...]:
    return tuple(bytes.fromhex(camera_colour(c)[1:]))


def _captioned(name: str, when: str) -> str:
    return f"{name}, {when}" if when else name
