"""Rendering of masks, depth and face ids of meshes in real cameras, for many views and poses.

A pixel is covered if its undistorted ray passes through the triangle. Its depth is that of the
intersection of the ray and the triangle's plane. Both are exact for any lens. The projected corners
of a triangle determine only which pixels are tested, with a margin for the bend of its edges. Only
the window of the image that contains the object is drawn. The z-buffer is compiled for the CPU and
runs without the global interpreter lock.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numba
import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.projection_kernels import project_point
from intercap_core.geometry.rigid.shots import Drawable, Rendering, Shot, Surface
from intercap_core.geometry.solve.thread_pool import ThreadPool, threads_of_job

# Triangles with a corner nearer than this are skipped, metres: the range of the Azure Kinect begins
# at 0.25 m (data sheet).
NEAR_M = 0.05
# Margin of the window around the projected vertices, pixels: in known lenses, distorted edges reach
# beyond the bounding box of their corners by less than this.
BOX_MARGIN_PX = 2


class Renderer:
    """Draws one mesh in many views and poses at once, on ``threads`` threads.

    A shot's image does not depend on the others.
    """

    def __init__(self, threads: int = 1) -> None:
        self.pool = ThreadPool(threads)

    def draw(
        self, surface: Surface, shots: Sequence[Shot], *, margin_px: int = 0
    ) -> list[Rendering]:
        """Return each shot's smallest window that contains the mesh, widened by ``margin_px``."""
        vertices = np.ascontiguousarray(surface.vertices, np.float64)
        faces = np.ascontiguousarray(surface.faces, np.int32)

        def draw_shot(shot: Shot) -> Rendering:
            lens = shot.lens
            pose = np.ascontiguousarray(shot.camera_from_mesh, np.float64)
            return Rendering(
                *_draw_alone(
                    vertices, faces, surface.cull_back, pose, lens.parameters, lens.rays, margin_px
                )
            )

        return self.pool.map(draw_shot, shots)


@lru_cache(maxsize=1)
def default_renderer() -> Renderer:
    """Return the renderer with as many threads as the job may use."""
    return Renderer(threads_of_job())


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
    """Draw meshes that occlude each other, in the smallest window that contains all of them.

    The window is widened by ``margin_px`` and clipped to the image; it is empty (0, 0) if nothing
    is in view. Rays outside the lens's calibrated radius hit nothing.
    """
    parameters, rays = intrinsics.parameters, intrinsics.rays
    box = np.array([np.inf, np.inf, -np.inf, -np.inf])
    placed = [
        _place(
            np.ascontiguousarray(drawable.vertices, np.float64),
            np.ascontiguousarray(drawable.camera_from_mesh, np.float64),
            parameters,
            box,
        )
        for drawable in drawables
    ]
    x0, y0, x1, y1 = _window_of(box, margin_px, intrinsics.width, intrinsics.height)
    depth, face, body = _blank(y1 - y0, x1 - x0)
    if x1 > x0:
        focal = min(intrinsics.fx, intrinsics.fy)
        for number, (drawable, (corners, pixels)) in enumerate(zip(drawables, placed, strict=True)):
            faces = np.ascontiguousarray(drawable.faces, np.int32)
            _draw(
                corners, pixels, x0, y0, faces, rays, focal, drawable.cull_back,
                np.int16(number), depth, face, body,
            )  # fmt: skip
        _finish(depth, face)
    return Rendering(x0, y0, depth, face, body)


@numba.njit(cache=True, nogil=True)
def _place(vertices, pose, parameters, box):
    """Return corners (V, 3) in the camera's frame and their pixels (V, 2); ``pose`` (4, 4).

    Extends ``box`` (4,) = left, top, right, bottom by the points beyond ``NEAR_M``.
    """
    count = vertices.shape[0]
    corners, pixels = np.empty((count, 3)), np.empty((count, 2))
    for i in range(count):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        for axis in range(3):
            corners[i, axis] = (
                pose[axis, 0] * x + pose[axis, 1] * y + pose[axis, 2] * z + pose[axis, 3]
            )
        u, v = project_point(corners[i, 0], corners[i, 1], corners[i, 2], parameters)
        pixels[i, 0], pixels[i, 1] = u, v
        if corners[i, 2] > NEAR_M:
            box[0], box[1] = min(box[0], u), min(box[1], v)
            box[2], box[3] = max(box[2], u), max(box[3], v)
    return corners, pixels


