"""Calibration boards: ChArUco boards, checkerboards and grids of AprilTags, found by OpenCV."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core.errors import UserError

# Corners of one image of a board that are used: a pose from fewer, or from corners of one row, is
# ambiguous.
MIN_CORNERS = 6
FORMS = {
    "charuco": "charuco:COLUMNSxROWS:SQUARE:MARKER:DICTIONARY",
    "checkerboard": "checkerboard:COLUMNSxROWS:SQUARE",
    "aprilgrid": "aprilgrid:COLUMNSxROWS:TAG:GAP:DICTIONARY",
}
_EXAMPLES = {
    "charuco": "charuco:8x6:0.06:0.045:4X4_50",
    "checkerboard": "checkerboard:9x6:0.04",
    "aprilgrid": "aprilgrid:6x6:0.05:0.015:APRILTAG_36h11",
}


@dataclass(frozen=True, eq=False)
class Board:
    """A flat board whose corners can be found in images."""

    corners: np.ndarray
    """(N, 3) corners in the board's frame, metres; z = 0."""
    find: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    """Finds corners in a grey image (H, W) uint8: their indices (n,) and pixels (n, 2)."""
    extent: np.ndarray
    """(2, 2) smallest and largest x and y of the drawing in the board's frame, metres."""
    draw: Callable[[tuple[int, int]], np.ndarray]
    """Draws the board in a size (width, height) in pixels, of the proportions of ``extent``."""

    def locate(self, image: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of all corners of a grey or BGR image; NaN = not found.

        If there are none, the mirrored image is searched: some boards have a mirrored print on
        their back, so that cameras on both sides see the same corners.
        """
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        result = np.full((len(self.corners), 2), np.nan)
        for mirrored in (False, True):
            index, pixels = self.find(np.ascontiguousarray(grey[:, ::-1]) if mirrored else grey)
            if len(index) < MIN_CORNERS or _on_a_line(self.corners[index]):
                continue
            if mirrored:
                pixels = pixels * (-1, 1) + (grey.shape[1] - 1, 0)
            result[index] = pixels
            break
        return result


def parse_board(text: str) -> Board:
    """Make the board of a description such as ``charuco:8x6:0.06:0.045:4X4_50``.

    Lengths are metres. COLUMNS and ROWS count squares (ChArUco), inner corners (checkerboard) or
    tags. Raises UserError for a description that fits none of :data:`FORMS`.
    """
    kind, *fields = text.split(":")
    form = FORMS.get(kind)
    if form is None:
        raise UserError(f"--board {text!r}: expected one of {'; '.join(FORMS.values())}")
    wrong = UserError(f"--board {text!r}: expected {form}, for example {_EXAMPLES[kind]}")
    if len(fields) != form.count(":"):
        raise wrong
    count = 1 if kind == "checkerboard" else 2
    try:
        columns, rows = (int(n) for n in fields[0].split("x"))
        lengths = [float(field) for field in fields[1 : 1 + count]]
    except ValueError:
        raise wrong from None
    if min(columns, rows) < (3 if kind == "checkerboard" else 2):  # OpenCV finds no smaller one
        raise wrong
    too_large = 2.0  # metres; a length of a square beyond it is in millimetres or centimetres
    if not all(0 < length < too_large for length in lengths):
        raise UserError(f"--board {text!r}: lengths are metres, expected less than {too_large:g}")
    if kind == "checkerboard":
        return _checkerboard(columns, rows, lengths[0], text)
    dictionary = _dictionary(fields[-1], text)
    markers = columns * rows // (2 if kind == "charuco" else 1)
    if markers > (known := len(dictionary.bytesList)):
        raise UserError(
            f"--board {text!r}: the board has {markers} markers, but dictionary {fields[-1]} only "
            f"{known}; correct the columns and rows, or the dictionary"
        )
    if kind == "charuco":
        return _charuco(columns, rows, lengths, dictionary, text)
    return _april_grid(columns, rows, lengths, dictionary)


def _dictionary(name: str, text: str) -> cv2.aruco.Dictionary:
    number = getattr(cv2.aruco, f"DICT_{name.removeprefix('DICT_')}", None)
    if number is None:
        known = sorted(n.removeprefix("DICT_") for n in dir(cv2.aruco) if n.startswith("DICT_"))
        raise UserError(f"--board {text!r}: {name!r} is none of OpenCV's {', '.join(known)}")
    return cv2.aruco.getPredefinedDictionary(number)


def _checkerboard(columns: int, rows: int, square: float, text: str) -> Board:
    if (columns + rows) % 2 == 0:
        raise UserError(
            f"--board {text!r}: {columns} by {rows} inner corners look the same after half a turn; "
            "use a board with an odd and an even number, or a ChArUco board"
        )
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)

    def find(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found, pixels = cv2.findChessboardCornersSB(grey, (columns, rows))
        if not found:
            return np.zeros(0, int), np.zeros((0, 2))
        return np.arange(columns * rows), pixels.reshape(-1, 2)

    def draw(size: tuple[int, int]) -> np.ndarray:
        u, v = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
        # OpenCV counts corners from the one whose outer square is white
        dark = (u * (columns + 1) // size[0] + v * (rows + 1) // size[1]) % 2 == 1
        return np.where(dark, 0, 255).astype(np.uint8)

    extent = square * np.array([[-1, -1], [columns, rows]])
    return Board(np.c_[square * grid, np.zeros(len(grid))], find, extent, draw)


def _charuco(
    columns: int, rows: int, lengths: list[float], dictionary: cv2.aruco.Dictionary, text: str
) -> Board:
    if lengths[1] >= lengths[0]:
        raise UserError(f"--board {text!r}: the marker must be smaller than the square")
    board = cv2.aruco.CharucoBoard((columns, rows), lengths[0], lengths[1], dictionary)
    parameters = cv2.aruco.DetectorParameters()
    parameters.detectInvertedMarker = True  # some boards are printed white on black
    detector = cv2.aruco.CharucoDetector(board, detectorParams=parameters)

    def find(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pixels, index, _, _ = detector.detectBoard(grey)
        if index is None or not len(index):
            return np.zeros(0, int), np.zeros((0, 2))
        return index.ravel(), pixels.reshape(-1, 2)

    corners = np.asarray(board.getChessboardCorners(), float)
    extent = lengths[0] * np.array([[0, 0], [columns, rows]])
    return Board(corners, find, extent, board.generateImage)


def _april_grid(
    columns: int, rows: int, lengths: list[float], dictionary: cv2.aruco.Dictionary
) -> Board:
    board = cv2.aruco.GridBoard((columns, rows), lengths[0], lengths[1], dictionary)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def find(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pixels, tags, _ = detector.detectMarkers(grey)
        names = [] if tags is None else tags.ravel().tolist()
        kept = [pair for pair in zip(names, pixels, strict=False) if pair[0] < columns * rows]
        if not kept:
            return np.zeros(0, int), np.zeros((0, 2))
        index = np.concatenate([4 * tag + np.arange(4) for tag, _ in kept])
        return index, np.concatenate([quad.reshape(4, 2) for _, quad in kept])

    corners = np.concatenate([np.asarray(tag, float).reshape(4, 3) for tag in board.getObjPoints()])
    extent = np.stack([corners.min(0), corners.max(0)])[:, :2]
    return Board(corners, find, extent, board.generateImage)


def _on_a_line(points: np.ndarray) -> bool:
    """Whether points (n, 3) lie on a line, to a tenth of their extent."""
    size = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(size[1] < 0.1 * size[0])
