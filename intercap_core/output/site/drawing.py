"""Shaded pictures of meshes through a real lens, smooth at the edges."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.geometry.rigid.shots import Drawable, Rendering
from intercap_core.geometry.rigid.surfaces import vertex_normals

_JPEG_QUALITY = 82
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


def encode_jpeg(rgb: np.ndarray) -> bytes:
    """JPEG of an image (H, W, 3) in 0..1."""
    bgr = np.rint(np.clip(rgb[..., ::-1], 0, 1) * 255).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    return cv2.imencode(".jpg", bgr, options)[1].tobytes()


def encode_png(picture: Picture) -> bytes:
    """PNG with transparency."""
    alpha = picture.alpha[..., None]
    straight = picture.rgb / np.maximum(alpha, 1e-6)
    bgra = np.concatenate([straight[..., ::-1], alpha], 2)
    pixels = np.rint(np.clip(bgra, 0, 1) * 255).astype(np.uint8)
    return cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()


_GAP_PX, _HEAD_PX = 4, 18
_GROUND = (19, 22, 27)
_INK, _DIM = (235, 235, 235), (120, 128, 138)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, eq=False)
class Sheet:
    """``jpeg`` bytes: a row for each of ``frames``, a column for each camera."""

    jpeg: bytes
    width: int
    height: int
    frames: Sequence[int]


@dataclass(frozen=True)
class Crop:
    """A square of ``size`` image pixels with its corner at (x0, y0), shown as ``cell`` pixels."""

    x0: int
    y0: int
    size: int
    cell: int

    def of(self, rgb: np.ndarray) -> np.ndarray:
        """The part of an image (H, W, 3) as a cell; its rim goes on where the image ends."""
        centre = (self.x0 + (self.size - 1) / 2, self.y0 + (self.size - 1) / 2)
        window = cv2.getRectSubPix(np.ascontiguousarray(rgb), (self.size, self.size), centre)
        return cv2.resize(window, (self.cell, self.cell), interpolation=cv2.INTER_AREA)

    def outline(
        self,
        cell: np.ndarray,
        mask: np.ndarray,
        x: int,
        y: int,
        colour: tuple[int, int, int],
    ) -> None:
        """Draw the rim of a mask (h, w) whose corner is at image pixel (x, y)."""
        square = np.zeros((self.size, self.size), np.uint8)
        height, width = mask.shape
        x, y = x - self.x0, y - self.y0
        left, top = max(x, 0), max(y, 0)
        right, bottom = min(x + width, self.size), min(y + height, self.size)
        if right > left and bottom > top:
            square[top:bottom, left:right] = mask[top - y : bottom - y, left - x : right - x]
        small = cv2.resize(square, (self.cell, self.cell), interpolation=cv2.INTER_NEAREST)
        contours, _ = cv2.findContours(small, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(cell, contours, -1, colour, 1, cv2.LINE_AA)

    def placed(self, pixels: np.ndarray) -> np.ndarray:
        """Image pixels (N, 2) as whole pixels of the cell."""
        scaled = (pixels - [self.x0, self.y0] + 0.5) * (self.cell / self.size) - 0.5
        return np.rint(np.clip(scaled, -1e4, 1e4)).astype(int)


CellDrawer = Callable[[Camera, int, int, np.ndarray], np.ndarray | None]


def make_sheet(
    images: Frames, rig: Rig, frames: Sequence[int], cell_px: int, draw: CellDrawer
) -> Sheet:
    """``draw(camera, t, c, rgb)`` gives a cell of ``cell_px``, None where nothing is in view.

    ``images`` show each frame's moment (:meth:`Frames.showing`).
    """
    step = cell_px + _GAP_PX
    sheet = np.empty((len(frames) * step + _HEAD_PX, len(rig) * step, 3), np.uint8)
    sheet[:] = _GROUND
    for c, camera in enumerate(rig):
        cv2.putText(sheet, camera.name[:16], (c * step + 4, 13), _FONT, 0.42, _INK, 1, cv2.LINE_AA)
        for row, t in enumerate(frames):
            image = images.colour(t, c)
            cell = None if image is None else draw(camera, t, c, image[..., ::-1])
            y, x = _HEAD_PX + row * step, c * step
            if cell is not None:
                sheet[y : y + cell_px, x : x + cell_px] = cell
            if c == 0 or cell is None:
                words = f"frame {t}" if c == 0 else "no image" if image is None else "not in view"
                ink = _INK if cell is not None else _DIM
                cv2.putText(sheet, words, (x + 4, y + 13), _FONT, 0.4, (0, 0, 0), 3, cv2.LINE_AA)
                cv2.putText(sheet, words, (x + 4, y + 13), _FONT, 0.4, ink, 1, cv2.LINE_AA)
    height, width = sheet.shape[:2]
    return Sheet(encode_jpeg(sheet / np.float32(255)), width, height, list(frames))
