"""Calibration boards: corners in warped drawings, and descriptions that fit no form."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from intercap_core.errors import UserError
from intercap_core.formats.calibration.boards import FORMS, parse_board

EXAMPLES = ("charuco:6x4:0.15:0.115:4X4_50", "checkerboard:8x5:0.04",
            "aprilgrid:4x3:0.08:0.02:APRILTAG_36h11")  # fmt: skip
CANVAS = np.array([900, 700])


def warp(text: str, turn_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """A drawing seen obliquely: image (H, W), and pixels (N, 2) of all corners."""
    board = parse_board(text)
    low, high = board.extent
    width = 1200
    size = (width, round(width * (high - low)[1] / (high - low)[0]))
    drawing = cv2.copyMakeBorder(board.draw(size), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    place = (board.corners[:, :2] - low) / (high - low) * size + 60 - 0.5
    outline = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (drawing.shape[1], drawing.shape[0])
    seen = np.array([[-0.36, -0.25], [0.34, -0.3], [0.31, 0.28], [-0.33, 0.24]])
    angle = np.radians(turn_deg)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    target = (seen @ rotation.T) * CANVAS.max() * 0.9 + CANVAS / 2
    homography = cv2.getPerspectiveTransform(outline.astype(np.float32), target.astype(np.float32))
    image = cv2.warpPerspective(drawing, homography, CANVAS.tolist(), borderValue=120,
                                flags=cv2.INTER_AREA)  # fmt: skip
    pixels = cv2.perspectiveTransform(place[None].astype(np.float64), homography)[0]
    return cv2.GaussianBlur(image, (0, 0), 0.7), pixels


@pytest.mark.parametrize("turn_deg", [0, 40, 180])
@pytest.mark.parametrize("text", EXAMPLES)
def test_corners_are_found_with_their_own_index(text: str, turn_deg: float) -> None:
    image, truth = warp(text, turn_deg)
    found = parse_board(text).locate(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    seen = np.isfinite(found[:, 0])
    assert seen.mean() > 0.8
    assert np.linalg.norm(found - truth, axis=1)[seen].max() < 1.0


@pytest.mark.parametrize("text", EXAMPLES)
def test_a_corner_of_the_board_alone_is_not_used(text: str) -> None:
    image, _ = warp(text, 0)
    image[:, 260:] = 120
    found = parse_board(text).locate(image)
    assert np.isnan(found).all() or np.isfinite(found[:, 0]).sum() >= 6


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("chessboard:9x6:0.04", "; ".join(FORMS.values())),
        ("charuco", FORMS["charuco"]),
        ("charuco:6x4:0.15:0.115", FORMS["charuco"]),
        ("charuco:6:0.15:0.115:4X4_50", FORMS["charuco"]),
        ("charuco:6x4:0.115:0.15:4X4_50", "smaller than the square"),
        ("charuco:6x4:0.15:0.115:4X4_51", "4X4_50"),
        ("charuco:60x40:0.15:0.115:4X4_50", "1200 markers"),
        ("charuco:6x4:150:115:4X4_50", "metres"),
        ("charuco:6x4:nan:0.1:4X4_50", "metres"),
        ("checkerboard:9x6", FORMS["checkerboard"]),
        ("checkerboard:1x6:0.04", FORMS["checkerboard"]),
        ("checkerboard:8x6:0.04", "odd and an even"),
        ("checkerboard:9x6:-0.04", "metres"),
        ("checkerboard:9x2:0.04", FORMS["checkerboard"]),
        ("aprilgrid:6x6:0.05:0.015:GRID", "APRILTAG_36h11"),
        ("aprilgrid:60x60:0.05:0.015:APRILTAG_36h11", "3600 markers"),
        ("aprilgrid:6x6:x:0.015:APRILTAG_36h11", FORMS["aprilgrid"]),
    ],
)
def test_a_wrong_description_names_the_expected_form(text: str, expected: str) -> None:
    with pytest.raises(UserError) as raised:
        parse_board(text)
    assert text in str(raised.value)
    assert expected in str(raised.value)


def test_a_mirrored_print_on_the_back_has_the_same_corners() -> None:
    image, truth = warp(EXAMPLES[0], 0)
    for photo in (image, 255 - image):  # also printed white on black
        found = parse_board(EXAMPLES[0]).locate(np.ascontiguousarray(photo[:, ::-1]))
        seen = np.isfinite(found[:, 0])
        assert seen.mean() > 0.8
        back = found * (-1, 1) + (image.shape[1] - 1, 0)
        assert np.linalg.norm(back - truth, axis=1)[seen].max() < 1.5
