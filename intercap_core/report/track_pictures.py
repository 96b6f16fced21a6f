"""A sheet of small pictures: the object as each camera saw it, and as the track has it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core.camera.rig import Camera, Rig
from intercap_core.capture.frames import Frames
from intercap_core.detection.masks import Runs
from intercap_core.report.overlays import encode_jpeg
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.rigid.render import render

TRACK_COLOUR, CANDIDATE_COLOUR = (255, 158, 46), (64, 224, 255)  # RGB
_CELL_PX, _GAP_PX, _HEAD_PX = 148, 4, 18
_REACH = 1.35  # of the object's diameter: what a cell shows
_GROUND = (19, 22, 27)
_INK, _DIM = (235, 235, 235), (120, 128, 138)
_FONT = cv2.FONT_HERSHEY_SIMPLEX


@dataclass(frozen=True, eq=False)
class TrackSheet:
    """``jpeg`` bytes: a row for each of ``frames``, a column for each camera."""

    jpeg: bytes
    width: int
    height: int
    frames: Sequence[int]


def track_sheet(
    images: Frames,
    rig: Rig,
    mesh: ObjectMesh,
    poses: np.ndarray,
    kept: Callable[[int, int], bytes],
    frames: Sequence[int],
) -> TrackSheet:
    """Draw the track's outline and that of the kept candidate over crops of the images.

    ``poses`` (T, 4, 4) master_from_object; ``kept(t, c)`` the RLE of the candidate that the track
    kept in camera c, empty = none. ``images`` show each frame's moment.
    """
    step = _CELL_PX + _GAP_PX
    sheet = np.empty((len(frames) * step + _HEAD_PX, len(rig) * step, 3), np.uint8)
    sheet[:] = _GROUND
    for c, camera in enumerate(rig):
        cv2.putText(sheet, camera.name[:16], (c * step + 4, 13), _FONT, 0.42, _INK, 1, cv2.LINE_AA)
        for row, t in enumerate(frames):
            image = images.colour(t, c)
            cell = None
            if image is not None:
                cell = _cell(camera, image[..., ::-1], mesh, poses[t], kept(t, c))
            y, x = _HEAD_PX + row * step, c * step
            if cell is not None:
                sheet[y : y + _CELL_PX, x : x + _CELL_PX] = cell
            if c == 0 or cell is None:
                words = f"frame {t}" if c == 0 else "no image" if image is None else "not in view"
                ink = _INK if cell is not None else _DIM
                cv2.putText(sheet, words, (x + 4, y + 13), _FONT, 0.4, (0, 0, 0), 3, cv2.LINE_AA)
                cv2.putText(sheet, words, (x + 4, y + 13), _FONT, 0.4, ink, 1, cv2.LINE_AA)
    height, width = sheet.shape[:2]
    return TrackSheet(encode_jpeg(sheet / np.float32(255)), width, height, list(frames))


def _cell(
    camera: Camera, rgb: np.ndarray, mesh: ObjectMesh, pose: np.ndarray, rle: bytes
) -> np.ndarray | None:
    """The image around the object, enlarged to a cell, with both outlines; None: not in view."""
    lens = camera.colour
    in_camera = camera.colour_from_master @ pose
    centre = in_camera[:3, :3] @ mesh.centre_of_mass + in_camera[:3, 3]
    if centre[2] < 0.1 or not lens.sees(centre[None])[0]:
        return None
    x, y = lens.project(centre[None])[0]
    size = max(int(_REACH * mesh.diameter * lens.fx / centre[2]), 16)
    x0, y0 = int(x) - size // 2, int(y) - size // 2
    window = cv2.getRectSubPix(
        np.ascontiguousarray(rgb), (size, size), (x0 + (size - 1) / 2, y0 + (size - 1) / 2)
    )
    cell = cv2.resize(window, (_CELL_PX, _CELL_PX), interpolation=cv2.INTER_AREA)
    drawn = render(mesh.vertices, mesh.faces, lens, in_camera, cull_back=mesh.watertight)
    track = _placed(drawn.mask, drawn.x0 - x0, drawn.y0 - y0, size)
    _outline(cell, track, TRACK_COLOUR)
    if rle:
        runs = Runs(rle, lens.height, lens.width)
        left, top, width, height = runs.box
        mask = runs.decode()[top : top + height, left : left + width]
        _outline(cell, _placed(mask, left - x0, top - y0, size), CANDIDATE_COLOUR)
    return cell


def _placed(mask: np.ndarray, x: int, y: int, size: int) -> np.ndarray:
    """A mask whose corner is at (x, y) of a square of ``size``, scaled to a cell (uint8)."""
    square = np.zeros((size, size), np.uint8)
    height, width = mask.shape
    left, top, right, bottom = max(x, 0), max(y, 0), min(x + width, size), min(y + height, size)
    if right > left and bottom > top:
        square[top:bottom, left:right] = mask[top - y : bottom - y, left - x : right - x]
    return cv2.resize(square, (_CELL_PX, _CELL_PX), interpolation=cv2.INTER_NEAREST)


def _outline(cell: np.ndarray, mask: np.ndarray, colour: tuple[int, int, int]) -> None:
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(cell, contours, -1, colour, 1, cv2.LINE_AA)
