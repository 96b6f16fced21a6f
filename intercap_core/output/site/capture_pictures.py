"""Pictures of one capture: the fused cloud from two sides, and a slice by camera."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core import artefacts
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.output.site.drawing import EncodedImage, encode_jpeg
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
_GROUND = np.array((0.075, 0.086, 0.105), np.float32)
_SIZE = (840, 560)
_FOCAL = 900.0
_SIDES = (("front", 22.0, 20.0), ("other side, from above", 200.0, 48.0))  # from the master, deg
_MARGIN_M = 0.35  # shown around the ring of cameras
_LARGEST_M, _SMALLEST_M = 4.0, 1.0  # limits of the shown radius
_FLOOR_M, _TOP_M = -0.25, 2.6  # limits of the shown heights
_AIM_M = 0.65  # height at the centre of the pictures
_CELL_M = 0.5  # spacing of the floor's grid
_DISTANCES = np.arange(2.2, 4.0, 0.1)  # viewing distances in radii, the nearest that fits is used
_BORDER_PX = 24
_FRUSTUM_M = 0.28
_NEAR_M = 0.1
_LONGEST_NAME = 12
_MOST_GAIN = 1.5
_SLICE_HALF_M, _SLICE_LEAST_M, _SLICE_MARGIN = 0.9, 0.5, 1.15
_SLICE_THICK_M = 0.05
_SLICE_SIZE = (840, 520)
_SLICE_HEIGHTS_M = tuple(0.1 * n for n in range(3, 18))
_FEW_IN_SLICE = 40
_SCALE_BAR_M = 0.1
_DOT_PX = 2
_STRIP_M, _STRIP_BIN_M, _STRIP_HEIGHT_M = 0.3, 0.08, 0.08
_STRIPS_M = (0.0, 0.3, -0.3, 0.6, -0.6)  # y of candidate strips from the centre
_STANDING_M = 0.4  # points up to this height are objects on the strip
_FEW_IN_BIN = 5
_INK, _SHADOW = (235, 235, 235), (10, 12, 16)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4  # fractional bits of the coordinates that OpenCV draws


@dataclass(frozen=True, eq=False)
class FloorProfile:
    """Height over the floor along a strip, as one camera measures it."""

    c: int
    """Index of the camera."""
    along: np.ndarray
    """(N,) position along the strip, metres."""
    height: np.ndarray
    """(N,) metres."""


@dataclass(frozen=True, eq=False)
class CapturePictures:
    """Pictures of one frame set, before and after refinement."""

    frame: int
    when: tuple[str, ...]
    """("before", "after"), or ("",) if refinement changed nothing."""
    views: tuple[tuple[EncodedImage, ...], ...]
    """By side, then by ``when``."""
    slice_: tuple[EncodedImage, ...]
    """By ``when``; empty if no two cameras measure points at the same height."""
    profiles: tuple[tuple[FloorProfile, ...], ...]
    """By ``when``, then by camera; empty without a floor."""


def draw_capture(images: Frames, scene: artefacts.Artefact) -> CapturePictures:
    """Draw the frame set that most cameras recorded, nearest to the middle of the sequence.

    It is drawn before and after refinement if refinement changed a pose. Raises UserError if a
    recorded image does not decode.
    """
    rig = Rig.from_artefact(scene)
    start = rig.moved(scene["master_from_colour_start"])
    bias = scene["depth_bias"]
    changed = not np.allclose(start.master_from_colour, rig.master_from_colour) or bias.any()
    states = [("before", start, np.zeros_like(bias))] if changed else []
    states.append(("after" if changed else "", rig, bias))
    shown = images.showing(scene["image_of"])
    t = choose_set(shown)
    measured = measured_points(shown, rig, t)
    world = scene["zup_from_master"]
    clouds = [fuse(measured, cameras, world, shift) for _, cameras, shift in states]
    room = _ShownRoom.around(clouds[-1], rig, world)
    clouds = [cloud.where(room.contains(cloud.points)) for cloud in clouds]
    level = Slice.of(clouds[-1], room.centre)
    words = [f"{when} refinement" if when else "" for when, *_ in states]
    return CapturePictures(
        frame=t,
        when=tuple(when for when, *_ in states),
        views=tuple(
            tuple(
                room.picture(side, cloud, cameras, world, word)
                for cloud, (_, cameras, _), word in zip(clouds, states, words, strict=True)
            )
            for side in _SIDES
        ),
        slice_=tuple(
            level.picture(cloud, word) for cloud, word in zip(clouds, words, strict=True) if level
        ),
        profiles=tuple(tuple(floor_profiles(cloud, room.centre)) for cloud in clouds)
        if scene.attributes["ground_found"]
        else (),
    )


def choose_set(images: Frames) -> int:
    """Return the set with most depth images, nearest to the middle; without depth, colour."""
    count = images.depth_available.sum(1)
    if not count.any():
        count = images.colour_available.sum(1)
    best = np.flatnonzero(count == count.max())
    return int(best[np.argmin(np.abs(best - (len(count) - 1) / 2))])


def floor_profiles(cloud: FusedCloud, centre: np.ndarray) -> list[FloorProfile]:
    """Return median heights of the floor along a strip parallel to x, camera by camera.

    The strip is near ``centre`` (2,), where the fewest points are above the floor.
    """
    height, offset = cloud.points[:, 2], cloud.points[:, 1] - centre[1]
    standing = offset[(height > _STRIP_HEIGHT_M) & (height < _STANDING_M)]
    least = min(_STRIPS_M, key=lambda at: int((np.abs(standing - at) < _STRIP_M / 2).sum()))
    low = (np.abs(height) < _STRIP_HEIGHT_M) & (cloud.normals[:, 2] > 0.9)
    low &= np.abs(offset - least) < _STRIP_M / 2
    profiles = []
    for c in np.unique(cloud.camera[low]):
        points = cloud.points[low & (cloud.camera == c)]
        bins = np.floor((points[:, 0] - centre[0]) / _STRIP_BIN_M).astype(int)
        order = np.lexsort((points[:, 2], bins))
        places, first, count = np.unique(bins[order], return_index=True, return_counts=True)
        kept = count >= _FEW_IN_BIN
        middle = (first + count // 2)[kept]
        if kept.sum() >= 2:
            along = (places[kept] + 0.5) * _STRIP_BIN_M
            profiles.append(FloorProfile(int(c), along, points[order][middle, 2].astype(float)))
    return profiles


@dataclass(frozen=True, eq=False)
class _ShownRoom:
    """The part of the room that is shown, z up."""

    centre: np.ndarray
    """(2,) on the floor, metres."""
    radius: float
    """On the floor, metres."""
    azimuth: float
    """Of the first camera seen from the centre, radians."""
    gain: float
    """Factor that brightens dark images."""

    @classmethod
    def around(cls, cloud: FusedCloud, rig: Rig, world_from_master: np.ndarray) -> _ShownRoom:
        eyes = apply(world_from_master, rig.master_from_colour[:, :3, 3])
        centre = np.median(cloud.points[:, :2], 0) if len(cloud.points) else eyes[:, :2].mean(0)
        reach = np.linalg.norm(eyes[:, :2] - centre, axis=1).max() + _MARGIN_M
        radius = float(np.clip(reach, _SMALLEST_M, _LARGEST_M))
        first = eyes[0, :2] - centre
        bright = float(np.percentile(cloud.colours, 98)) if len(cloud.colours) else 1.0
        gain = float(np.clip(0.95 / max(bright, 1e-3), 1, _MOST_GAIN))
        azimuth = float(np.arctan2(first[1], first[0]))
        return cls(centre.astype(np.float64), radius, azimuth, gain)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return which points (N, 3) are shown."""
        near = np.linalg.norm(points[:, :2] - self.centre.astype(points.dtype), axis=1)
        return (near < self.radius) & (points[:, 2] > _FLOOR_M) & (points[:, 2] < _TOP_M)

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
        target = np.append(self.centre, _AIM_M)
        places = [_frustum(camera, world @ camera.master_from_colour) for camera in rig]
        for distance in _DISTANCES * self.radius:
            view = Viewpoint.towards(
                target, self.azimuth + np.radians(azimuth), np.radians(elevation), distance,
                _FOCAL, _SIZE,
            )  # fmt: skip
            if view.contains(np.concatenate(places), _BORDER_PX):
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
        lines = np.arange(-np.floor(self.radius / _CELL_M), self.radius / _CELL_M) * _CELL_M
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
        local = np.column_stack(
            [(columns - (view.width - 1) / 2) / view.focal, (rows - (view.height - 1) / 2)
             / view.focal, np.ones(len(rows))]
        )  # fmt: skip
        up = view.view_from_world[:3, 2]
        floor_z = -(view.eye[2]) / np.minimum(local @ up, -1e-6)
        shown = floor_z < depth[rows, columns] + 0.04
        share = 0.30 * layer[rows, columns][shown, None] / np.float32(255)
        at = (rows[shown], columns[shown])
        picture[at] = np.rint((1 - share) * picture[at] + share * 255)


