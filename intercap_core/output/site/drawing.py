"""Encoded images, and anti-aliased renderings of meshes."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np
import trimesh
from PIL import Image

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply, rigid
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.geometry.rigid.shots import Drawable, Rendering
from intercap_core.geometry.rigid.surfaces import vertex_normals

Kind = Literal["jpeg", "png", "webp"]


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """A compressed image for a page."""

    content: bytes
    kind: Kind
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

    @property
    def rgba(self) -> np.ndarray:
        """(H, W, 4) in 0..1, not premultiplied."""
        alpha = self.alpha[..., None]
        return np.concatenate([self.rgb / np.maximum(alpha, 1e-6), alpha], 2)


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


def look_at(
    target: np.ndarray, direction: np.ndarray, up: np.ndarray, distance: float
) -> np.ndarray:
    """Return the transform (4, 4) to the frame of a camera that sees ``target`` in its middle.

    The camera is ``distance`` metres away and looks along a unit ``direction``.
    """
    turn = look_along(direction, up)
    return rigid(turn, turn @ (distance * direction - target))


def pinhole(width: int, height: int, focal: float) -> Intrinsics:
    """Return a lens without distortion, whose axis is in the middle of the image."""
    return Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def encode_jpeg(rgb: np.ndarray, caption: str = "") -> EncodedImage:
    """Encode an image (H, W, 3) in 0..1 as JPEG."""
    return _encode([rgb], "jpeg", caption, quality=82, optimize=True)


def encode_png(pixels: np.ndarray, caption: str = "") -> EncodedImage:
    """Encode an image (H, W, 3), or (H, W, 4) with transparency, in 0..1 as PNG."""
    return _encode([pixels], "png", caption, compress_level=9)


def encode_animation(pictures: Sequence[np.ndarray], seconds: float, caption: str) -> EncodedImage:
    """Encode images (H, W, 3) in 0..1 as an endless animated WebP of ``seconds`` per round."""
    duration = max(1, round(1e3 * seconds / len(pictures)))
    return _encode(
        pictures, "webp", caption, save_all=True, loop=0, quality=60, method=4, duration=duration
    )


def _encode(
    pictures: Sequence[np.ndarray], kind: Kind, caption: str, **options: Any
) -> EncodedImage:
    """Encode one image, or several as an animation, with Pillow's ``options``."""
    first, *others = (
        Image.fromarray(np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8))
        for picture in pictures
    )
    stream = io.BytesIO()
    first.save(stream, kind, append_images=others, **options)
    return EncodedImage(stream.getvalue(), kind, first.width, first.height, caption)


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
