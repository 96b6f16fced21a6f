"""Masks, depth and face ids of meshes in real cameras, for many views and poses at once.

One interface, :class:`Renderer`, and two backends: the z-buffer of :mod:`.raster` on the CPU and
the same in :mod:`.render_warp` on a GPU. Lenses are exact (a pixel is covered where its undistorted
ray passes through the triangle) and only the projected box of the object is drawn.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, Protocol

import numpy as np

from intercap_core.errors import UserError
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.rigid import raster
from intercap_core.geometry.rigid.shots import Drawable, Rendering, Shot, Surface
from intercap_core.geometry.solve.thread_pool import ThreadPool

Device = Literal["auto", "cpu", "cuda"]


class Renderer(Protocol):
    """Draws one mesh in many views and poses at once. A shot's image does not depend on the others.

    ``device`` names where it runs, ``pool`` are the threads that the host may use beside it.
    """

    device: str
    pool: ThreadPool

    def draw(
        self, surface: Surface, shots: Sequence[Shot], *, margin_px: int = 0
    ) -> list[Rendering]:
        """The smallest window that holds the mesh, widened by ``margin_px``, of every shot."""
        ...

    def visible(self, surface: Surface, shots: Sequence[Shot]) -> np.ndarray:
        """Whether each shot (N) sees each vertex: (N, V) bool.

        It does where the vertex is in the image, faces the camera and the mesh does not hide it.
        """
        ...


class CpuRenderer:
    """The z-buffer compiled for the CPU, shots side by side on ``threads`` threads."""

    device = "cpu"

    def __init__(self, threads: int = 1) -> None:
        self.pool = ThreadPool(threads)

    def draw(
        self, surface: Surface, shots: Sequence[Shot], *, margin_px: int = 0
    ) -> list[Rendering]:
        """See :class:`Renderer`."""
        vertices = np.ascontiguousarray(surface.vertices, np.float64)
        faces = np.ascontiguousarray(surface.faces, np.int32)

        def one(shot: Shot) -> Rendering:
            lens = shot.lens
            pose = np.ascontiguousarray(shot.camera_from_mesh, np.float64)
            return Rendering(
                *raster.draw_alone(
                    vertices, faces, surface.cull_back, pose, lens.parameters, lens.rays, margin_px
                )
            )

        return self.pool.map(one, shots)

    def visible(self, surface: Surface, shots: Sequence[Shot]) -> np.ndarray:
        """See :class:`Renderer`."""
        from intercap_core.geometry.rigid.distance import OcclusionScene

        scene = OcclusionScene(surface.vertices, surface.faces, threads=self.pool.threads)
        return np.array([scene.visible(shot.lens, shot.camera_from_mesh) for shot in shots])


def open_renderer(device: Device = "auto", *, threads: int | None = None) -> Renderer:
    """The renderer of a device; ``auto`` takes a GPU where there is one that can be used.

    ``threads`` of the host: by default as many as the job may use (OMP_NUM_THREADS, else one).
    Raises UserError where ``cuda`` is asked for and there is no such device or no warp.
    """
    threads = _threads_of_job() if threads is None else threads
    if device == "cpu":
        return CpuRenderer(threads)
    try:
        from intercap_core.geometry.rigid.render_warp import WarpRenderer, has_cuda
    except ImportError:
        if device == "auto":
            return CpuRenderer(threads)
        raise UserError(
            "rendering on device 'cuda' needs warp, which is not installed; run "
            "pip install 'intercap-core[gpu]', or set object_track.render_on: cpu"
        ) from None
    if has_cuda():
        return WarpRenderer("cuda:0", threads=threads)
    if device == "auto":
        return CpuRenderer(threads)
    raise UserError(
        "rendering was asked for on device 'cuda', but warp finds no such device here; set "
        "object_track.render_on: cpu, or run on a machine that has one"
    )


@lru_cache(maxsize=1)
def default_renderer() -> Renderer:
    """The CPU, with as many threads as the job may use."""
    return CpuRenderer(_threads_of_job())


def _threads_of_job() -> int:
    given = os.environ.get("OMP_NUM_THREADS", "")
    return int(given) if given.isdigit() and int(given) > 0 else 1


def render(
    vertices: np.ndarray,
    faces: np.ndarray,
    intrinsics: Intrinsics,
    camera_from_mesh: np.ndarray,
    *,
    margin_px: int = 0,
    cull_back: bool = True,
) -> Rendering:
    """Draw one mesh (V, 3), (F, 3) in one camera; see :func:`render_scene`."""
    drawable = Drawable(vertices, faces, camera_from_mesh, cull_back)
    return render_scene([drawable], intrinsics, margin_px=margin_px)


def render_scene(
    drawables: Sequence[Drawable], intrinsics: Intrinsics, *, margin_px: int = 0
) -> Rendering:
    """Draw meshes that occlude each other, in the smallest window that holds them all.

    The window is widened by ``margin_px`` and clipped to the image; it is empty (0, 0) where
    nothing is in view. Rays outside the lens's calibrated radius hit nothing.
    """
    parameters, rays = intrinsics.parameters, intrinsics.rays
    box = np.array([np.inf, np.inf, -np.inf, -np.inf])
    placed = [
        raster.place(
            np.ascontiguousarray(drawable.vertices, np.float64),
            np.ascontiguousarray(drawable.camera_from_mesh, np.float64),
            parameters,
            box,
        )
        for drawable in drawables
    ]
    x0, y0, x1, y1 = raster.window_of(box, margin_px, intrinsics.width, intrinsics.height)
    depth, face, body = raster.blank(y1 - y0, x1 - x0)
    if x1 > x0:
        focal = min(intrinsics.fx, intrinsics.fy)
        for number, (drawable, (corners, pixels)) in enumerate(zip(drawables, placed, strict=True)):
            faces = np.ascontiguousarray(drawable.faces, np.int32)
            raster.draw(
                corners, pixels, x0, y0, faces, rays, focal, drawable.cull_back,
                np.int16(number), depth, face, body,
            )  # fmt: skip
        raster.finish(depth, face)
    return Rendering(x0, y0, depth, face, body)