@numba.njit(cache=True, nogil=True)
def _window_of(box, margin_px, width, height):
    """Return the box, widened and clipped to the image: x0, y0, x1, y1; zeros if it is empty."""
    margin = margin_px + BOX_MARGIN_PX
    x0 = max(np.floor(min(box[0], 1e6)) - margin, 0.0)
    y0 = max(np.floor(min(box[1], 1e6)) - margin, 0.0)
    x1 = min(np.ceil(max(box[2], -1e6)) + margin + 1, float(width))
    y1 = min(np.ceil(max(box[3], -1e6)) + margin + 1, float(height))
    if x1 <= x0 or y1 <= y0:
        return 0, 0, 0, 0
    return int(x0), int(y0), int(x1), int(y1)


@numba.njit(cache=True, nogil=True)
def _draw(corners, pixels, x0, y0, faces, rays, focal, cull_back, number, depth, face, body):
    """Draw one mesh into the z-buffer of a window.

    Camera and triangle span a pyramid. For each triangle, the pixels within the bounds of its
    projected corners are visited row by row, with ``slack`` px for bent edges. A pixel is covered
    if its ray (x, y, 1) is inside the three sides of the pyramid. Its depth z follows from the
    plane of the triangle, s . (x, y, 1) z = volume with the normal s.

    Args:
        corners: (V, 3) vertices in the camera's frame, metres.
        pixels: (V, 2) projected vertices, pixels of the image.
        x0, y0: first pixel of the window.
        rays: (H, W, 2) X/Z and Y/Z of the pixels of the whole image.
        focal: focal length, pixels.
        number: index of the mesh, written to ``body``.
        depth: (h, w) metres, infinite where nothing is drawn; updated where this mesh is nearer.
        face, body: (h, w) indices of face and mesh, updated at the same pixels.
    """
    height, width = depth.shape
    bounds = np.empty((3, 3))
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = corners[i, 0], corners[i, 1], corners[i, 2]
        bx, by, bz = corners[j, 0], corners[j, 1], corners[j, 2]
        cx, cy, cz = corners[k, 0], corners[k, 1], corners[k, 2]
        # sides of the pyramid from the camera through the triangle: a x b, b x c, c x a
        n0x, n0y, n0z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        # six times the volume of the pyramid; negative if the triangle faces the camera
        volume = n0x * cx + n0y * cy + n0z * cz
        if volume == 0.0 or (cull_back and volume > 0.0):
            continue
        if az < NEAR_M or bz < NEAR_M or cz < NEAR_M:
            continue
        left = min(pixels[i, 0], pixels[j, 0], pixels[k, 0]) - x0
        right = max(pixels[i, 0], pixels[j, 0], pixels[k, 0]) - x0
        top = min(pixels[i, 1], pixels[j, 1], pixels[k, 1]) - y0
        bottom = max(pixels[i, 1], pixels[j, 1], pixels[k, 1]) - y0
        extent = max(right - left, bottom - top)
        # 0.1 px for rounding, and 0.15 L^2 / f for the bend of an edge of L px by distortion.
        # Measured between any two pixels of Azure Kinects' colour and depth images, the bend is at
        # most 0.135 L^2 / f.
        slack = 0.1 + 0.15 * extent * extent / focal
        u0, u1 = max(left - slack, 0.0), min(right + slack, width - 1.0)
        v0, v1 = max(top - slack, 0.0), min(bottom + slack, height - 1.0)
        if u0 > u1 or v0 > v1:
            continue
        first, last = int(np.ceil(u0)), int(u1) + 1
        n1x, n1y, n1z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        n2x, n2y, n2z = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
        sx, sy, sz = n0x + n1x + n2x, n0y + n1y + n2y, n0z + n1z + n2z  # the plane's normal
        sign = 1.0 if volume > 0.0 else -1.0
        narrow = extent > 6.0  # px; bounding each row by the edges is faster in larger triangles
        if narrow:
            _bound(0, pixels[i], pixels[j], pixels[k], x0, y0, slack, bounds)
            _bound(1, pixels[j], pixels[k], pixels[i], x0, y0, slack, bounds)
            _bound(2, pixels[k], pixels[i], pixels[j], x0, y0, slack, bounds)
        for v in range(int(np.ceil(v0)), int(v1) + 1):
            if narrow:
                low, high = u0, u1
                for edge in range(3):
                    bound = bounds[edge, 0] * v + bounds[edge, 1]
                    if bounds[edge, 2] > 0.0:
                        low = max(low, bound)
                    elif bounds[edge, 2] < 0.0:
                        high = min(high, bound)
                first, last = int(np.ceil(low)), int(high) + 1
            for u in range(first, last):
                x, y = np.float64(rays[y0 + v, x0 + u, 0]), np.float64(rays[y0 + v, x0 + u, 1])
                if (
                    sign * (n0x * x + n0y * y + n0z) >= 0.0
                    and sign * (n1x * x + n1y * y + n1z) >= 0.0
                    and sign * (n2x * x + n2y * y + n2z) >= 0.0
                ):
                    z = np.float32(volume / (sx * x + sy * y + sz))
                    if z < depth[v, u]:
                        depth[v, u] = z
                        face[v, u] = f
                        body[v, u] = number


