"""What the cameras see before any pose is known: body joints of a person, corners of a board.

A *point* is a joint of the body (the first :data:`NUM_JOINTS` points) or a corner of the board.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.formats.calibration.boards import Board
from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.person.lifting import INSETS_M, DepthRelief
from intercap_core.person.sides import BODY_POINTS
from intercap_core.scene.keypoint_motion import MIN_CONFIDENCE
from intercap_core.scene.starts import shift_images

NUM_JOINTS = len(BODY_POINTS)
JOINTS = slice(0, NUM_JOINTS)
CORNERS = slice(NUM_JOINTS, None)
MIN_SEEN = 6  # joints of a person; fewer are a part of a body
LIFTED_PER_S = 3.0  # sets a second in which points are lifted; a step of a walk takes half a second
BOARDS_PER_S = 2.0  # sets a second in which boards are sought, which takes a tenth of a second each


@dataclass(frozen=True, eq=False)
class Views:
    """Points in the images of all cameras. Axes: T sets, C cameras, M points."""

    times: np.ndarray
    """(T,) seconds since the first set of the recording."""
    recording: np.ndarray
    """(T,) index of the recording; several recordings of one rig may be joined."""
    pixels: np.ndarray
    """(T, C, M, 2) pixels; NaN = not seen."""
    confidence: np.ndarray
    """(T, C, M) from 0 (not seen) to 1."""
    distance: np.ndarray
    """(T, C, M) metres from the camera's centre along the ray, by depth; NaN = not measured."""
    lags: np.ndarray
    """(R, C) sets by which the images of each recording were moved by :meth:`late`."""

    def subset(self, sets: np.ndarray) -> Views:
        """The sets of a mask (T,) or of indices."""
        names = ("times", "recording", "pixels", "confidence", "distance")
        return replace(self, **{name: getattr(self, name)[sets] for name in names})

    def only(self, kept: np.ndarray) -> Views:
        """The same views without the points outside a mask that broadcasts to (T, C, M)."""
        return replace(
            self,
            pixels=np.where(kept[..., None], self.pixels, np.nan),
            confidence=np.where(kept, self.confidence, 0.0),
            distance=np.where(kept, self.distance, np.nan),
        )

    def late(self, camera: int, recording: int, lag: int) -> Views:
        """The same views with images of a camera in a recording from ``lag`` sets later."""
        rows = np.flatnonzero(self.recording == recording)
        lags = self.lags.copy()
        lags[recording, camera] += lag
        changed = {"lags": lags}
        for name, none in (("pixels", np.nan), ("confidence", 0.0), ("distance", np.nan)):
            values = getattr(self, name).copy()
            own = values[rows][:, [camera]]
            values[rows, camera] = shift_images(own, np.array([lag]), none)[:, 0]
            changed[name] = values
        return replace(self, **changed)

    @classmethod
    def joined(cls, parts: Sequence[Views]) -> Views:
        """The sets of several recordings of the same cameras, numbered in this order."""
        names = ("times", "pixels", "confidence", "distance", "lags")
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        numbers = np.repeat(np.arange(len(parts)), [len(part.times) for part in parts])
        return cls(recording=numbers, **joined)


class Nobody:
    """A recording without a detected person; see :class:`PeopleOfImages`."""

    def __init__(self, num_sets: int) -> None:
        self.num_sets = num_sets

    def people(self, t: int, c: int) -> np.ndarray:
        """No keypoints (0, 135, 3)."""
        return np.zeros((0, NUM_KEYPOINTS, 3), np.float32)


def find_views(frames: Frames, people: PeopleOfImages, rig: Rig, board: Board | None) -> Views:
    """The person who is largest in each image, and the board; distances of some sets."""
    sets, views = frames.num_sets, len(rig)
    count = NUM_JOINTS + (len(board.corners) if board else 0)
    pixels = np.full((sets, views, count, 2), np.nan)
    confidence = np.zeros((sets, views, count))
    distance = np.full((sets, views, count), np.nan)
    lifted, sought = (_some(frames.time_s, rate) for rate in (LIFTED_PER_S, BOARDS_PER_S))
    inset = np.concatenate([INSETS_M[BODY_POINTS], np.zeros(count - NUM_JOINTS)])
    for t in range(sets):
        for c, camera in enumerate(rig):
            body = _largest(people.people(t, c)[:, BODY_POINTS])
            if body is not None:
                seen = body[:, 2] >= MIN_CONFIDENCE
                pixels[t, c, JOINTS][seen] = body[seen, :2]
                confidence[t, c, JOINTS][seen] = body[seen, 2]
            image = frames.colour(t, c) if board is not None and sought[t] else None
            if board is not None and image is not None:
                corners = board.locate(image)
                pixels[t, c, CORNERS] = corners
                confidence[t, c, CORNERS] = np.isfinite(corners[:, 0])
            with_board = confidence[t, c, CORNERS].any()
            if camera.depth is not None and (with_board or lifted[t]):
                distance[t, c] = _distances(frames.depth(t, c), camera, pixels[t, c], inset)
    lags, number = np.zeros((1, views), int), np.zeros(sets, int)
    return Views(frames.time_s, number, pixels, confidence, distance, lags)


def _some(times: np.ndarray, rate: float) -> np.ndarray:
    """Mask (T,) of at most ``rate`` sets a second."""
    slots = np.floor((times - times[0]) * rate + 1e-6)
    return np.r_[True, np.diff(slots) > 0]


def _distances(
    depth: np.ndarray | None, camera: Camera, pixels: np.ndarray, inset_m: np.ndarray
) -> np.ndarray:
    """Distances (M,) of pixels (M, 2) by a depth image; NaN = unknown."""
    seen = np.isfinite(pixels[:, 0])
    if depth is None or not seen.any():
        return np.full(len(pixels), np.nan)
    relief = DepthRelief.of(depth, camera.moved(np.eye(4)), 0.0, None)
    return np.linalg.norm(relief.lift(pixels, seen, inset_m), axis=1)


def _largest(bodies: np.ndarray) -> np.ndarray | None:
    """The body (K, 3) of bodies (P, K, 3) that is seen with the most confidence and height."""
    best, most = None, 0.0
    for body in bodies:
        seen = body[body[:, 2] >= MIN_CONFIDENCE]
        if len(seen) >= MIN_SEEN:
            size = float(seen[:, 2].sum() * np.ptp(seen[:, 1]))
            best, most = (body, size) if size > most else (best, most)
    return best
