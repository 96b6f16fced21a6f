"""The z-buffer of :mod:`.raster` for a GPU, in warp: one thread a triangle of a shot.

The same arithmetic in double precision. Which of several triangles is nearest in a pixel is settled
by one atomic minimum over depth and face id, so that the images do not depend on the order of the
threads. The same kernels run on warp's CPU device, where they are tested against :mod:`.raster`.
Their speed has not been measured on a GPU.
"""

# mypy: ignore-errors
# No deferred annotations: warp reads the kernels' types, which are its own.
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.projection import MIN_DEPTH_M
from intercap_core.geometry.rigid import raster
from intercap_core.geometry.rigid.distance import VISIBLE_OFFSET_M
from intercap_core.geometry.rigid.shots import Rendering, Shot, Surface
from intercap_core.geometry.rigid.surfaces import vertex_normals
from intercap_core.geometry.solve.thread_pool import ThreadPool

KEPT_ON_DEVICE = 4  # sets of lenses, and meshes, that stay on the GPU

wp.config.log_level = wp.LOG_WARNING  # no banner in a job's output
wp.set_module_options({"enable_backward": False})  # compiles in a third of the time

_NEAR = wp.constant(wp.float64(raster.NEAR_M))
_MIN_DEPTH = wp.constant(wp.float64(MIN_DEPTH_M))
_BEND = wp.constant(wp.float64(raster.BEND))
_SLACK = wp.constant(wp.float64(raster.SLACK_PX))
_EMPTY = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))


@wp.kernel
def place(
    vertices: wp.array(dtype=wp.vec3d),
    poses: wp.array(dtype=wp.mat44d),
    lens_of: wp.array(dtype=wp.int32),
    lenses: wp.array2d(dtype=wp.float64),
    corners: wp.array2d(dtype=wp.vec3d),
    pixels: wp.array2d(dtype=wp.vec2d),
):
    """Corners in each shot's camera frame and their pixels, as raster.place."""
    shot, i = wp.tid()
    p = wp.transform_point(poses[shot], vertices[i])
    corners[shot, i] = p
    lens = lens_of[shot]
    one, two = wp.float64(1.0), wp.float64(2.0)
    z = wp.max(p[2], _MIN_DEPTH)
    x, y = p[0] / z, p[1] / z
    stretch = wp.max(wp.sqrt(x * x + y * y) / lenses[lens, 12], one)
    x, y = x / stretch, y / stretch
    s = x * x + y * y
    above = one + s * (lenses[lens, 4] + s * (lenses[lens, 5] + s * lenses[lens, 8]))
    below = one + s * (lenses[lens, 9] + s * (lenses[lens, 10] + s * lenses[lens, 11]))
    d = above / below
    p1, p2 = lenses[lens, 6], lenses[lens, 7]
    u = x * d + two * p1 * x * y + p2 * (s + two * x * x)
    v = y * d + p1 * (s + two * y * y) + two * p2 * x * y
    pixels[shot, i] = wp.vec2d(
        lenses[lens, 0] * stretch * u + lenses[lens, 2],
        lenses[lens, 1] * stretch * v + lenses[lens, 3],
    )


@wp.kernel
def _surround(
    corners: wp.array2d(dtype=wp.vec3d),
    pixels: wp.array2d(dtype=wp.vec2d),
    boxes: wp.array(dtype=wp.vec4d),
):
    """The box of each shot's pixels, left, top, right, bottom, of points that are not too near."""
    shot = wp.tid()
    left, top = wp.float64(1.0e30), wp.float64(1.0e30)
    right, bottom = wp.float64(-1.0e30), wp.float64(-1.0e30)
    for i in range(corners.shape[1]):
        if corners[shot, i][2] > _NEAR:
            pixel = pixels[shot, i]
            left = wp.min(left, pixel[0])
            top = wp.min(top, pixel[1])
            right = wp.max(right, pixel[0])
            bottom = wp.max(bottom, pixel[1])
    boxes[shot] = wp.vec4d(left, top, right, bottom)


