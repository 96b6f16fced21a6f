"""Images of the stage: the room is ray cast once for each camera, moving surfaces are drawn over
it.

Rays are not normalised (z = 1 in the camera frame), so that the parameter of a hit is its depth z.
Moving surfaces are drawn with a z-buffer through the same rays. This takes half the time of
building a ray casting tree, which a body that changes would need in every image.

:class:`Aligner` aligns depth to the colour camera's pixel grid, as the Azure Kinect SDK does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba
import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.rigid.open3d_core import o3d
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.geometry.rigid.shots import Drawable
from intercap_core.studio.noise import gaussian
from intercap_core.studio.room import Room

BODY, OBJECT, PASSER_BY = 1, 2, 3  # values of an identity image; 0 is the room
# Directions to two ceiling lamps, stage frame, and their strength as a share of full brightness
LAMPS = (((0.45, 0.3, 0.85), 0.42), ((-0.6, -0.25, 0.75), 0.30))
CAMERA_GAMMA = 2.2  # grey levels are linear light to the power 1 / 2.2, nearly as in sRGB


@dataclass(frozen=True)
class MovingSurface:
    """A closed moving mesh."""

    kind: int
    """BODY, OBJECT or PASSER_BY."""
    vertices: np.ndarray
    """(V, 3) own frame."""
    faces: np.ndarray
    """(F, 3)."""
    normals: np.ndarray
    """(V, 3) unit."""
    colours: np.ndarray
    """(V, 3) RGB in [0, 1]."""
    stage_from_mesh: np.ndarray
    """(4, 4)."""


@dataclass(frozen=True)
class Cast:
    """Drawn moving surfaces in a window of the image whose first pixel is (``x0``, ``y0``).

    The n pixels of the window that show a moving surface have depth, normal and colour.
    """

    x0: int
    y0: int
    identity: np.ndarray
    """(h, w) uint8: BODY, OBJECT, PASSER_BY, or 0 where the room is nearer."""
    pixels: np.ndarray
    """(n,) flat indices in the window of the pixels that are not 0."""
    depth: np.ndarray
    """(n,) z, metres."""
    normal: np.ndarray
    """(n, 3) stage frame."""
    colour: np.ndarray
    """(n, 3) float32 RGB in [0, 1], not yet shaded."""

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the image."""
        height, width = self.identity.shape
        return slice(self.y0, self.y0 + height), slice(self.x0, self.x0 + width)

    @property
    def image_pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns (n,) in the image of the pixels that are not 0."""
        rows, columns = np.divmod(self.pixels, max(self.identity.shape[1], 1))
        return rows + self.y0, columns + self.x0


def scene_of(*meshes: tuple[np.ndarray, np.ndarray]) -> o3d.t.geometry.RaycastingScene:
    """Scene of meshes (V, 3), (F, 3); built by one thread, so that it is deterministic."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for vertices, faces in meshes:
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(vertices, np.float32)),
            o3d.core.Tensor.from_numpy(np.ascontiguousarray(faces, np.uint32)),
        )
    return scene


def shade(normals: np.ndarray) -> np.ndarray:
    """Brightness (...,) of surfaces with unit normals (..., 3), as a factor of their grey levels.

    Lambertian shading by the lamps and by ambient light.
    """
    light = np.full(normals.shape[:-1], 0.42, np.float32)  # from all directions
    for direction, strength in LAMPS:
        lamp = np.array(direction, np.float32) / np.float32(np.linalg.norm(direction))
        light += np.float32(strength) * np.maximum(normals @ lamp, 0)
    return light ** np.float32(1 / CAMERA_GAMMA)


