"""Simulated keypoints whose errors follow those measured for a real detector, MediaPipe Holistic.

- Each joint has an offset in the body's frame, equal in all views, on the left and on the right.
- Errors last for about half a second. Views share a part of them; hidden joints err by several
  times as much, and the confidence of trunk and head does not show it.
- A hand is found if enough of it is visible, more rarely while it holds the object. Instead of a
  hidden hand, the other hand may be reported. The face is found from the front.
- Joints lag behind the motion; hands do not.

The sizes come from ``python -m bench.detector_errors`` and from the same errors split by view,
on 13 recordings that no evaluation uses. The directions of the offsets are drawn for each
recording, so that no fit can learn them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import expit, ndtr

from intercap_core.body.keypoints import BODY, KEYPOINT_NAMES, LEFT_HAND, PARTNER, RIGHT_HAND
from intercap_core.geometry.camera.rig import Camera
from intercap_core.studio.keypoints import Detector
from intercap_core.studio.noise import NoiseSource

HANDS = (LEFT_HAND, RIGHT_HAND)


def _indices(*names: str) -> list[int]:
    return [KEYPOINT_NAMES.index(name) for name in names]


_WRISTS = _indices("left_wrist", "right_wrist")  # whose confidence a hand's points get
_NOSE, _EARS = KEYPOINT_NAMES.index("nose"), _indices("left_ear", "right_ear")
# Points that MediaPipe lacks
_ABSENT = _indices("neck", "mid_hip", "left_small_toe", "right_small_toe")


class Errors(NamedTuple):
    """Errors of a group of points."""

    bias: float
    """Length of the offset in the body's frame, mm."""
    jitter: float
    """Standard deviation of the view's own error, in x and in y, mm."""
    fast: float
    """Share of the variance of ``jitter`` that is independent from frame to frame."""
    hidden: float = 0.0
    """Median length of the additional error of a hidden point, mm."""
    sure: float = 6.0
    """Median log odds of the confidence of a visible point."""
    unsure: float = 6.0
    """The same of a hidden point."""


# Measured with `python -m bench.detector_errors` (bench/RESULTS.md), see the header
ERRORS = {
    "head": Errors(31, 8, 0.1, 20),
    "shoulders": Errors(33, 10, 0.1, 15),
    "elbows": Errors(25, 12, 0.1, 65, 3.5, -1.6),
    "wrists": Errors(22, 12, 0.1, 90, 3.0, -1.6),
    "hips": Errors(35, 10, 0.1, 20),
    "knees": Errors(17, 12, 0.1, 75, 3.2, 0.6),
    "ankles": Errors(23, 12, 0.1, 80, 3.2, 0.6),
    "feet": Errors(32, 15, 0.1, 80, 2.8, 0.8),
    "hand: wrist and knuckles": Errors(10, 3.5, 1.0, 6),
    "hand: fingers": Errors(7, 3.5, 1.0, 15),
    "hand: fingertips": Errors(9, 4, 1.0, 15),
    "face": Errors(6, 2, 0.5, 8),
}


def groups() -> dict[str, np.ndarray]:
    """Indices of the keypoints of each group of :data:`ERRORS`."""
    names = np.array(KEYPOINT_NAMES[BODY])

    def containing(*words: str) -> np.ndarray:
        return np.array([i for i, name in enumerate(names) if any(w in name for w in words)])

    hand = np.arange(21)
    tips, roots = hand[4::4], np.array([0, 5, 9, 13, 17])
    other = np.setdiff1d(hand, [*tips, *roots])
    hand_parts = {"wrist and knuckles": roots, "fingers": other, "fingertips": tips}
    return {
        "head": containing("nose", "eye", "ear"),
        "shoulders": containing("shoulder"),
        "elbows": containing("elbow"),
        "wrists": containing("wrist"),
        "hips": containing("left_hip", "right_hip"),
        "knees": containing("knee"),
        "ankles": containing("ankle"),
        "feet": containing("big_toe", "heel"),
        **{f"hand: {name}": np.r_[25 + rows, 46 + rows] for name, rows in hand_parts.items()},
        "face": np.arange(67, 135),
    }