@wp.kernel
def _draw(
    corners: wp.array2d(dtype=wp.vec3d),
    pixels: wp.array2d(dtype=wp.vec2d),
    faces: wp.array(dtype=wp.vec3i),
    cull_back: int,
    lens_of: wp.array(dtype=wp.int32),
    lenses: wp.array2d(dtype=wp.float64),
    rays: wp.array(dtype=wp.vec2),
    ray_starts: wp.array(dtype=wp.int64),
    widths: wp.array(dtype=wp.int32),
    windows: wp.array(dtype=wp.vec4i),
    starts: wp.array(dtype=wp.int64),
    keys: wp.array(dtype=wp.uint64),
):
    """One triangle of one shot, as raster.draw; a key holds the depth's bits above the face id."""
    shot, f = wp.tid()
    face, window = faces[f], windows[shot]
    a, b, c = corners[shot, face[0]], corners[shot, face[1]], corners[shot, face[2]]
    n0, n1, n2 = wp.cross(a, b), wp.cross(b, c), wp.cross(c, a)
    zero = wp.float64(0.0)
    volume = wp.dot(n0, c)
    if volume == zero or (cull_back != 0 and volume > zero):
        return
    if a[2] < _NEAR or b[2] < _NEAR or c[2] < _NEAR:
        return
    p, q, r = pixels[shot, face[0]], pixels[shot, face[1]], pixels[shot, face[2]]
    left, right = wp.min(wp.min(p[0], q[0]), r[0]), wp.max(wp.max(p[0], q[0]), r[0])
    top, bottom = wp.min(wp.min(p[1], q[1]), r[1]), wp.max(wp.max(p[1], q[1]), r[1])
    lens = lens_of[shot]
    focal = wp.min(lenses[lens, 0], lenses[lens, 1])
    extent = wp.max(right - left, bottom - top)
    slack = _SLACK + _BEND * extent * extent / focal
    one = wp.float64(1.0)
    low_u, high_u = wp.max(left - slack, wp.float64(window[0])), right + slack
    low_v, high_v = wp.max(top - slack, wp.float64(window[1])), bottom + slack
    high_u = wp.min(high_u, wp.float64(window[2]) - one)
    high_v = wp.min(high_v, wp.float64(window[3]) - one)
    if low_u > high_u or low_v > high_v:
        return
    sign = one
    if volume < zero:
        sign = -one
    normal = n0 + n1 + n2
    for v in range(int(wp.ceil(low_v)), int(high_v) + 1):
        row = starts[shot] + wp.int64((v - window[1]) * (window[2] - window[0]) - window[0])
        image_row = ray_starts[lens] + wp.int64(v) * wp.int64(widths[lens])
        for u in range(int(wp.ceil(low_u)), int(high_u) + 1):
            flat = rays[image_row + wp.int64(u)]
            ray = wp.vec3d(wp.float64(flat[0]), wp.float64(flat[1]), one)
            inside = sign * wp.dot(n0, ray) >= zero and sign * wp.dot(n1, ray) >= zero
            if inside and sign * wp.dot(n2, ray) >= zero:
                z = wp.float32(volume / wp.dot(normal, ray))
                # bits of positive floats sort as their values do
                key = (wp.uint64(wp.cast(z, wp.uint32)) << wp.uint64(32)) | wp.uint64(f)
                wp.atomic_min(keys, row + wp.int64(u), key)


@wp.kernel
def _unpack(
    keys: wp.array(dtype=wp.uint64),
    depth: wp.array(dtype=wp.float32),
    face: wp.array(dtype=wp.int32),
    body: wp.array(dtype=wp.int16),
):
    """Depth, face and body of every pixel; 0, -1, -1 where nothing was hit."""
    i = wp.tid()
    key = keys[i]
    if key == _EMPTY:
        depth[i] = wp.float32(0.0)
        face[i] = wp.int32(-1)
        body[i] = wp.int16(-1)
    else:
        depth[i] = wp.cast(wp.uint32(key >> wp.uint64(32)), wp.float32)
        face[i] = wp.int32(key & wp.uint64(0xFFFFFFFF))
        body[i] = wp.int16(0)