class RoomView:
    """Rays of one lens, and its image of the empty room.

    - ``depth``: (H, W) z, metres; inf = nothing.
    - ``normal``: (H, W, 3) unit, towards the camera, stage frame.
    - ``colour``: (H, W, 3) shaded RGB in [0, 1]; empty if not ``coloured``.
    - ``material``: (H, W) index of the room's materials; -1 = nothing.
    """

    def __init__(
        self, lens: Intrinsics, stage_from_camera: np.ndarray, room: Room, *, coloured: bool
    ) -> None:
        self.lens = lens
        self.camera_from_stage = np.linalg.inv(stage_from_camera)
        self.rotation = stage_from_camera[:3, :3].astype(np.float32)
        self.eye = stage_from_camera[:3, 3].astype(np.float32)
        shape = (lens.height, lens.width)
        self.depth = np.full(shape, np.inf, np.float32)
        self.normal = np.zeros((*shape, 3), np.float32)
        self.colour = np.full((*shape, 3) if coloured else (0, 0, 3), 0.04, np.float32)
        self.material = np.full(shape, -1, np.int16)
        room_scene = scene_of((room.vertices, room.faces))
        facing = _facing(room, self.eye)
        brightness = shade(facing)
        for top in range(0, lens.height, 120):
            rows = slice(top, top + 120)
            rays = self._rays(rows)
            hit = room_scene.cast_rays(o3d.core.Tensor.from_numpy(rays))
            depth, face = hit["t_hit"].numpy(), hit["primitive_ids"].numpy()
            seen = np.flatnonzero(np.isfinite(depth))
            face = face.ravel()[seen]
            self.depth[rows] = depth
            self.normal[rows].reshape(-1, 3)[seen] = facing[face]
            self.material[rows].ravel()[seen] = room.material[face]
            if coloured:
                points = rays.reshape(-1, 6)[seen]
                points = points[:, :3] + depth.ravel()[seen, None] * points[:, 3:]
                colours = _room_colours(room, points, face, facing) * brightness[face, None]
                self.colour[rows].reshape(-1, 3)[seen] = colours

    def directions(self, rows: slice = slice(None)) -> np.ndarray:
        """Rays (h, W, 3) float32 of image rows in the stage, z = 1 in the camera.

        Rays beyond the lens's radius are zero and hit nothing.
        """
        xy = self.lens.rays[rows]
        directions = xy @ self.rotation[:, :2].T + self.rotation[:, 2]
        directions[np.isnan(xy[..., 0])] = 0
        return directions

    def _rays(self, rows: slice) -> np.ndarray:
        """(h, W, 6) float32: origin and direction in the stage."""
        directions = self.directions(rows)
        rays = np.empty((*directions.shape[:2], 6), np.float32)
        rays[..., :3], rays[..., 3:] = self.eye, directions
        return rays

    def _drawable(self, surface: MovingSurface) -> Drawable:
        pose = self.camera_from_stage @ surface.stage_from_mesh
        return Drawable(surface.vertices, surface.faces, pose)

    def cast(self, surfaces: Sequence[MovingSurface]) -> Cast:
        """Draw ``surfaces`` over the room."""
        drawn = render_scene([self._drawable(s) for s in surfaces], self.lens, margin_px=1)
        nearer = drawn.mask & (drawn.depth < self.depth[drawn.window])
        kinds = np.array([surface.kind for surface in surfaces], np.uint8)
        identity = np.where(nearer, kinds[drawn.body], 0).astype(np.uint8)
        pixels = np.flatnonzero(nearer)
        depth = drawn.depth.ravel()[pixels]
        normal, colour = np.empty((2, len(pixels), 3), np.float32)
        rays = self.lens.rays[drawn.window].reshape(-1, 2)
        for surface in surfaces:
            here = np.flatnonzero(identity.ravel()[pixels] == surface.kind)
            _interpolate(
                here, pixels, drawn.face.ravel(), rays, self._drawable(surface).camera_from_mesh,
                surface.vertices, surface.faces, surface.normals, surface.colours,
                surface.stage_from_mesh, normal, colour,
            )  # fmt: skip
        return Cast(drawn.x0, drawn.y0, identity, pixels, depth, normal, colour)

    def count(self, surface: MovingSurface) -> int:
        """Number of pixels that an unoccluded surface covers."""
        return int(render_scene([self._drawable(surface)], self.lens).mask.sum())


