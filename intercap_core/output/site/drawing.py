"""Encoded images, anti-aliased renderings of meshes, and sheets of small pictures."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import trimesh
from PIL import Image

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.geometry.rigid.shots import Drawable, Rendering
from intercap_core.geometry.rigid.surfaces import vertex_normals


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """A compressed image for a page."""

    content: bytes
    """Content of the image file."""
    kind: Literal["jpeg", "png", "webp"]
    width: int
    height: int
    caption: str = ""
    """Caption on the page, "" for none."""

    @property
    def data(self) -> str:
        """The image as the part of a data URL after ``data:``, as templates print it."""
        return f"image/{self.kind};base64,{base64.b64encode(self.content).decode()}"


@dataclass(frozen=True, eq=False, kw_only=True)
class ColouredMesh(Drawable):
    """A mesh with its pose and a colour."""

    colours: np.ndarray | tuple[float, ...]
    """RGB in 0..1: (V, 3) by vertex, or (3,) for all."""

    def seen_by(self, camera: Camera) -> ColouredMesh:
        """Return the mesh in the frame of a camera; ``self`` is in the master camera's frame."""
        pose = camera.colour_from_master @ self.camera_from_mesh
        return replace(self, camera_from_mesh=pose)


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """A rendering with transparency."""

    rgb: np.ndarray
    """(H, W, 3) float in 0..1, premultiplied by ``alpha``."""
    alpha: np.ndarray
    """(H, W) in 0..1."""

    def over(self, background: np.ndarray, opacity: float = 1.0) -> np.ndarray:
        """Blend over an image (H, W, 3) in 0..1."""
        return self.rgb * opacity + background * (1 - opacity * self.alpha[..., None])


def draw(meshes: Sequence[ColouredMesh], lens: Intrinsics) -> RenderedImage:
    """Render meshes with mutual occlusion into the whole image of ``lens``."""
    fine = lens.scaled(2)  # supersampling
    rendering = render_scene(meshes, fine)
    large = np.zeros((fine.height, fine.width, 4), np.float32)
    if rendering.depth.size:
        large[rendering.window] = _shade(meshes, rendering, fine)
    image = cv2.resize(large, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    return RenderedImage(image[..., :3], image[..., 3])


def _shade(meshes: Sequence[ColouredMesh], rendering: Rendering, lens: Intrinsics) -> np.ndarray:
    """Shade the rendering's window: interpolated colours, one light and ambient light.

    Returns RGBA (h, w, 4).
    """
    result = np.zeros((*rendering.depth.shape, 4), np.float32)
    rays = lens.rays[rendering.window]
    light = np.array([-0.35, -0.55, -0.76])  # towards the light, camera frame: left, above, front
    light /= np.linalg.norm(light)
    ambient = 0.38
    for number, mesh in enumerate(meshes):
        rows, columns = np.nonzero(rendering.body == number)
        if len(rows) == 0:
            continue
        vertices = apply(mesh.camera_from_mesh, mesh.vertices)
        corners = mesh.faces[rendering.face[rows, columns]]
        depth = rendering.depth[rows, columns, None]
        points = np.concatenate([rays[rows, columns] * depth, depth], 1)
        weights = trimesh.triangles.points_to_barycentric(vertices[corners], points, "cross")
        weights = np.clip(weights, 0, 1)
        normals = _mix(vertex_normals(vertices, mesh.faces), corners, weights)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        lit = ambient + (1 - ambient) * np.clip(normals @ light, 0, 1)
        colours = np.broadcast_to(mesh.colours, vertices.shape)
        result[rows, columns, :3] = _mix(colours, corners, weights) * lit[:, None]
        result[rows, columns, 3] = 1
    return result


def _mix(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Interpolate values (V, 3) of vertices: ``corners`` (N, 3) indices, ``weights`` (N, 3)."""
    return sum(values[corners[:, k]] * weights[:, k, None] for k in range(3))


def look_along(direction: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) to the frame of a camera that looks along a unit ``direction``.

    The camera is held upright: x right, y down, z forward.
    """
    right = np.cross(direction, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(direction, right), direction])


def encode_jpeg(rgb: np.ndarray, caption: str = "") -> EncodedImage:
    """Encode an image (H, W, 3) in 0..1 as JPEG."""
    bgr = np.rint(np.clip(rgb[..., ::-1], 0, 1) * 255).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_QUALITY, 82, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    data = cv2.imencode(".jpg", bgr, options)[1].tobytes()
    return EncodedImage(data, "jpeg", bgr.shape[1], bgr.shape[0], caption)


def encode_animation(pictures: Sequence[np.ndarray], seconds: float, caption: str) -> EncodedImage:
    """Encode images (H, W, 3) in 0..1 as an endless animated WebP of ``seconds`` per round."""
    images = [
        Image.fromarray(np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)) for rgb in pictures
    ]
    stream = io.BytesIO()
    images[0].save(
        stream, "WEBP", save_all=True, append_images=images[1:], loop=0, quality=60, method=4,
        duration=max(1, round(1e3 * seconds / len(images))),
    )  # fmt: skip
    return EncodedImage(stream.getvalue(), "webp", images[0].width, images[0].height, caption)


