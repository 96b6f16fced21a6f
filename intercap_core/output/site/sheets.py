"""A sheet of small pictures: moments in rows, cameras in columns; callers draw the cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.output.site.overlays import encode_jpeg

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


Draw = Callable[[Camera, int, int, np.ndarray], np.ndarray | None]


def make_sheet(images: Frames, rig: Rig, frames: Sequence[int], cell_px: int, draw: Draw) -> Sheet:
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