@numba.njit(cache=True)
def _interpolate(
    here,
    pixels,
    face,
    rays,
    camera_from_mesh,
    vertices,
    faces,
    normals,
    colours,
    stage_from_mesh,
    normal,
    colour,
):
    """Fill rows ``here`` of ``normal`` and ``colour`` (n, 3) from the corners of the triangles hit.

    A corner's weight is the volume that the ray spans with the two other corners.
    """
    corner = np.empty((3, 3))
    weight = np.empty(3)
    mixed = np.empty(3)
    for i in here:
        triangle = faces[face[pixels[i]]]
        x, y = rays[pixels[i], 0], rays[pixels[i], 1]
        for k in range(3):
            for axis in range(3):
                value = camera_from_mesh[axis, 3]
                for other in range(3):
                    value += camera_from_mesh[axis, other] * vertices[triangle[k], other]
                corner[k, axis] = value
        total = 0.0
        for k in range(3):
            a, b = corner[(k + 1) % 3], corner[(k + 2) % 3]
            weight[k] = (
                (a[1] * b[2] - a[2] * b[1]) * x
                + (a[2] * b[0] - a[0] * b[2]) * y
                + (a[0] * b[1] - a[1] * b[0])
            )
            total += weight[k]
        length = 0.0
        for axis in range(3):
            mixed[axis] = 0.0
            shade = 0.0
            for k in range(3):
                mixed[axis] += weight[k] / total * normals[triangle[k], axis]
                shade += weight[k] / total * colours[triangle[k], axis]
            colour[i, axis] = shade
            length += mixed[axis] * mixed[axis]
        length = max(np.sqrt(length), 1e-6)
        for axis in range(3):
            value = 0.0
            for other in range(3):
                value += stage_from_mesh[axis, other] * mixed[other]
            normal[i, axis] = value / length


def _facing(room: Room, eye: np.ndarray) -> np.ndarray:
    """Unit normals (F, 3) float32 of the room's faces on the side of the eye."""
    first, second, third = (room.vertices[room.faces[:, k]] for k in range(3))
    normal = np.cross(second - first, third - first)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return (normal * np.sign(((eye - first) * normal).sum(1))[:, None]).astype(np.float32)


def _room_colours(
    room: Room, points: np.ndarray, face: np.ndarray, facing: np.ndarray
) -> np.ndarray:
    """Colours (N, 3) of points of the empty room on faces (N,), not yet shaded."""
    colours = np.empty((len(points), 3), np.float32)
    material = room.material[face]
    for index, look in enumerate(room.materials):
        here = np.flatnonzero(material == index)
        if len(here):
            colours[here] = look(points[here].astype(np.float64), facing[face[here]])
    return colours


class Photographer:
    """Turns casts into JPEG images; ``gain`` (3,) on linear RGB is the white balance."""

    sensor_noise = 2.0  # standard deviation, grey levels
    edge_blur_px = 0.55  # blur of the edges of moving surfaces
    jpeg_quality = 85  # of the device's compression

    def __init__(self, view: RoomView, gain: np.ndarray, rng: np.random.Generator) -> None:
        self.gain = (gain ** (1 / CAMERA_GAMMA)).astype(np.float32)
        self.look_through(view)
        # sensor noise: a tile that is shifted at random in each image
        size = (view.lens.height + 64, view.lens.width + 64, 3)
        tile = gaussian(rng, size) * np.float32(self.sensor_noise)
        # the blur correlates neighbours and halves the deviation, which the factor partly restores
        tile = np.rint(cv2.GaussianBlur(tile, (0, 0), 0.6) * np.float32(1.6))
        self._brighter = np.maximum(tile, 0).astype(np.uint8)
        self._darker = np.maximum(-tile, 0).astype(np.uint8)
        self._rng = rng

    def look_through(self, view: RoomView) -> None:
        """Photograph the room of ``view`` from now on."""
        self.view = view
        room = np.clip(view.colour * self.gain * 255, 0, 255)
        self._room = np.ascontiguousarray(room[..., ::-1].astype(np.uint8))

    def photograph(self, cast: Cast) -> np.ndarray:
        """The image (H, W, 3) uint8 BGR."""
        image = self._room.copy()
        if len(cast.pixels):
            lit = cast.colour * shade(cast.normal)[:, None] * self.gain * np.float32(255)
            image[cast.image_pixels] = np.clip(lit, 0, 255)[:, ::-1].astype(np.uint8)
            window = image[cast.window]
            window[...] = cv2.GaussianBlur(window, (3, 3), self.edge_blur_px)
        y, x = self._rng.integers(0, 64, 2)
        part = slice(y, y + image.shape[0]), slice(x, x + image.shape[1])
        cv2.add(image, self._brighter[part], image)
        return cv2.subtract(image, self._darker[part], image)

    def jpeg(self, image: np.ndarray) -> bytes:
        """Compress as the device does."""
        return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])[
            1
        ].tobytes()


