"""Images of the stage by ray casting: the static room once a camera, moving things every frame.

Rays are not normalised (z = 1 in the camera's frame), so a hit's parameter is its depth z.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import open3d as o3d

from intercap_core.camera.intrinsics import Intrinsics
from intercap_core.studio.room import Room

BODY, OBJECT = 1, 2  # what an identity image holds; 0 is the room
BOX_MARGIN_PX = 3
AMBIENT = 0.42
# Directions to the lamps and their strength: two ceiling lamps
LAMPS = (((0.45, 0.3, 0.85), 0.42), ((-0.6, -0.25, 0.75), 0.30))
SENSOR_NOISE = 2.0  # grey levels
EDGE_BLUR_PX = 0.55
JPEG_QUALITY = 85


@dataclass(frozen=True)
class Surface:
    """A moving mesh in the stage: vertices (V, 3), faces (F, 3), colours (V, 3) RGB in [0, 1]."""

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray


@dataclass(frozen=True)
class Cast:
    """What moving things look like in a window whose first pixel is (x0, y0).

    ``identity`` (h, w) uint8 BODY, OBJECT or 0 where the room is nearer; ``depth`` (h, w) float32
    z in metres, inf where 0; ``normal`` (h, w, 3) stage frame and ``colour`` (h, w, 3) float32.
    """

    x0: int
    y0: int
    identity: np.ndarray
    depth: np.ndarray
    normal: np.ndarray
    colour: np.ndarray

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the image."""
        height, width = self.identity.shape
        return slice(self.y0, self.y0 + height), slice(self.x0, self.x0 + width)


