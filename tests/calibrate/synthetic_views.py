"""Views of a walking stick person by a ring of cameras with distorted lenses, without images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from intercap_core.calibrate.evidence import CORNERS, NUM_JOINTS, Views
from intercap_core.formats.calibration.boards import Board
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert, rigid, rotation_exp
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import seen_by, walker

FPS = 15


def views_of_walker(
    cameras: int = 4, sets: int = 60, *, noise_px: float = 0.0, depth: bool = False, seed: int = 0
) -> tuple[Rig, np.ndarray, Views]:
    """A ring of ``cameras``, the joints (T, 25, 3) in the master's frame, and their views.

    ``depth``: distances are measured, with an error of 1 cm per millimetre of ``noise_px`` pixels.
    """
    rig, zup_from_master = ring(cameras)
    times = np.arange(sets) / FPS
    people = walker(times)
    joints = apply(invert(zup_from_master), people[:, :NUM_JOINTS].reshape(-1, 3))
    joints = joints.reshape(sets, NUM_JOINTS, 3)
    seen = seen_by(people, rig, zup_from_master)[:, :, :NUM_JOINTS]
    rng = np.random.default_rng(seed)
    pixels = seen[..., :2] + noise_px * rng.standard_normal(seen[..., :2].shape)
    distance = np.full(pixels.shape[:3], np.nan)
    if depth:
        eyes = rig.master_from_colour[:, None, :3, 3]
        distance = np.linalg.norm(joints[:, None] - eyes, axis=-1)
        distance += 0.005 * noise_px * rng.standard_normal(distance.shape)
    nothing = np.zeros(sets, int)
    return (
        rig,
        joints,
        Views(times, nothing, pixels, seen[..., 2], distance, np.zeros((1, len(rig)), int)),
    )


def with_board(
    views: Views, rig: Rig, board: Board, poses: np.ndarray, noise_px: float = 0.0
) -> Views:
    """The views with a board at poses (T, 4, 4) master_from_board; NaN = no board."""
    sets, views_, count = len(views.times), len(rig), len(board.corners)
    pixels = np.full((sets, views_, count, 2), np.nan)
    rng = np.random.default_rng(1)
    for t in np.flatnonzero(np.isfinite(poses[:, 0, 0])):
        points = apply(poses[t], board.corners)
        for c, camera in enumerate(rig):
            in_camera = apply(camera.colour_from_master, points)
            seen = camera.colour.project(in_camera)
            inside = (seen > 0) & (seen < (camera.colour.width - 1, camera.colour.height - 1))
            if (in_camera[:, 2] > 0.3).all() and inside.all():
                pixels[t, c] = seen + noise_px * rng.standard_normal(seen.shape)
    known = np.isfinite(pixels[..., 0])
    nothing = np.full(known.shape, np.nan)
    return replace(
        views,
        pixels=np.concatenate([views.pixels[:, :, :NUM_JOINTS], pixels], 2),
        confidence=np.concatenate([views.confidence[:, :, :NUM_JOINTS], 1.0 * known], 2),
        distance=np.concatenate([views.distance[:, :, :NUM_JOINTS], nothing], 2),
    )


def board_poses_around(centre: np.ndarray, sets: int, seed: int = 2) -> np.ndarray:
    """Random poses (T, 4, 4) of a board near ``centre`` (3,), metres."""
    rng = np.random.default_rng(seed)
    turns = rotation_exp(rng.uniform(-1, 1, (sets, 3)))
    places = centre + rng.uniform(-0.4, 0.4, (sets, 3))
    return np.stack([rigid(turn, place) for turn, place in zip(turns, places, strict=True)])


def without_people(views: Views) -> Views:
    """The same views without any joint."""
    pixels, confidence = views.pixels.copy(), views.confidence.copy()
    distance = views.distance.copy()
    joints = np.arange(views.pixels.shape[2]) < CORNERS.start
    pixels[:, :, joints], confidence[:, :, joints], distance[:, :, joints] = np.nan, 0.0, np.nan
    return replace(views, pixels=pixels, confidence=confidence, distance=distance)