def encode_png(picture: RenderedImage, caption: str = "") -> EncodedImage:
    """Encode a rendering as PNG with transparency."""
    alpha = picture.alpha[..., None]
    straight = picture.rgb / np.maximum(alpha, 1e-6)
    bgra = np.concatenate([straight[..., ::-1], alpha], 2)
    pixels = np.rint(np.clip(bgra, 0, 1) * 255).astype(np.uint8)
    data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
    return EncodedImage(data, "png", pixels.shape[1], pixels.shape[0], caption)


@dataclass(frozen=True)
class SquareCrop:
    """A square part of an image, shown at another size."""

    x0: int
    """Left edge in the image, pixels; may be negative."""
    y0: int
    """Upper edge in the image, pixels; may be negative."""
    size: int
    """Side in pixels of the image."""
    cell: int
    """Side in pixels of the cell in which it is shown."""

    def extract(self, rgb: np.ndarray) -> np.ndarray:
        """Cut the square out of an image (H, W, 3); border pixels are repeated beyond its edge."""
        centre = (self.x0 + (self.size - 1) / 2, self.y0 + (self.size - 1) / 2)
        window = cv2.getRectSubPix(np.ascontiguousarray(rgb), (self.size, self.size), centre)
        return cv2.resize(window, (self.cell, self.cell), interpolation=cv2.INTER_AREA)

    def outline(
        self, cell: np.ndarray, mask: np.ndarray, x: int, y: int, colour: tuple[int, int, int]
    ) -> None:
        """Draw the contour of a mask (h, w) into the ``cell`` that :meth:`extract` returned.

        The mask's upper left corner is at image pixel (x, y).
        """
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

    def to_cell(self, pixels: np.ndarray) -> np.ndarray:
        """Convert image pixels (N, 2) to whole pixels of the cell."""
        scaled = (pixels - [self.x0, self.y0] + 0.5) * (self.cell / self.size) - 0.5
        return np.rint(np.clip(scaled, -1e4, 1e4)).astype(int)


CellDrawer = Callable[[Camera, int, int, np.ndarray], np.ndarray | None]


def make_sheet(
    name: str, images: Frames, rig: Rig, frames: Sequence[int], cell_px: int, draw_cell: CellDrawer
) -> EncodedImage:
    """Draw a table of small pictures: a row per frame, a column per camera.

    Args:
        name: name of the sequence.
        images: images by the frame that they show (:meth:`Frames.showing`).
        cell_px: side of a cell.
        draw_cell: called with camera, frame, index of the camera and RGB image; returns the cell,
            or None if nothing is in view.
    """
    step, head = cell_px + 4, 18
    bright, dim = (235, 235, 235), (120, 128, 138)  # RGB
    sheet = np.empty((len(frames) * step + head, len(rig) * step, 3), np.uint8)
    sheet[:] = (19, 22, 27)
    for c, camera in enumerate(rig):
        put_text(sheet, camera.name[:16], (c * step + 4, 13), 0.42, bright)
        for row, t in enumerate(frames):
            image = images.colour(t, c)
            cell = None if image is None else draw_cell(camera, t, c, image[..., ::-1])
            y, x = head + row * step, c * step
            if cell is not None:
                sheet[y : y + cell_px, x : x + cell_px] = cell
            if c == 0 or cell is None:
                label = f"frame {t}" if c == 0 else "no image" if image is None else "not in view"
                ink = bright if cell is not None else dim
                put_text(sheet, label, (x + 4, y + 13), 0.4, (0, 0, 0), 3)
                put_text(sheet, label, (x + 4, y + 13), 0.4, ink)
    caption = f"{name}, frames {', '.join(map(str, frames))} in every camera"
    return encode_jpeg(sheet / np.float32(255), caption)


def put_text(
    picture: np.ndarray,
    text: str,
    corner: tuple[int, int],
    size: float,
    colour: tuple[int, int, int],
    thickness: int = 1,
) -> None:
    """Draw a line of text with its lower left corner at a pixel; ``size`` in OpenCV's units."""
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(picture, text, corner, font, size, colour, thickness, cv2.LINE_AA)
