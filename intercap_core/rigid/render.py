"""Masks, depth and face ids of meshes in a real camera, and which vertices it sees.

A z-buffer in numba with exact lenses: a pixel is covered where its undistorted ray (Intrinsics
.rays) passes through the triangle, and its depth is where the ray meets the triangle's plane, so
only the search window of a triangle comes from projected corners. Only the projected box of the
object is drawn. Measured on one core, six views of 640x576: 0.9-4.9 ms for the ten objects at
2.2 m (20-200 px high), where Open3D rays cropped to the same box take 0.7-10 ms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
import open3d as o3d

from intercap_core.camera.intrinsics import Intrinsics

NEAR_M = 0.05  # triangles that reach nearer than this are left out: no Kinect images them
_BOX_MARGIN_PX = 2  # straight edges between projected corners bend by less in any known lens
_NO_FACE = -1


@dataclass(frozen=True, eq=False)
class Rendering:
    """A window of the image; pixel [0, 0] is image pixel (x0, y0).

    ``depth`` (h, w) float32, z in the camera's frame, metres, 0 where nothing is hit; ``face``
    (h, w) int32, -1 where nothing is hit; ``body`` (h, w) int16, which of the meshes drawn, -1
    where none.
    """

    x0: int
    y0: int
    depth: np.ndarray
    face: np.ndarray
    body: np.ndarray

    @property
    def mask(self) -> np.ndarray:
        """Where a mesh is hit (h, w) bool."""
        return self.face >= 0

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the image that the window covers."""
        height, width = self.depth.shape
        return slice(self.y0, self.y0 + height), slice(self.x0, self.x0 + width)

    def full_mask(self, intrinsics: Intrinsics, body: int | None = None) -> np.ndarray:
        """The mask (H, W) in the whole image, of one mesh or of all."""
        image = np.zeros((intrinsics.height, intrinsics.width), bool)
        image[self.window] = self.mask if body is None else self.body == body
        return image


@dataclass(frozen=True, eq=False)
class Drawable:
    """A mesh and where it is: ``vertices`` (V, 3), ``faces`` (F, 3), ``camera_from_mesh`` (4, 4).

    ``cull_back`` leaves out faces that look away: right, and twice as fast, for closed meshes.
    """

    vertices: np.ndarray
    faces: np.ndarray
    camera_from_mesh: np.ndarray
    cull_back: bool = True


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
    corners, pixels = [], []
    box = np.array([np.inf, np.inf, -np.inf, -np.inf])
    for drawable in drawables:
        pose = drawable.camera_from_mesh
        points = drawable.vertices @ pose[:3, :3].T + pose[:3, 3]
        corners.append(points)
        pixels.append(_project(points, intrinsics.parameters, box))
    margin = margin_px + _BOX_MARGIN_PX
    size = (intrinsics.width, intrinsics.height)
    x0, y0 = (int(max(np.floor(min(v, 1e6)) - margin, 0)) for v in box[:2])
    x1, y1 = (
        int(min(np.ceil(max(v, -1e6)) + margin + 1, n)) for v, n in zip(box[2:], size, strict=True)
    )
    if x1 <= x0 or y1 <= y0:
        empty = np.zeros((0, 0))
        return Rendering(
            0, 0, empty.astype(np.float32), empty.astype(np.int32), empty.astype(np.int16)
        )
    depth = np.full((y1 - y0, x1 - x0), np.inf, np.float32)
    face = np.full(depth.shape, _NO_FACE, np.int32)
    body = np.full(depth.shape, _NO_FACE, np.int16)
    rays = intrinsics.rays[y0:y1, x0:x1]
    for number, drawable in enumerate(drawables):
        _draw(
            corners[number],
            pixels[number],
            x0,
            y0,
            np.asarray(drawable.faces),
            rays,
            drawable.cull_back,
            np.int16(number),
            depth,
            face,
            body,
        )
    depth[face < 0] = 0
    return Rendering(x0, y0, depth, face, body)


