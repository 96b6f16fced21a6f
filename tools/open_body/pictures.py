"""Small shaded pictures of meshes by ray casting: no window, no graphics driver."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def shade(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    centre: np.ndarray,
    width_m: float,
    size: tuple[int, int],
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    colours: np.ndarray | None = None,
    points: np.ndarray | None = None,
) -> np.ndarray:
    """Orthographic view -> (H,W,3) uint8.

    vertices (V,3), y up, seen from +z turned by yaw about y (positive shows the person's left side)
    and pitch (positive from above). colours (V,3) in [0,1]; points (N,3) drawn as red dots over
    the picture, hidden or not. size is (width, height) in pixels.
    """
    import open3d as o3d

    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    r_yaw = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    r_pitch = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)],
                        [0, np.sin(pitch), np.cos(pitch)]])  # fmt: skip
    view = r_pitch @ r_yaw
    local = ((vertices - centre) @ view.T).astype(np.float32)
    width, height = size
    step = width_m / width
    xs = (np.arange(width) + 0.5 - width / 2) * step
    ys = (height / 2 - np.arange(height) - 0.5) * step
    rays = np.zeros((height, width, 6), np.float32)
    rays[..., 0], rays[..., 1], rays[..., 2], rays[..., 5] = xs, ys[:, None], 5, -1
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(local, faces.astype(np.uint32))
    hit = scene.cast_rays(rays)
    seen = np.isfinite(hit["t_hit"].numpy())
    face = np.where(seen, hit["primitive_ids"].numpy().astype(np.int64), 0)
    normals = np.zeros_like(local)
    cross = np.cross(local[faces[:, 1]] - local[faces[:, 0]],
                     local[faces[:, 2]] - local[faces[:, 0]])  # fmt: skip
    for i in range(3):
        np.add.at(normals, faces[:, i], cross)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    uv = hit["primitive_uvs"].numpy()
    bary = np.concatenate([1 - uv.sum(-1, keepdims=True), uv], -1)
    normal = np.einsum("hwk,hwkc->hwc", bary, normals[faces[face]])
    light = np.array([-0.35, 0.45, 0.82])
    level = 0.3 + 0.7 * np.clip(normal @ light, 0, 1)
    base = np.full((*face.shape, 3), 0.82) if colours is None else np.einsum(
        "hwk,hwkc->hwc", bary, colours[faces[face]])  # fmt: skip
    image = np.where(seen[..., None], base * level[..., None], 1.0)
    if points is not None:
        at = (points - centre) @ view.T
        px = np.round(at[:, 0] / step + width / 2 - 0.5).astype(int)
        py = np.round(height / 2 - 0.5 - at[:, 1] / step).astype(int)
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                ok = (px + dx >= 0) & (px + dx < width) & (py + dy >= 0) & (py + dy < height)
                image[py[ok] + dy, px[ok] + dx] = (0.85, 0.05, 0.05)
    return (image * 255).round().astype(np.uint8)


def save(path: Path, tiles: list[np.ndarray]) -> None:
    """Tiles side by side, as a PNG of 64 colours (small enough for a repository)."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.fromarray(np.concatenate(tiles, 1))
    picture.quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)