@wp.kernel
def _look_for_eyes(
    tree: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    eyes: wp.array(dtype=wp.vec3),
    asked: wp.array2d(dtype=wp.uint8),
):
    """Clear ``asked`` where the mesh lies between a point and a shot's eye."""
    shot, i = wp.tid()
    if asked[shot, i] != wp.uint8(0):
        way = eyes[shot] - points[i]
        if wp.mesh_query_ray_anyhit(tree, points[i], wp.normalize(way), wp.length(way)):
            asked[shot, i] = wp.uint8(0)


def has_cuda() -> bool:
    """Whether warp finds a GPU that it can use."""
    return bool(wp.get_cuda_device_count() > 0)


class _Mesh:
    """A mesh on the device; its tree of boxes is built when first asked for."""

    def __init__(self, surface: Surface, device: str) -> None:
        vertices = np.ascontiguousarray(surface.vertices, np.float64)
        faces = np.ascontiguousarray(surface.faces, np.int32)
        self.vertices: Any = wp.array(vertices, dtype=wp.vec3d, device=device)
        self.faces: Any = wp.array(faces, dtype=wp.vec3i, device=device)
        self._points: Any = wp.array(vertices.astype(np.float32), dtype=wp.vec3, device=device)
        self._tree: wp.Mesh | None = None

    @property
    def tree(self) -> wp.Mesh:
        if self._tree is None:
            indices = self.faces.view(wp.int32).flatten()
            self._tree = wp.Mesh(points=self._points, indices=indices)
        return self._tree


class _Lenses:
    """Parameters (L, 13) and the rays of all lenses, one image after the other."""

    def __init__(self, lenses: list[Intrinsics], device: str) -> None:
        sizes = [lens.width * lens.height for lens in lenses]
        starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        rays = np.concatenate([lens.rays.reshape(-1, 2) for lens in lenses])
        parameters = np.array([lens.parameters for lens in lenses])
        self.parameters: Any = wp.array(parameters, dtype=wp.float64, device=device)
        self.rays: Any = wp.array(rays, dtype=wp.vec2, device=device)
        self.starts: Any = wp.array(starts, dtype=wp.int64, device=device)
        self.widths: Any = wp.array([lens.width for lens in lenses], dtype=wp.int32, device=device)


def _poses(shots: Sequence[Shot]) -> np.ndarray:
    return np.array([shot.camera_from_mesh for shot in shots], np.float64)


