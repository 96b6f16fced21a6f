"""Lenses of cameras from the images of a board, by OpenCV's ``calibrateCamera``."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from intercap_core.calibrate.evidence import CORNERS, Views
from intercap_core.formats.calibration.boards import Board
from intercap_core.geometry.camera.intrinsics import Intrinsics

MIN_VIEWS = 12  # of the board: OpenCV's guide advises ten at least; half of them are held out
MIN_COVERED = 0.5  # share of a 4 x 3 grid of the image that holds corners
SHARED = 3.0  # factor on OpenCV's deviations: corners of an image err together
MIN_GAIN = 0.1  # by which held-out errors must fall before a stated lens is replaced


def describe_coverage(views: Views, camera: int, size: tuple[int, int]) -> str:
    """What the board's images lack for an estimate of the lens; "" = they suffice."""
    pixels = views.pixels[:, camera, CORNERS]
    seen = np.isfinite(pixels[..., 0])
    count = int(seen.any(1).sum())
    if count < MIN_VIEWS:
        return f"the board is seen in {count} of its images, expected at least {MIN_VIEWS}"
    cells = (pixels[seen] * (4, 3) / size).astype(int).clip(0, (3, 2))
    covered = len(np.unique(cells, axis=0)) / 12
    if covered < MIN_COVERED:
        return (
            f"the board was seen in {100 * covered:.0f} % of its image's area, expected at least "
            f"{100 * MIN_COVERED:.0f} %: hold it near the corners of the image, too"
        )
    return ""


@dataclass(frozen=True, eq=False)
class LensEstimate:
    """A lens and its accuracy."""

    lens: Intrinsics
    focal_sigma: float = 0.0
    """Standard deviation of the focal length over the focal length; 0 = stated lens."""
    centre_sigma: float = 0.0
    """Standard deviation of the principal point over the focal length, rad."""
    note: str = ""
    """What was done; "" = kept for lack of images."""


def estimate_lens(
    views: Views, camera: int, board: Board, start: Intrinsics, *, stated: bool
) -> LensEstimate:
    """Estimate a lens with five or eight coefficients of distortion, by held-out images.

    Args:
        start: the lens as stated, or a guess.
        stated: keep ``start`` unless held-out images contradict it.
    """
    size = (start.width, start.height)
    if describe_coverage(views, camera, size):
        return LensEstimate(start)
    pixels = views.pixels[:, camera, CORNERS]
    images = [
        (board.corners[known].astype(np.float32), image[known].astype(np.float32))
        for image in pixels
        if (known := np.isfinite(image[:, 0])).any()
    ]
    models = (0, cv2.CALIB_RATIONAL_MODEL)
    errors = [_error(images[1::2], _calibrated(images[::2], start, model).lens) for model in models]
    after = min(errors)
    if stated and after > (1 - MIN_GAIN) * (before := _error(images[1::2], start)):
        return LensEstimate(start, note=f"its stated lens fits the board to {before:.2f} px, kept")
    found = _calibrated(images, start, models[int(np.argmin(errors))])
    words = f"its lens is estimated from {len(images)} images of the board"
    if stated:
        words = f"its lens is refined: held-out corners {before:.2f} to {after:.2f} px"
    return replace(found, note=words)


def _calibrated(
    images: list[tuple[np.ndarray, np.ndarray]], start: Intrinsics, model: int
) -> LensEstimate:
    points, pixels = zip(*images, strict=True)
    _, matrix, coefficients, _, _, sigma, _, _ = cv2.calibrateCameraExtended(
        points, pixels, (start.width, start.height), start.matrix, np.zeros(8),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS | model,
    )  # fmt: skip
    distortion = np.zeros(8)
    distortion[: min(8, coefficients.size)] = coefficients.ravel()[:8]
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    lens = Intrinsics(start.width, start.height, fx, fy, cx, cy, distortion, start.metric_radius)
    off = SHARED * sigma.ravel()[:4] / fx
    return LensEstimate(lens, float(off[:2].max()), float(off[2:].max()))


def _error(images: list[tuple[np.ndarray, np.ndarray]], lens: Intrinsics) -> float:
    """Median reprojection error, px, at the best pose of each image."""
    errors = []
    for points, pixels in images:
        seen = np.ascontiguousarray(lens.unproject(pixels.astype(float))[:, :2]), np.eye(3), None
        place = points.astype(float)
        found, turn, shift = cv2.solvePnP(place, *seen, flags=cv2.SOLVEPNP_IPPE)
        if found:
            turn, shift = cv2.solvePnPRefineLM(place, *seen, turn, shift)
            moved = points @ cv2.Rodrigues(turn)[0].T + shift.ravel()
            errors.append(np.linalg.norm(lens.project(moved) - pixels, axis=1))
    return float(np.median(np.concatenate(errors))) if errors else np.inf