class Aligner:
    """Aligns depth images of one device by its own calibration."""

    def __init__(self, camera: Camera) -> None:
        if camera.depth is None or camera.colour_from_depth is None:
            raise ValueError(f"camera {camera.name} has no depth")
        self._lens, pose = camera.colour, camera.colour_from_depth
        rays = camera.depth.rays
        ahead = np.ones((*rays.shape[:2], 1))
        self._direction = np.concatenate([rays, ahead], -1) @ pose[:3, :3].T
        self._shift = pose[:3, 3]
        self._usable = np.isfinite(rays[..., 0])

    def align(self, depth: np.ndarray) -> np.ndarray:
        """Depth (H, W) uint16 mm to the colour grid (Hc, Wc) uint16 mm, z of the colour camera.

        The depth image is treated as a mesh of two triangles between four neighbouring pixels.
        The nearest surface wins; surfaces that only the colour camera sees stay 0.
        """
        known = (depth > 0) & self._usable
        points = self._direction[known] * (depth[known] * 1e-3)[:, None] + self._shift
        pixels = np.full((*depth.shape, 2), np.nan, np.float32)
        z = np.zeros(depth.shape, np.float32)
        pixels[known], z[known] = self._lens.project(points), points[:, 2]
        aligned = np.full((self._lens.height, self._lens.width), np.inf, np.float32)
        _warp(pixels, z, aligned)
        return np.where(np.isfinite(aligned), np.rint(aligned * 1000), 0).astype(np.uint16)


# Corners of a triangle belong to one surface if they differ by less than this share of their depth.
# Neighbouring pixels of the coarsest mode (wide, binned: 0.23 degrees) differ by as much on a
# surface whose normal is 85 degrees off the ray.
STEEPEST = 0.0469


@numba.njit(cache=True)
def _warp(pixels, z, aligned):
    """Draw the mesh of a depth image into ``aligned`` (Hc, Wc).

    Args:
        pixels: (H, W, 2) in the colour image.
        z: (H, W) metres in the colour camera, 0 = unknown.
    """
    for v in range(z.shape[0] - 1):
        for u in range(z.shape[1] - 1):
            for second in range(2):
                # corners of the triangle, clockwise in the image
                va, ua = v + second, u + second
                vb, ub = (v + 1, u) if second else (v, u + 1)
                vc, uc = (v, u + 1) if second else (v + 1, u)
                za, zb, zc = z[va, ua], z[vb, ub], z[vc, uc]
                least = min(za, zb, zc)
                if least <= 0 or max(za, zb, zc) - least > STEEPEST * least:
                    continue
                _triangle(pixels[va, ua], pixels[vb, ub], pixels[vc, uc], za, zb, zc, aligned)


@numba.njit(cache=True)
def _triangle(a, b, c, za, zb, zc, aligned):
    """Draw a triangle with corners (2,) px and depths, metres; the nearest depth of a pixel stays.

    A pixel's weights wa, wb, wc are its barycentric coordinates times twice the triangle's area.
    """
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    if area <= 0:  # seen from behind: something nearer hides it
        return
    height, width = aligned.shape
    left = max(int(np.ceil(min(a[0], b[0], c[0]))), 0)
    right = min(int(np.floor(max(a[0], b[0], c[0]))), width - 1)
    top = max(int(np.ceil(min(a[1], b[1], c[1]))), 0)
    bottom = min(int(np.floor(max(a[1], b[1], c[1]))), height - 1)
    for y in range(top, bottom + 1):
        for x in range(left, right + 1):
            wa = (b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)
            wb = (c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)
            wc = area - wa - wb
            if wa < 0 or wb < 0 or wc < 0:
                continue
            depth = (wa * za + wb * zb + wc * zc) / area
            if depth < aligned[y, x]:
                aligned[y, x] = depth
