"""The z-buffer of :mod:`.raster` for a GPU, in warp: one thread a triangle of a shot.

The same arithmetic in double precision (:mod:`.warp_kernels`). Which of several triangles is
nearest in a pixel is settled by one atomic minimum over depth and face id, so that the images do
not depend on the order of the threads. The same kernels run on warp's CPU device, where they are
tested against :mod:`.raster`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.rigid import raster
from intercap_core.geometry.rigid import warp_kernels as kernels
from intercap_core.geometry.rigid.constants import KEPT_ON_DEVICE, VISIBLE_OFFSET_M
from intercap_core.geometry.rigid.normals import vertex_normals
from intercap_core.geometry.rigid.shots import Rendering, Shot, Surface
from intercap_core.geometry.solve.thread_pool import ThreadPool


def has_cuda() -> bool:
    """Whether warp finds a GPU that it can use."""
    return bool(wp.get_cuda_device_count() > 0)


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
        wp.launch(kernels.place, shape, [*placed, corners, pixels], device=device)
        wp.launch(kernels.surround, count, [corners, pixels, boxes], device=device)
        windows = np.array(
            [
                raster.window_of(box, margin_px, shot.lens.width, shot.lens.height)
                for box, shot in zip(boxes.numpy(), shots, strict=True)
            ]
        )
        sizes = (windows[:, 2] - windows[:, 0]) * (windows[:, 3] - windows[:, 1])
        starts = np.concatenate([[0], np.cumsum(sizes)])
        total = int(starts[-1])
        keys = wp.full(total, value=kernels.EMPTY, dtype=wp.uint64, device=device)
        wp.launch(
            kernels.draw,
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
        wp.launch(kernels.unpack, total, [keys, depth, face, body], device=device)
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
            kernels.look_for_eyes,
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
