"""Shaded pictures of meshes through a real lens, smooth at the edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.rigid.normals import vertex_normals
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.geometry.rigid.shots import Drawable, Rendering

_AMBIENT = 0.38
_LIGHT = np.array([-0.35, -0.55, -0.76])  # towards the light, camera frame: above, left, in front
_SMOOTHING = 2  # pictures are drawn this much larger and scaled down


@dataclass(frozen=True, eq=False)
class Painted:
    """A mesh in its own frame with colours (V, 3) in 0..1, RGB, and its place in the camera."""

    vertices: np.ndarray
    faces: np.ndarray
    colours: np.ndarray
    camera_from_mesh: np.ndarray


@dataclass(frozen=True, eq=False)
class Picture:
    """``rgb`` (H, W, 3) float in 0..1, premultiplied by ``alpha`` (H, W)."""

    rgb: np.ndarray
    alpha: np.ndarray

    def over(self, background: np.ndarray, opacity: float = 1.0) -> np.ndarray:
        """Lay over an image (H, W, 3) in 0..1."""
        return self.rgb * opacity + background * (1 - opacity * self.alpha[..., None])


def draw(meshes: Sequence[Painted], lens: Intrinsics) -> Picture:
    """Draw meshes that hide each other, in the whole image of ``lens``."""
    fine = lens.scaled(_SMOOTHING)
    rendering = render_scene(
        [Drawable(m.vertices, m.faces, m.camera_from_mesh) for m in meshes], fine
    )
    large = np.zeros((fine.height, fine.width, 4), np.float32)
    if rendering.depth.size:
        large[rendering.window] = _shade(meshes, rendering, fine)
    image = cv2.resize(large, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    return Picture(image[..., :3], image[..., 3])


def _shade(meshes: Sequence[Painted], rendering: Rendering, lens: Intrinsics) -> np.ndarray:
    """RGBA (h, w, 4) of the window: interpolated colours under one light and an ambient."""
    result = np.zeros((*rendering.depth.shape, 4), np.float32)
    rays = lens.rays[rendering.window]
    light = _LIGHT / np.linalg.norm(_LIGHT)
    for number, mesh in enumerate(meshes):
        rows, columns = np.nonzero(rendering.body == number)
        if len(rows) == 0:
            continue
        pose = mesh.camera_from_mesh
        vertices = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
        corners = mesh.faces[rendering.face[rows, columns]]
        depth = rendering.depth[rows, columns, None]
        points = np.concatenate([rays[rows, columns] * depth, depth], 1)
        weights = _barycentric(points, *(vertices[corners[:, k]] for k in range(3)))
        normals = _mix(vertex_normals(vertices, mesh.faces), corners, weights)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        lit = _AMBIENT + (1 - _AMBIENT) * np.clip(normals @ light, 0, 1)
        colours = _mix(mesh.colours, corners, weights) * lit[:, None]
        result[rows, columns, :3] = colours
        result[rows, columns, 3] = 1
    return result


def _barycentric(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Weights (N, 3) of the corners at points p (N, 3) on triangles a, b, c (N, 3)."""
    normal = np.cross(b - a, c - a)
    scale = np.maximum((normal * normal).sum(1), 1e-20)
    of_b = (np.cross(p - a, c - a) * normal).sum(1) / scale
    of_c = (np.cross(b - a, p - a) * normal).sum(1) / scale
    weights = np.column_stack([1 - of_b - of_c, of_b, of_c])
    return np.clip(weights, 0, 1)


def _mix(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return sum(values[corners[:, k]] * weights[:, k, None] for k in range(3))