class MeasuredDetector(Detector):
    """A detector with the errors of :data:`ERRORS`; it detects one person and no small toes."""

    correlation_s = 0.5  # duration of all errors but those of hidden points
    hidden_s = 1.0  # of these
    shared = 0.6  # of the jitter: the error that all views share, in each axis
    constant = 0.7  # of the jitter: the bias of a view
    hidden_shared = 0.4  # share of the variance of hidden points' errors that views have in common
    hidden_tail = 0.6  # standard deviation of the logarithm of the size of a hidden point's error
    lag_s = 0.010  # of joints behind the motion
    confidence_spread = 1.0  # standard deviation of the log odds of the confidence
    hand_threshold = 0.45  # visible share from which a hand is found
    holding_threshold = 0.65  # the same of a hand that holds the object
    hand_spread = 0.25  # standard deviation of these thresholds
    hand_shift_mm = 50.0  # median error of a found hand, times its hidden share squared
    other_hand_probability = 0.25  # that the other hand is reported for one that is not found,
    other_hand_m = 0.35  # if its wrist is so near in the image
    face_cosine = 0.63  # of the angle between face and camera from which the face is found
    face_spread = 0.13  # its standard deviation

    @classmethod
    def build(cls, noise: NoiseSource, frames: int, body_bias: float = 1.0) -> MeasuredDetector:
        """Draw the offsets, mirrored from left to right; ``body_bias`` scales those of the body."""
        direction = noise.detector_rng("keypoint bias").normal(size=(135, 3))
        mirrored = direction[PARTNER] * (-1, 1, 1)  # x points to the person's left
        is_second = np.arange(135) > PARTNER
        direction = np.where(is_second[:, None], mirrored, direction)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        size = 1e-3 * _column("bias")
        size[BODY] *= body_bias
        return cls(noise, frames, direction * size[:, None] * noise.scale)

    def detect(
        self,
        camera: Camera,
        points: np.ndarray,
        axes: np.ndarray,
        hidden: np.ndarray,
        holding: np.ndarray,
        *who: str,
    ) -> np.ndarray:
        """See :meth:`.Detector.detect`."""
        rng = self.noise.detector_rng("measured", camera.name, *who)
        pose = camera.colour_from_master
        at = points @ pose[:3, :3].T + pose[:3, 3]
        visible = np.stack([1 - hidden[:, hand].mean(1) for hand in HANDS], 1)
        error = self._shared(points, axes, *who) @ pose[:2, :3].T
        error += self._own(rng)
        error += self._hidden(rng, hidden, visible, pose[:2, :3], *who)
        metre_px = camera.colour.fx / np.maximum(at[..., 2:], 0.3)
        pixels = camera.colour.project(at) + 1e-3 * self.noise.scale * error * metre_px

        level = np.where(hidden, _column("unsure"), _column("sure"))
        confidence = expit(level + self.confidence_spread * self._lasting(rng, 135))
        confidence[:, _ABSENT] = 0
        apart = np.linalg.norm(pixels[:, _WRISTS[0]] - pixels[:, _WRISTS[1]], axis=1)
        is_near = apart < self.other_hand_m * metre_px[:, 8, 0]
        pixels, confidence = self._hands(rng, pixels, confidence, visible, holding, is_near)
        confidence[:, RIGHT_HAND.stop :] = confidence[:, [_NOSE]] * self._sees_face(
            rng, camera, points
        )
        return self._in_image(camera, at[..., 2], *self._swapped(rng, pixels, confidence))

    def people(self, camera: Camera, subject: np.ndarray) -> list[list[np.ndarray]]:
        """The subject (135, 3) in each frame's file unless missed; nobody else is reported."""
        rng = self.noise.detector_rng("people", camera.name)
        missed = self.noise.episodes(rng, self.frames, self.miss_probability, self.miss_s)[:, 0]
        return [[] if missed[t] else [subject[t]] for t in range(self.frames)]

    def _lasting(
        self, rng: np.random.Generator, *shape: int, seconds: float = correlation_s
    ) -> np.ndarray:
        """First-order process (T, *shape) of unit variance with this correlation time."""
        channels = int(np.prod(shape))
        path = self.noise.first_order(rng, self.frames, channels, seconds)
        return path.reshape(self.frames, *shape)

    def _shared(self, points: np.ndarray, axes: np.ndarray, *who: str) -> np.ndarray:
        """Errors (T, 135, 3) that all views have in common, master frame, mm."""
        rng = self.noise.detector_rng("measured", *who)
        jitter = _column("jitter")
        error = 1e3 * np.einsum("tij,kj->tki", axes, self.body_bias)
        error += self.shared * jitter[:, None] * self._lasting(rng, 135, 3)
        speed = np.gradient(points[:, BODY], axis=0) * self.noise.fps
        error[:, BODY] -= 1e3 * self.lag_s * speed
        return error

    def _own(self, rng: np.random.Generator) -> np.ndarray:
        """Errors (T, 135, 2) of one view, mm."""
        jitter, fast = _column("jitter")[:, None], _column("fast")[:, None]
        bias = self.constant * jitter * rng.normal(size=(135, 2))
        white = rng.normal(size=(self.frames, 135, 2))
        return bias + jitter * (
            np.sqrt(1 - fast) * self._lasting(rng, 135, 2) + np.sqrt(fast) * white
        )

    def _hidden(
        self,
        rng: np.random.Generator,
        hidden: np.ndarray,
        visible: np.ndarray,
        image_from_master: np.ndarray,
        *who: str,
    ) -> np.ndarray:
        """Errors (T, 135, 2) of hidden joints, and of hands by their hidden share, mm.

        Args:
            hidden: (T, 135) mask of occluded points.
            visible: (T, 2) visible share of each hand.
            image_from_master: (2, 3) the image's axes in the master's frame.
        """
        shared = self._lasting(
            self.noise.detector_rng("measured", "hidden", *who), 135, 3, seconds=self.hidden_s
        )
        direction = np.sqrt(self.hidden_shared) * shared @ image_from_master.T
        direction += np.sqrt(1 - self.hidden_shared) * self._lasting(
            rng, 135, 2, seconds=self.hidden_s
        )
        size = np.exp(self.hidden_tail * self._lasting(rng, 135, 1, seconds=self.hidden_s))
        direction *= size / np.sqrt(2 * np.log(2))  # the median length of two coordinates
        error = np.where(hidden[..., None], _column("hidden")[:, None] * direction, 0)
        for side, hand in enumerate(HANDS):  # a hand is shifted as a whole
            size = self.hand_shift_mm * (1 - visible[:, side]) ** 2
            error[:, hand] += size[:, None, None] * direction[:, hand][:, :1]
        return error

    def _hands(
        self,
        rng: np.random.Generator,
        pixels: np.ndarray,
        confidence: np.ndarray,
        visible: np.ndarray,
        holding: np.ndarray,
        is_near: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Omit hands that are not found, or report the other hand in their place.

        ``is_near``: (T,) mask of frames in which both wrists are close to each other in the image.
        """
        threshold = np.where(holding, self.holding_threshold, self.hand_threshold)
        found = visible + self.hand_spread * self._lasting(rng, 2) > threshold
        wrong = ~found & found[:, ::-1] & is_near[:, None]
        wrong &= ndtr(self._lasting(rng, 2)) < self.other_hand_probability
        pixels, confidence, right_places = pixels.copy(), confidence.copy(), pixels
        for side, hand in enumerate(HANDS):
            swap = wrong[:, side]
            pixels[swap, hand] = right_places[swap, HANDS[1 - side]]
            wrist = confidence[:, _WRISTS[side]]
            confidence[:, hand] = np.where(found[:, side] | swap, wrist, 0)[:, None]
        return pixels, confidence

    def _sees_face(
        self, rng: np.random.Generator, camera: Camera, points: np.ndarray
    ) -> np.ndarray:
        """Mask (T, 1) of frames in which the face is towards the camera."""
        forward = points[:, _NOSE] - points[:, _EARS].mean(1)
        to_eye = camera.master_from_colour[:3, 3] - points[:, _NOSE]
        cosine = (forward * to_eye).sum(1) / (
            np.linalg.norm(forward, axis=1) * np.linalg.norm(to_eye, axis=1)
        )
        return cosine[:, None] + self.face_spread * self._lasting(rng, 1) > self.face_cosine


def _column(name: str) -> np.ndarray:
    """A column of :data:`ERRORS` by keypoint (135,); points without a group err as the hips."""
    values = np.full(135, getattr(ERRORS["hips"], name), float)
    for group, points in groups().items():
        values[points] = getattr(ERRORS[group], name)
    return values