def _frustum(camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Return apex and corners (5, 3) of a camera's viewing pyramid under ``pose`` (4, 4)."""
    lens = camera.colour
    half = 0.5 * np.array([lens.width / lens.fx, lens.height / lens.fy])
    corners = [[x * half[0], y * half[1], 1] for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return apply(pose, _FRUSTUM_M * np.array([[0, 0, 0], *corners]))


def _draw_frustum(
    picture: np.ndarray, view: Viewpoint, corners: np.ndarray, c: int, name: str
) -> None:
    """Draw a camera's viewing pyramid in its colour, with its name above."""
    pairs = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
    at, z = view.project(corners)
    for shade, thick in ((_SHADOW, 3), (_rgb(c), 1)):
        _draw_lines(picture, view, corners[np.array(pairs)], shade, thick)
    if not (z > _NEAR_M).all():
        return
    text = name[:_LONGEST_NAME].encode("ascii", "replace").decode()
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
    kept = (z > _NEAR_M).reshape(-1, 2).all(1) & (np.abs(at.reshape(-1, 4)).max(1) < 1e4)
    for a, b in np.rint(at.reshape(-1, 2, 2)[kept] * 2**_SHIFT).astype(int).tolist():
        cv2.line(picture, a, b, colour, thick, cv2.LINE_AA, _SHIFT)


@dataclass(frozen=True)
class Slice:
    """A horizontal rectangle of the room."""

    height: float
    """Metres."""
    centre: np.ndarray
    """(2,) metres."""
    scale: float
    """Pixels per metre."""

    @classmethod
    def of(cls, cloud: FusedCloud, centre: np.ndarray) -> Slice | None:
        """Choose the height at which most cameras have points near the centre, then most points.

        None if no two cameras have points at the same height.
        """
        near = np.abs(cloud.points[:, :2] - centre).max(1) < _SLICE_HALF_M
        best, found = (1, 0), None
        for height in _SLICE_HEIGHTS_M:
            inside = near & (np.abs(cloud.points[:, 2] - height) < _SLICE_THICK_M / 2)
            counts = np.bincount(cloud.camera[inside])
            score = (int((counts >= _FEW_IN_SLICE).sum()), int(inside.sum()))
            if score[0] >= 2 and score > best:
                best, found = score, (height, cloud.points[inside, :2])
        if found is None:
            return None
        low, high = np.percentile(found[1], (1, 99), axis=0)
        extent = np.maximum(_SLICE_MARGIN * (high - low), _SLICE_LEAST_M)
        return cls(found[0], (low + high) / 2, float((np.array(_SLICE_SIZE) / extent).min()))

    def picture(self, cloud: FusedCloud, when: str) -> EncodedImage:
        """Draw the points at this height from above in their cameras' colours, with a scale."""
        width, height = _SLICE_SIZE
        inside = np.abs(cloud.points[:, 2] - self.height) < _SLICE_THICK_M / 2
        at = (cloud.points[inside, :2] - self.centre) * [self.scale, -self.scale]
        at = np.rint(2**_SHIFT * (at + np.array(_SLICE_SIZE) / 2)).astype(int)
        cameras = cloud.camera[inside]
        picture = np.full((height, width, 3), np.rint(_GROUND * 255), np.uint8)
        # Cameras take turns, so that none covers all others
        order = np.argsort(np.arange(len(at)) * 2654435761 % 2**32, kind="stable")
        for place, c in zip(at[order].tolist(), cameras[order].tolist(), strict=True):
            cv2.circle(picture, place, _DOT_PX << _SHIFT, _rgb(c), -1, cv2.LINE_AA, _SHIFT)
        x, y, bar = 18, height - 20, round(_SCALE_BAR_M * self.scale)
        cv2.line(picture, (x, y), (x + bar, y), _INK, 2)
        label = f"{100 * _SCALE_BAR_M:.0f} cm"
        cv2.putText(picture, label, (x, y - 8), _FONT, 0.5, _INK, 1, cv2.LINE_AA)
        name = _captioned(f"slice at {self.height:.1f} m", when)
        return _encode_png(picture, name)


def _rgb(c: int) -> tuple[int, int, int]:
    text = CAMERA_COLOURS[c % len(CAMERA_COLOURS)]
    red, green, blue = (int(text[i : i + 2], 16) for i in (1, 3, 5))
    return red, green, blue


def _captioned(name: str, when: str) -> str:
    return f"{name}, {when}" if when else name


def _encode_png(rgb: np.ndarray, caption: str) -> EncodedImage:
    options = [cv2.IMWRITE_PNG_COMPRESSION, 6]
    data = cv2.imencode(".png", rgb[..., ::-1], options)[1].tobytes()
    return EncodedImage(data, "png", rgb.shape[1], rgb.shape[0], caption)
