"""Virtual recording of a calibration board: images of plain cameras whose true rig is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from intercap_core.formats.calibration.boards import Board
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.geometry.camera.transforms import apply, invert, rigid, rotation_exp

_TEXTURE_PX = 1600  # width of the printed board's image
_SIDE = 3  # samples of a pixel along each axis
_NOISE, _BLUR_PX, _QUALITY = 2.0, 0.55, 85  # as of the studio's cameras


def write_board_recording(
    folder: Path, rig: Rig, board: Board, *, sets: int, seed: int, fps: int = 15
) -> None:
    """Write ``<camera>/<number>.jpg`` and ``timestamps.csv`` for each camera.

    In two of three sets, the board is within half a metre of the rig's centre and faces a place
    between two neighbouring cameras, tilted by up to 30 degrees. In the third it is held before one
    camera, anywhere in its image.

    Args:
        rig: the true cameras.
        fps: sets a second by the timestamps; the board is held still for each image.
    """
    rng = np.random.default_rng(seed)
    poses = [_pose(rig, board, rng, k) for k in range(sets)]
    extent = np.ptp(board.extent, axis=0)
    size = (_TEXTURE_PX, round(_TEXTURE_PX * extent[1] / extent[0]))
    texture = cv2.copyMakeBorder(board.draw(size), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    for camera in rig:
        own = folder / camera.name
        own.mkdir(parents=True, exist_ok=True)
        times = []
        for k, pose in enumerate(poses):
            image = _photograph(camera.colour, camera.colour_from_master @ pose, board, texture)
            image = cv2.GaussianBlur(image, (0, 0), _BLUR_PX)
            image += rng.normal(0, _NOISE, image.shape).astype(np.float32)
            grey = np.clip(image, 0, 255).astype(np.uint8)
            name = f"{k:06d}.jpg"
            cv2.imwrite(str(own / name), grey, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            times.append(f"{k:06d}, {k / fps:.6f}\n")
        (own / "timestamps.csv").write_text("".join(times))


def _pose(rig: Rig, board: Board, rng: np.random.Generator, k: int) -> np.ndarray:
    """Pose (4, 4) master_from_board of one set."""
    eyes = rig.master_from_colour[:, :3, 3]
    first, second = eyes[k % len(rig)], eyes[(k + 1) % len(rig)]
    centre = ring_centre(rig) + rng.uniform(-0.5, 0.5, 3) * (1, 0.6, 1)
    viewer = (first + second) / 2
    if k % 3 == 2:
        camera = rig[k // 3 % len(rig)]
        lens, viewer = camera.colour, camera.master_from_colour[:3, 3]
        pixel = rng.uniform(0.1, 0.9, 2) * (lens.width, lens.height)
        ray = camera.master_from_colour[:3, :3] @ lens.unproject(pixel)
        centre = viewer + rng.uniform(1.0, 1.5) * ray
    ahead = centre - viewer  # the board's z axis points away from its viewers
    ahead /= np.linalg.norm(ahead)
    down = rig.master_from_colour[:, :3, 1].mean(0)
    right = np.cross(down, ahead)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead], -1)
    rotation = rotation @ rotation_exp(rng.uniform(-1, 1, 3) * np.radians(30))
    middle = np.r_[board.extent.mean(0), 0]
    return rigid(rotation, centre - rotation @ middle)


def _photograph(
    lens: Intrinsics, colour_from_board: np.ndarray, board: Board, texture: np.ndarray
) -> np.ndarray:
    """Image (H, W) float32 of the board before a grey wall."""
    image = np.full((lens.height, lens.width), 110, np.float32)
    image += np.linspace(-20, 20, lens.width, dtype=np.float32)  # light from one side
    low, high = board.extent
    margin = 60 / _TEXTURE_PX * (high[0] - low[0])
    low, high = low - margin, high + margin
    outline = np.array([[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0],
                        [low[0], high[1], 0]])  # fmt: skip
    corners = apply(colour_from_board, outline)
    if (corners[:, 2] < 0.2).any():
        return image
    seen = lens.project(corners)
    u0, v0 = np.maximum(np.floor(seen.min(0)).astype(int), 0)
    u1, v1 = np.minimum(np.ceil(seen.max(0)).astype(int) + 1, (lens.width, lens.height))
    if u0 >= u1 or v0 >= v1:
        return image
    offsets = (np.arange(_SIDE) + 0.5) / _SIDE - 0.5
    u = (np.arange(u0, u1)[:, None] + offsets).ravel()
    v = (np.arange(v0, v1)[:, None] + offsets).ravel()
    rays = lens.unproject(np.stack(np.meshgrid(u, v), -1))
    to_board = invert(colour_from_board)
    eye, directions = to_board[:3, 3], rays @ to_board[:3, :3].T
    away = -eye[2] / directions[..., 2]
    place = eye[:2] + away[..., None] * directions[..., :2]
    at = (place - low) / (high - low) * (texture.shape[1], texture.shape[0]) - 0.5
    across, along = np.moveaxis(at.astype(np.float32), -1, 0)
    drawn = cv2.remap(texture, across, along, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    drawn = np.full_like(drawn, 90) if eye[2] > 0 else drawn  # its back is plain
    inside = ((place > low) & (place < high)).all(-1) & (away > 0)
    window = image[v0:v1, u0:u1]
    samples = np.where(inside, drawn, np.repeat(np.repeat(window, _SIDE, 0), _SIDE, 1))
    shape = (v1 - v0, _SIDE, u1 - u0, _SIDE)
    window[...] = samples.astype(np.float32).reshape(shape).mean((1, 3))
    return image