class WarpRenderer:
    """See :class:`.render.Renderer`; ``device`` is warp's name: ``cuda:0``, or ``cpu`` to test."""

    def __init__(self, device: str, *, threads: int = 1) -> None:
        self.device = device
        self.pool = ThreadPool(threads)
        self._lenses: list[tuple[tuple[Intrinsics, ...], _Lenses]] = []
        self._meshes: list[tuple[Surface, _Mesh]] = []

    def draw(
        self, surface: Surface, shots: Sequence[Shot], *, margin_px: int = 0
    ) -> list[Rendering]:
        """See :class:`.render.Renderer`."""
        if not shots:
            return []
        mesh, (lenses, numbers) = self._mesh(surface), self._lenses_of(shots)
        device, count = self.device, len(shots)
        poses: Any = wp.array(_poses(shots), dtype=wp.mat44d, device=device)
        lens_of: Any = wp.array(numbers, dtype=wp.int32, device=device)
        shape = (count, len(surface.vertices))
        corners = wp.empty(shape, dtype=wp.vec3d, device=device)
        pixels = wp.empty(shape, dtype=wp.vec2d, device=device)
        boxes = wp.empty(count, dtype=wp.vec4d, device=device)
        placed = [mesh.vertices, poses, lens_of, lenses.parameters]
        wp.launch(place, shape, [*placed, corners, pixels], device=device)
        wp.launch(_surround, count, [corners, pixels, boxes], device=device)
        windows = np.array(
            [
                raster.window_of(box, margin_px, shot.lens.width, shot.lens.height)
                for box, shot in zip(boxes.numpy(), shots, strict=True)
            ]
        )
        sizes = (windows[:, 2] - windows[:, 0]) * (windows[:, 3] - windows[:, 1])
        starts = np.concatenate([[0], np.cumsum(sizes)])
        total = int(starts[-1])
        keys = wp.full(total, value=_EMPTY, dtype=wp.uint64, device=device)
        wp.launch(
            _draw,
            (count, len(surface.faces)),
            [
                corners,
                pixels,
                mesh.faces,
                int(surface.cull_back),
                lens_of,
                lenses.parameters,
                lenses.rays,
                lenses.starts,
                lenses.widths,
                wp.array(windows, dtype=wp.vec4i, device=device),
                wp.array(starts[:-1], dtype=wp.int64, device=device),
                keys,
            ],
            device=device,
        )
        depth = wp.empty(total, dtype=wp.float32, device=device)
        face = wp.empty(total, dtype=wp.int32, device=device)
        body = wp.empty(total, dtype=wp.int16, device=device)
        wp.launch(_unpack, total, [keys, depth, face, body], device=device)
        flat = [buffer.numpy() for buffer in (depth, face, body)]
        found = []
        for (x0, y0, x1, y1), start, size in zip(windows, starts, sizes, strict=False):
            images = [buffer[start : start + size].reshape(y1 - y0, x1 - x0) for buffer in flat]
            found.append(Rendering(int(x0), int(y0), *images))
        return found

    def visible(self, surface: Surface, shots: Sequence[Shot]) -> np.ndarray:
        """See :class:`.render.Renderer`; by rays from each vertex to the camera."""
        seen = np.empty((len(shots), len(surface.vertices)), bool)
        if not shots:
            return seen
        mesh = self._mesh(surface)
        vertices = np.asarray(surface.vertices, np.float64)
        normals = vertex_normals(vertices, surface.faces)
        eyes = np.empty((len(shots), 3))
        for number, shot in enumerate(shots):
            pose = shot.camera_from_mesh
            eyes[number] = -pose[:3, :3].T @ pose[:3, 3]
            seen[number] = ((eyes[number] - vertices) * normals).sum(1) > 0
            seen[number] &= shot.lens.sees(vertices @ pose[:3, :3].T + pose[:3, 3])
        asked: Any = wp.array(seen.astype(np.uint8), dtype=wp.uint8, device=self.device)
        lifted = vertices + VISIBLE_OFFSET_M * normals
        wp.launch(
            _look_for_eyes,
            seen.shape,
            [
                mesh.tree.id,
                wp.array(lifted.astype(np.float32), dtype=wp.vec3, device=self.device),
                wp.array(eyes.astype(np.float32), dtype=wp.vec3, device=self.device),
                asked,
            ],
            device=self.device,
        )
        return asked.numpy().astype(bool)

    def _mesh(self, surface: Surface) -> _Mesh:
        for known, mesh in self._meshes:
            if known.vertices is surface.vertices and known.faces is surface.faces:
                return mesh
        self._meshes = [(surface, _Mesh(surface, self.device)), *self._meshes][:KEPT_ON_DEVICE]
        return self._meshes[0][1]

    def _lenses_of(self, shots: Sequence[Shot]) -> tuple[_Lenses, np.ndarray]:
        """The lenses of all shots on the device, and which of them each shot has (N,)."""
        places: dict[int, int] = {}
        wanted: list[Intrinsics] = []
        for shot in shots:
            if id(shot.lens) not in places:
                places[id(shot.lens)] = len(wanted)
                wanted.append(shot.lens)
        lens_of = np.array([places[id(shot.lens)] for shot in shots], np.int32)
        for known, lenses in self._lenses:
            if len(known) == len(wanted) and all(map(lambda a, b: a is b, known, wanted)):
                return lenses, lens_of
        made = (tuple(wanted), _Lenses(wanted, self.device))
        self._lenses = [made, *self._lenses][:KEPT_ON_DEVICE]
        return made[1], lens_of