@numba.njit(cache=True, nogil=True)
def _bound(edge, p, q, opposite, x0, y0, slack, bounds):
    """Bound the columns of each row to those inside the projected edge p q, with a margin.

    The inner side is that of the corner ``opposite``. Columns up to ``slack`` px outside are kept.
    Writes ``bounds[edge]`` (3,) = a, b, sign: in a row, the column a * row + b of the window is the
    first one (sign 1) or the last one (sign -1); sign 0 = no bound.

    p, q, opposite: pixels (2,) of the image. x0, y0: first pixel of the window.
    """
    du, dv = q[0] - p[0], q[1] - p[1]
    inner = du * (opposite[1] - p[1]) - dv * (opposite[0] - p[0])
    side = 1.0 if inner > 0.0 else -1.0
    # a pixel's distance inside the edge, times the edge's length, is
    # across * (its column - p's) + along * (its row - p's)
    across, along = -side * dv, side * du
    if inner == 0.0 or abs(across) < 1e-9:
        bounds[edge, 2] = 0.0
        return
    offset = across * (p[0] - x0) + along * (p[1] - y0) - slack * np.sqrt(du * du + dv * dv)
    bounds[edge, 0] = -along / across
    bounds[edge, 1] = offset / across
    bounds[edge, 2] = 1.0 if across > 0.0 else -1.0


@numba.njit(cache=True, nogil=True)
def _blank(height, width):
    """Return empty buffers of a window (h, w): depth, face, body."""
    depth = np.full((height, width), np.float32(np.inf), np.float32)
    face = np.full((height, width), -1, np.int32)
    body = np.full((height, width), -1, np.int16)
    return depth, face, body


@numba.njit(cache=True, nogil=True)
def _finish(depth, face):
    """Set the depth to 0 where nothing was hit."""
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if face[v, u] < 0:
                depth[v, u] = 0


@numba.njit(cache=True, nogil=True)
def _draw_alone(vertices, faces, cull_back, pose, parameters, rays, margin_px):
    """Draw one mesh in the smallest window that contains it; returns fields of `Rendering`."""
    box = np.array([np.inf, np.inf, -np.inf, -np.inf])
    corners, pixels = _place(vertices, pose, parameters, box)
    x0, y0, x1, y1 = _window_of(box, margin_px, rays.shape[1], rays.shape[0])
    depth, face, body = _blank(y1 - y0, x1 - x0)
    if x1 > x0:
        focal = min(parameters[0], parameters[1])
        _draw(
            corners, pixels, x0, y0, faces, rays, focal, cull_back, np.int16(0), depth, face, body
        )  # fmt: skip
        _finish(depth, face)
    return x0, y0, depth, face, body
