"""Parts that the sections on body and object track share: sheets of crops, and states of views."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.output.site import charts
from intercap_core.output.site.drawing import EncodedImage, encode_jpeg, put_text
from intercap_core.schemas import SCENE
from intercap_core.sequence_inputs import SequencePaths

CellDrawer = Callable[[Camera, int, int, np.ndarray], np.ndarray | None]


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


def draw_sheet(
    paths: SequencePaths, frames: Sequence[int], cell_px: int, draw_cell: CellDrawer
) -> tuple[EncodedImage | None, str]:
    """Draw a table of small pictures: a row per frame, a column per camera.

    Returns None and the reason if an image or a mask is unreadable, which must not prevent the
    page.

    Args:
        cell_px: side of a cell.
        draw_cell: called with camera, frame, index of the camera and RGB image; returns the cell,
            or None if nothing is in view.
    """
    step, head = cell_px + 4, 18
    bright, dim = (235, 235, 235), (120, 128, 138)  # RGB
    try:
        with artefacts.read(paths.scene, SCENE) as scene, Frames.open(paths.frames) as recorded:
            rig, images = Rig.from_artefact(scene), recorded.showing(scene["image_of"])
            sheet = np.empty((len(frames) * step + head, len(rig) * step, 3), np.uint8)
            sheet[:] = (19, 22, 27)
            for c, camera in enumerate(rig):
                put_text(sheet, camera.name[:16], (c * step + 4, 13), 0.42, bright)
                for row, t in enumerate(frames):
                    image = images.colour(t, c)
                    cell = None if image is None else draw_cell(camera, t, c, image[..., ::-1])
                    y, x = head + row * step, c * step
                    label = f"frame {t}" if c == 0 else ""
                    if cell is not None:
                        sheet[y : y + cell_px, x : x + cell_px] = cell
                    elif c > 0:
                        label = "no image" if image is None else "not in view"
                    put_text(sheet, label, (x + 4, y + 13), 0.4, (0, 0, 0), 3)
                    ink = dim if cell is None else bright
                    put_text(sheet, label, (x + 4, y + 13), 0.4, ink)
            name = images.sequence
    except (UserError, ValueError) as error:  # ValueError: a mask that does not decode
        return None, str(error)
    caption = f"{name}, frames {', '.join(map(str, frames))} in every camera"
    return encode_jpeg(sheet / np.float32(255), caption), ""


def view_row(
    name: str, used: np.ndarray, good: np.ndarray, words: Mapping[str, str], label: str
) -> charts.TimelineRow:
    """Return the row of one view in a timeline.

    Args:
        used: (T,) bool, the fit uses this view.
        good: (T,) bool, the view agrees with the fit.
        words: those of the states "agrees", "partly" and "nothing".
    """
    states = np.where(used, np.where(good, "agrees", "partly"), "nothing").tolist()
    return charts.TimelineRow(name, charts.state_runs(states, words), label)