def scene_of(*meshes: tuple[np.ndarray, np.ndarray]) -> o3d.t.geometry.RaycastingScene:
    """A scene of meshes (V, 3), (F, 3); built by one thread, so that it is always the same."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for vertices, faces in meshes:
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(vertices, np.float32)),
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(faces, np.uint32)),
        )
    return scene


def shade(normals: np.ndarray) -> np.ndarray:
    """Brightness (...,) of surfaces with unit normals (..., 3)."""
    light = np.full(normals.shape[:-1], AMBIENT, np.float32)
    for direction, strength in LAMPS:
        lamp = np.array(direction, np.float32) / np.float32(np.linalg.norm(direction))
        light += np.float32(strength) * np.maximum(normals @ lamp, 0)
    return light


class View:
    """One lens of one camera: its rays and what it sees of the empty room."""

    def __init__(self, lens: Intrinsics, stage_from_camera: np.ndarray, room: Room,
                 *, coloured: bool) -> None:  # fmt: skip
        self.lens = lens
        self.camera_from_stage = np.linalg.inv(stage_from_camera)
        self.rotation = stage_from_camera[:3, :3].astype(np.float32)
        self.eye = stage_from_camera[:3, 3].astype(np.float32)
        shape = (lens.height, lens.width)
        xy = lens.rays  # no ray beyond the lens's radius: directions of zero hit nothing
        ahead = np.ones((*shape, 1), np.float32)
        self._directions = np.nan_to_num(np.concatenate([xy, ahead], -1) @ self.rotation.T)
        self.depth = np.full(shape, np.inf, np.float32)
        self.normal = np.zeros((*shape, 3), np.float32)
        room_scene = scene_of((room.vertices, room.faces))
        self.colour = np.zeros((*shape, 3), np.float32)
        self.material = np.full(shape, -1, np.int16)
        for top in range(0, lens.height, 120):
            rows = slice(top, top + 120)
            rays = self._rays(rows, slice(0, lens.width))
            hit = room_scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
            depth, face = hit["t_hit"].numpy(), hit["primitive_ids"].numpy()
            seen = np.isfinite(depth)
            normal = hit["primitive_normals"].numpy()
            normal *= -np.sign((normal * rays[..., 3:]).sum(-1, keepdims=True))
            normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
            self.depth[rows], self.normal[rows] = depth, np.where(seen[..., None], normal, 0)
            self.material[rows][seen] = room.material[face[seen]]
            if coloured:
                self.colour[rows] = _room_colours(room, rays, depth, face, normal, seen)

    def _rays(self, rows: slice, columns: slice) -> np.ndarray:
        """(h, w, 6) float32: origin and direction in the stage."""
        directions = self._directions[rows, columns]
        rays = np.empty((*directions.shape[:2], 6), np.float32)
        rays[..., :3], rays[..., 3:] = self.eye, directions
        return rays

    def box(self, points: np.ndarray) -> tuple[int, int, int, int]:
        """x0, y0, x1, y1 around points (N, 3) of the stage, clipped to the image; maybe empty."""
        at = points @ self.camera_from_stage[:3, :3].T + self.camera_from_stage[:3, 3]
        at = at[at[:, 2] > 0.1]
        if len(at) == 0:
            return 0, 0, 0, 0
        pixels = self.lens.project(at)
        low = np.floor(pixels.min(0)).astype(int) - BOX_MARGIN_PX
        high = np.ceil(pixels.max(0)).astype(int) + BOX_MARGIN_PX + 1
        size = (self.lens.width, self.lens.height)
        x0, y0 = np.clip(low, 0, size)
        x1, y1 = np.clip(high, 0, size)
        return int(x0), int(y0), int(x1), int(y1)

    def cast(self, scene: o3d.t.geometry.RaycastingScene, surfaces: tuple[Surface, ...],
             normals: tuple[np.ndarray, ...]) -> Cast:  # fmt: skip
        """Cast ``surfaces`` (in the scene's order: body, object) over the room."""
        x0, y0, x1, y1 = self.box(np.concatenate([s.vertices for s in surfaces]))
        window = slice(y0, y1), slice(x0, x1)
        height, width = max(y1 - y0, 0), max(x1 - x0, 0)
        identity = np.zeros((height, width), np.uint8)
        depth = np.full((height, width), np.inf, np.float32)
        normal = np.zeros((height, width, 3), np.float32)
        colour = np.zeros((height, width, 3), np.float32)
        if height and width:
            hit = scene.cast_rays(o3d.core.Tensor.from_numpy(self._rays(*window)))
            distance = hit["t_hit"].numpy()
            nearer = distance < self.depth[window]
            geometry, face = hit["geometry_ids"].numpy(), hit["primitive_ids"].numpy()
            uv = hit["primitive_uvs"].numpy()
            for number, (surface, smooth) in enumerate(zip(surfaces, normals, strict=True)):
                here = nearer & (geometry == number)
                corner = surface.faces[face[here]]
                u, v = uv[here][:, :1], uv[here][:, 1:]
                weight = (1 - u - v, u, v)
                identity[here] = number + 1
                normal[here] = sum(w * smooth[corner[:, k]] for k, w in enumerate(weight))
                colour[here] = sum(w * surface.colours[corner[:, k]] for k, w in enumerate(weight))
            depth[nearer] = distance[nearer]
            normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
        return Cast(x0, y0, identity, depth, normal, colour)

    def count(self, scene: o3d.t.geometry.RaycastingScene, points: np.ndarray) -> int:
        """Pixels that a scene's only mesh, around points (N, 3), would cover if nothing hid it."""
        x0, y0, x1, y1 = self.box(points)
        if x1 <= x0 or y1 <= y0:
            return 0
        rays = self._rays(slice(y0, y1), slice(x0, x1))
        hit = scene.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
        return int(np.isfinite(hit).sum())


def _room_colours(room: Room, rays: np.ndarray, depth: np.ndarray, face: np.ndarray,
                  normal: np.ndarray, seen: np.ndarray) -> np.ndarray:  # fmt: skip
    """Shaded colours (h, w, 3) of the empty room."""
    colours = np.full((*depth.shape, 3), 0.04, np.float32)
    material = np.full(depth.shape, -1)
    material[seen] = room.material[face[seen]]
    for index, look in enumerate(room.materials):
        here = material == index
        if not here.any():
            continue
        points = rays[here][:, :3] + depth[here][:, None] * rays[here][:, 3:]
        colours[here] = look(points.astype(np.float64), normal[here])
        colours[here] *= shade(normal[here])[:, None]
    return colours


class Photographer:
    """Turns casts of one colour view into JPEG images; ``gain`` (3,) RGB of its white balance."""

    def __init__(self, view: View, gain: np.ndarray, rng: np.random.Generator) -> None:
        self.view = view
        self.gain = gain.astype(np.float32)
        room = np.clip(view.colour * self.gain * 255, 0, 255)
        self._room = np.ascontiguousarray(room[..., ::-1].astype(np.uint8))
        # sensor noise: one tile, taken at another place in each image
        size = (view.lens.height + 64, view.lens.width + 64, 3)
        tile = rng.normal(0, SENSOR_NOISE, size).astype(np.float32)
        self._noise = cv2.GaussianBlur(tile, (0, 0), 0.6) * np.float32(1.6)
        self._rng = rng

    def photograph(self, cast: Cast) -> np.ndarray:
        """The image (H, W, 3) uint8 BGR."""
        image = self._room.copy()
        if cast.identity.size:
            lit = cast.colour * shade(cast.normal)[..., None] * self.gain * np.float32(255)
            lit = np.clip(lit, 0, 255)[..., ::-1]
            window = image[cast.window]
            moving = cast.identity > 0
            window[moving] = lit[moving].astype(np.uint8)
            window[...] = cv2.GaussianBlur(window, (3, 3), EDGE_BLUR_PX)
        y, x = self._rng.integers(0, 64, 2)
        height, width = image.shape[:2]
        noisy = cv2.add(image, self._noise[y : y + height, x : x + width], dtype=cv2.CV_8U)
        return noisy

    def jpeg(self, image: np.ndarray) -> bytes:
        """Compress as the device does."""
        return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
