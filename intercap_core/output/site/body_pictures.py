"""A sheet of small pictures: the person as each camera saw it, and the body as it was fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core.body.keypoints import BODY, FEET, SKELETON, keypoint_pairs
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.render import render
from intercap_core.output.site.sheets import Crop, Sheet, make_sheet

FIT_COLOUR, KEYPOINT_COLOUR = (107, 168, 235), (255, 210, 64)  # RGB
_CELL_PX = 220
_MARGIN = 0.06  # of the body's box, around it
_CONFIDENT = 0.3
# Trunk, arms, legs, feet and nose; the rest of the face is in the outline.
_BONES = keypoint_pairs([*SKELETON, *FEET]).tolist()


@dataclass(frozen=True, eq=False)
class PosedBody:
    """One frame's fit, master frame: ``vertices`` (V, 3), ``keypoints`` (135, 3)."""

    vertices: np.ndarray
    keypoints: np.ndarray


def body_sheet(
    images: Frames,
    rig: Rig,
    bodies: Mapping[int, PosedBody],
    faces: np.ndarray,
    detected: np.ndarray,
) -> Sheet:
    """Draw outline and bones of the fits, and the detected keypoints, over crops of the images.

    ``bodies`` by frame, in the order of the rows; ``detected`` (T, C, 135, 3) x, y, confidence.
    """

    def draw(camera: Camera, t: int, c: int, rgb: np.ndarray) -> np.ndarray | None:
        return _cell(camera, rgb, bodies[t], faces, detected[t, c])

    return make_sheet(images, rig, list(bodies), _CELL_PX, draw)


def _cell(
    camera: Camera,
    rgb: np.ndarray,
    body: PosedBody,
    faces: np.ndarray,
    detected: np.ndarray,
) -> np.ndarray | None:
    lens = camera.colour
    local = apply(camera.colour_from_master, body.vertices)
    crop = _crop(lens.project(local[seen])) if (seen := lens.sees(local)).any() else None
    if crop is None:
        return None
    cell = crop.of(rgb)
    drawn = render(body.vertices, faces, lens, camera.colour_from_master, cull_back=True)
    crop.outline(cell, drawn.mask, drawn.x0, drawn.y0, FIT_COLOUR)
    points = apply(camera.colour_from_master, body.keypoints[BODY])
    known = lens.sees(points)
    at = crop.placed(lens.project(np.where(known[:, None], points, [0.0, 0.0, 1.0])))
    for a, b in _BONES:
        if known[a] and known[b]:
            cv2.line(cell, _pixel(at[a]), _pixel(at[b]), FIT_COLOUR, 1, cv2.LINE_AA)
    confident = detected[BODY][detected[BODY, 2] >= _CONFIDENT]
    for dot in crop.placed(confident[:, :2]):
        cv2.circle(cell, _pixel(dot), 2, KEYPOINT_COLOUR, -1, cv2.LINE_AA)
    return cell


def _crop(pixels: np.ndarray) -> Crop:
    """The square around the body's pixels (N, 2)."""
    low, high = pixels.min(0), pixels.max(0)
    size = max(int((1 + 2 * _MARGIN) * float((high - low).max())), 32)
    x0, y0 = np.rint((low + high - size) / 2).astype(int)
    return Crop(int(x0), int(y0), size, _CELL_PX)


def _pixel(point: Sequence[int] | np.ndarray) -> tuple[int, int]:
    return int(point[0]), int(point[1])