@numba.njit(cache=True)
def _project(points, parameters, box):
    """Pixels (V, 2) as :func:`intercap_core.camera.projection.project`, compiled for few points.

    Widens ``box`` (4,) = left, top, right, bottom by the points that are not too near. Only the
    search window of a triangle depends on it, never which pixels it covers.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, limit = parameters
    pixels = np.empty((points.shape[0], 2))
    for i in range(points.shape[0]):
        z = max(points[i, 2], 1e-3)
        x, y = points[i, 0] / z, points[i, 1] / z
        stretch = max(np.sqrt(x * x + y * y) / limit, 1.0)
        x, y = x / stretch, y / stretch
        s = x * x + y * y
        d = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
        u = fx * stretch * (x * d + 2 * p1 * x * y + p2 * (s + 2 * x * x)) + cx
        v = fy * stretch * (y * d + p1 * (s + 2 * y * y) + 2 * p2 * x * y) + cy
        pixels[i, 0], pixels[i, 1] = u, v
        if points[i, 2] > NEAR_M:
            box[0], box[1] = min(box[0], u), min(box[1], v)
            box[2], box[3] = max(box[2], u), max(box[3], v)
    return pixels


@numba.njit(cache=True)
def _draw(corners, pixels, x0, y0, faces, rays, cull_back, number, depth, face, body):
    """Z-buffer: corners (V, 3) camera frame, pixels (V, 2) of the image, rays (h, w, 2)."""
    height, width = depth.shape
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = corners[i, 0], corners[i, 1], corners[i, 2]
        bx, by, bz = corners[j, 0], corners[j, 1], corners[j, 2]
        cx, cy, cz = corners[k, 0], corners[k, 1], corners[k, 2]
        if az < NEAR_M or bz < NEAR_M or cz < NEAR_M:
            continue
        # sides of the pyramid from the camera through the triangle: a x b, b x c, c x a
        n0x, n0y, n0z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        n1x, n1y, n1z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        n2x, n2y, n2z = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
        volume = n0x * cx + n0y * cy + n0z * cz  # of the pyramid; negative where facing us
        if volume == 0.0 or (cull_back and volume > 0.0):
            continue
        sign = 1.0 if volume > 0.0 else -1.0
        left = min(pixels[i, 0], pixels[j, 0], pixels[k, 0]) - x0
        right = max(pixels[i, 0], pixels[j, 0], pixels[k, 0]) - x0
        top = min(pixels[i, 1], pixels[j, 1], pixels[k, 1]) - y0
        bottom = max(pixels[i, 1], pixels[j, 1], pixels[k, 1]) - y0
        if right < -1.0 or bottom < -1.0 or left > width or top > height:
            continue
        u0, u1 = max(int(np.floor(left - 0.25)), 0), min(int(np.ceil(right + 0.25)) + 1, width)
        v0, v1 = max(int(np.floor(top - 0.25)), 0), min(int(np.ceil(bottom + 0.25)) + 1, height)
        sx, sy, sz = n0x + n1x + n2x, n0y + n1y + n2y, n0z + n1z + n2z  # the plane's normal
        for v in range(v0, v1):
            for u in range(u0, u1):
                x, y = np.float64(rays[v, u, 0]), np.float64(rays[v, u, 1])
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


class OcclusionScene:
    """Which vertices of a mesh a camera sees, the mesh itself and others in the way.

    All meshes in one common frame. Built once for a frame of the capture, asked for each camera.
    ``offset_m`` lifts a vertex off its own surface before the ray is cast.
    """

    def __init__(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        occluders: Sequence[tuple[np.ndarray, np.ndarray]] = (),
        *,
        offset_m: float = 0.001,
        threads: int = 0,
    ) -> None:
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=threads)
        for points, triangles in [(vertices, faces), *occluders]:
            self._scene.add_triangles(
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, np.float32)),
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(triangles, np.uint32)),
            )
        self._vertices = np.asarray(vertices, np.float64)
        self._normals = vertex_normals(self._vertices, faces)
        self._offset = offset_m

    def visible(self, intrinsics: Intrinsics, camera_from_mesh: np.ndarray) -> np.ndarray:
        """Whether each vertex (V,) is in the image, faces the camera and is not hidden."""
        rotation, translation = camera_from_mesh[:3, :3], camera_from_mesh[:3, 3]
        eye = -rotation.T @ translation
        to_eye = eye - self._vertices
        seen = np.einsum("ij,ij->i", to_eye, self._normals) > 0
        seen &= intrinsics.sees(self._vertices @ rotation.T + translation)
        ids = np.flatnonzero(seen)
        if len(ids):
            start = self._vertices[ids] + self._offset * self._normals[ids]
            rays = np.concatenate([start, eye - start], 1).astype(np.float32)
            hidden = self._scene.test_occlusions(
                o3d.core.Tensor.from_numpy(rays), tnear=0.0, tfar=1.0
            )
            seen[ids[hidden.numpy()]] = False
        return seen


def visible_vertices(
    vertices: np.ndarray,
    faces: np.ndarray,
    intrinsics: Intrinsics,
    camera_from_mesh: np.ndarray,
    *,
    occluders: Sequence[tuple[np.ndarray, np.ndarray]] = (),
) -> np.ndarray:
    """Whether one camera sees each vertex (V,) bool; :class:`OcclusionScene` for several."""
    scene = OcclusionScene(vertices, faces, occluders)
    return scene.visible(intrinsics, camera_from_mesh)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted outward unit normals (V, 3)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(face_normals[:, axis], 3), minlength=len(vertices))
            for axis in range(3)
        ],
        1,
    )
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)
