"""A sheet of all objects from two sides, contact vertices tinted."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import open3d as o3d

from object_shapes.parts import Built

TILE, SUPERSAMPLE = 260, 2
CONTACT_TINT = np.array([255, 0, 220])


def draw_sheet(objects: dict[str, Built], path: Path) -> None:
    """Two rows for each half of the objects: seen from the front right and the back left."""
    names = list(objects)
    rows = []
    for half in (names[:5], names[5:]):
        for azimuth, highlight in ((35, False), (215, True)):
            tiles = [_tile(objects[name], azimuth, highlight, name) for name in half]
            rows.append(np.hstack(tiles))
    image = np.vstack(rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


def _tile(built: Built, azimuth_deg: float, highlight: bool, name: str) -> np.ndarray:
    side = TILE * SUPERSAMPLE
    radius = np.linalg.norm(built.vertices, axis=1).max()
    a, e = np.radians(azimuth_deg), np.radians(25)
    back = np.array([np.cos(a) * np.cos(e), -np.sin(a) * np.cos(e), np.sin(e)])
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    across, along = built.vertices @ right, built.vertices @ up
    span = 1.12 * max(np.ptp(across), np.ptp(along))
    middle = right * (across.max() + across.min()) / 2 + up * (along.max() + along.min()) / 2
    grid = (np.arange(side) + 0.5) / side - 0.5
    origin = (
        middle + 3 * radius * back + span * (grid[None, :, None] * right - grid[:, None, None] * up)
    )
    rays = np.concatenate([origin, np.broadcast_to(-back, origin.shape)], -1).astype(np.float32)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(built.vertices.astype(np.float32), built.faces.astype(np.uint32))
    hit = scene.cast_rays(o3d.core.Tensor(rays))
    face = hit["primitive_ids"].numpy()
    seen = np.isfinite(hit["t_hit"].numpy())
    face = np.where(seen, face, 0)
    uv = hit["primitive_uvs"].numpy()
    weights = np.stack([1 - uv.sum(-1), uv[..., 0], uv[..., 1]], -1)
    colours = built.colours.astype(float)
    if highlight:
        touched = np.zeros(len(colours), bool)
        touched[built.contact_vertices] = True
        colours[touched] = 0.35 * colours[touched] + 0.65 * CONTACT_TINT
    colour = (weights[..., None] * colours[built.faces[face]]).sum(-2)
    light = back + 0.5 * up - 0.3 * right
    shade = 0.45 + 0.55 * np.clip(
        hit["primitive_normals"].numpy() @ light / np.linalg.norm(light), 0, 1
    )
    image = np.where(seen[..., None], colour * shade[..., None], 245)
    image = image.reshape(TILE, SUPERSAMPLE, TILE, SUPERSAMPLE, 3).mean((1, 3)).clip(0, 255)
    tile = np.ascontiguousarray(image.astype(np.uint8))
    if not highlight:
        cv2.putText(
            tile, name, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (60, 60, 60), 1, cv2.LINE_AA
        )
    return tile
