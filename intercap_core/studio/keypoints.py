"""2D keypoints with the errors of a detector like OpenPose, in its file format.

Errors of a joint:

- a fixed bias in the body, because a detector's joints differ from the skeleton's;
- a bias of the view, and jitter that is correlated over time;
- exchanges of left and right;
- a plausible wrong place if the joint is occluded.

Errors of a person: the subject is missed, or a person who does not exist is reported.

The confidence depends on the error only partly. The 135 points are body (0 to 24; 8 = middle of the
hips), left hand (25 to 45), right hand (46 to 66) and face (67 to 134).
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np

from intercap_core.body.keypoints import (
    BODY,
    CONTOUR,
    FACE,
    KEYPOINT_NAMES,
    LEFT_HAND,
    PARTNER,
    RIGHT_HAND,
)
from intercap_core.geometry.camera.rig import Camera
from intercap_core.studio.noise import NoiseSource

_LEG_WORDS = ("_hip", "knee", "ankle", "toe", "heel")
_LEGS = np.array(
    [i for i, n in enumerate(KEYPOINT_NAMES[:25]) if any(w in n for w in _LEG_WORDS) and i != 8]
)


@dataclass(frozen=True)
class Detector:
    """A detector over one recording.

    Errors in px hold for a person 2.5 m away in 1080p and grow with the person's size in the image.
    """

    noise: NoiseSource
    """Random numbers and the scale of all errors."""
    frames: int
    """Number T of frame sets."""
    body_bias: np.ndarray
    """(135, 3) fixed biases in the body's own axes, metres."""
    body_bias_m = (0.010, 0.020)  # range of the fixed bias of each body joint, metres
    hand_bias_m = (0.002, 0.005)  # of each hand joint, metres
    face_bias_m = (0.001, 0.004)  # of each face point, metres
    view_bias_px = 2.0  # standard deviation of the bias of a view
    jitter_px = 2.4  # standard deviation of the jitter of body joints
    hand_jitter_px = 2.0  # of hand joints
    face_jitter_px = 1.2  # of face points
    fast_jitter = 0.4  # share of the jitter's deviation that is independent from frame to frame
    jitter_s = 0.5  # correlation time of the rest
    # standard deviation, in x and in y, of the error of a hidden body joint, metres
    hidden_shift_m = 0.045
    hidden_hand_shift_m = 0.030  # the same of a hidden hand joint
    swap_probability = 0.015  # that left and right are exchanged in a frame
    swap_s = 0.3  # duration of an exchange
    miss_probability = 0.012  # that a person is not detected in a frame
    miss_s = 0.25  # duration of a miss
    bystander_probability = 0.08  # that a person who does not exist is detected in a frame
    bystander_s = 1.0  # duration of a false person
    fewest_visible = 8  # visible body joints of 25 below which a passer-by is not detected
    blind = 0.35  # share of the confidence that is independent of the true error

    @classmethod
    def build(cls, noise: NoiseSource, frames: int, body_bias: float = 1.0) -> Detector:
        """Draw the fixed biases, equal in all cameras; ``body_bias`` scales those of the body."""
        rng = noise.detector_rng("keypoint bias")
        size = np.empty(135)
        size[BODY] = body_bias * rng.uniform(*cls.body_bias_m, 25)
        size[25:67] = rng.uniform(*cls.hand_bias_m, 42)
        size[67:] = rng.uniform(*cls.face_bias_m, 68)
        size[[0, 15, 16, 17, 18]] *= 0.35  # nose, eyes, ears are seen, not guessed
        direction = rng.normal(size=(135, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
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
        """Keypoints (T, 135, 3) x, y, confidence of one person in one camera.

        Args:
            points: (T, 135, 3) true points, master frame, metres.
            axes: (T, 3, 3) rotation of the pelvis from the rest pose to the master frame.
            hidden: (T, 135) mask of occluded points.
            holding: (T, 2) mask of frames in which the left, the right hand is at the object.
            who: name of the person's random stream; none for the subject.
        """
        noise, scale = self.noise, self.noise.scale
        rng = noise.detector_rng("keypoints", camera.name, *who)
        biased = points + np.einsum("tij,kj->tki", axes, self.body_bias)
        pose = camera.colour_from_master
        at = biased @ pose[:3, :3].T + pose[:3, 3]
        pixels = camera.colour.project(at)
        pelvis_depth = points[:, 8] @ pose[2, :3] + pose[2, 3]
        per_metre = (camera.colour.fx / np.maximum(pelvis_depth, 0.3))[:, None, None]  # px
        # 1 if the subject is as large as at 2.5 m in 1080p, which is 370 px for a metre
        unit_px = per_metre / 370.0

        jitter = np.empty(135)
        jitter[BODY], jitter[25:67], jitter[67:] = (
            self.jitter_px,
            self.hand_jitter_px,
            self.face_jitter_px,
        )
        slow = noise.process(rng, self.frames, 270, self.jitter_s).reshape(-1, 135, 2)
        fast = noise.tails(rng.normal(size=slow.shape))
        # additional errors that all points of the left hand, and all of the right, have in common
        group = noise.process(rng, self.frames, 4, self.jitter_s).reshape(-1, 2, 2)
        wander = np.sqrt(1 - self.fast_jitter**2) * slow + self.fast_jitter * fast
        wander[:, LEFT_HAND] += 0.9 * group[:, :1]
        wander[:, RIGHT_HAND] += 0.9 * group[:, 1:]
        error = wander * (jitter * scale)[:, None]
        view_bias = noise.tails(rng.normal(size=(135, 2))) * self.view_bias_px * scale
        view_bias[67:] *= 0.4
        error += view_bias

        hidden_share = noise.process(rng, self.frames, 270, self.jitter_s).reshape(-1, 135, 2)
        shift = np.full(135, self.hidden_shift_m)
        shift[25:67], shift[67:] = self.hidden_hand_shift_m, 0.015
        hallucinated = hidden_share * shift[:, None] * 370.0 * scale  # px at 2.5 m in 1080p
        error += np.where(hidden[..., None], hallucinated, 0)
        pixels = pixels + error * unit_px

        confidence = self._confidence(rng, error, hidden)
        return self._in_image(camera, at[..., 2], *self._swapped(rng, pixels, confidence))

    @staticmethod
    def _in_image(
        camera: Camera, depth: np.ndarray, pixels: np.ndarray, confidence: np.ndarray
    ) -> np.ndarray:
        """Keypoints (T, 135, 3), without confidence outside of the image or behind the camera."""
        inside = (pixels > -0.5).all(-1) & (
            pixels < (camera.colour.width - 0.5, camera.colour.height - 0.5)
        ).all(-1)
        confidence = np.where(inside & (depth > 0.1), confidence, 0)
        return np.concatenate([pixels, confidence[..., None]], -1)

    def _confidence(
        self, rng: np.random.Generator, error: np.ndarray, hidden: np.ndarray
    ) -> np.ndarray:
        """Confidence (T, 135) in [0, 1], lower for larger errors and for hidden points.

        ``guess`` depends on the true error (px); ``ignorant`` does not.
        """
        size = np.linalg.norm(error, axis=-1)
        chance = self.noise.process(rng, self.frames, 135, 0.3)
        guess = 0.86 - 0.012 * size - 0.22 * hidden + 0.08 * chance
        ignorant = 0.72 + 0.13 * self.noise.process(rng, self.frames, 135, 0.3)
        confidence = (1 - self.blind) * guess + self.blind * ignorant
        confidence[:, 25:67] -= 0.12
        return np.clip(confidence, 0.02, 0.98)

    def _swapped(
        self, rng: np.random.Generator, pixels: np.ndarray, confidence: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Exchange left and right of the whole body or of the legs for short periods."""
        self.noise.process(rng, self.frames, 1, self.swap_s)  # keeps the order of random numbers
        swapped = self.noise.episodes(
            rng, self.frames, self.swap_probability, self.swap_s, channels=2
        )
        pixels, confidence = pixels.copy(), confidence.copy()
        for t in np.flatnonzero(swapped.any(1)):
            rows = np.arange(67) if swapped[t, 0] else _LEGS
            source = PARTNER[rows]
            pixels[t, rows], confidence[t, rows] = pixels[t, source], confidence[t, source]
            confidence[t, rows] *= 0.92
        return pixels, confidence

    def people(self, camera: Camera, subject: np.ndarray) -> list[list[np.ndarray]]:
        """People (135, 3) of each frame's file: the subject unless missed, and a false person.

        The false person is a shifted and shrunk copy of the subject, present in episodes.
        """
        noise = self.noise
        rng = noise.detector_rng("people", camera.name)
        shared = noise.detector_rng("people")
        common = noise.process(shared, self.frames, 1, self.miss_s)
        missed = noise.episodes(
            rng, self.frames, self.miss_probability, self.miss_s, common, agreement=0.3
        )[:, 0]
        common = noise.process(shared, self.frames, 1, self.bystander_s)
        bystander = noise.episodes(
            rng, self.frames, self.bystander_probability, self.bystander_s, common, agreement=0.4
        )[:, 0]
        width, height = camera.colour.width, camera.colour.height
        place = np.array([rng.uniform(0.1, 0.9) * width, rng.uniform(0.3, 0.5) * height])
        size = rng.uniform(0.3, 0.6)
        result = []
        for t in range(self.frames):
            people = [] if missed[t] else [subject[t]]
            if bystander[t]:
                ghost = subject[t].copy()
                ghost[:, :2] = (ghost[:, :2] - ghost[8, :2]) * size + place
                ghost[:, :2] += rng.normal(0, 6, ghost[:, :2].shape) * width / 1920
                ghost[:, 2] *= rng.uniform(0.3, 0.8)
                people.insert(int(rng.integers(len(people) + 1)), ghost)
            result.append(people)
        return result

    def with_passer_by(
        self,
        camera: Camera,
        people: list[list[np.ndarray]],
        passer_by: np.ndarray,
        hidden: np.ndarray,
    ) -> list[list[np.ndarray]]:
        """Add a second person (T, 135, 3) to each file unless missed or mostly hidden."""
        noise = self.noise
        rng = noise.detector_rng("passer-by", camera.name)
        missed = noise.episodes(rng, self.frames, self.miss_probability, self.miss_s)[:, 0]
        seen = (passer_by[:, BODY, 2] > 0) & ~hidden[:, BODY]
        detected = (seen.sum(1) >= self.fewest_visible) & ~missed
        result = []
        for t, have in enumerate(people):
            place = int(rng.integers(len(have) + 1))
            result.append([*have[:place], passer_by[t], *have[place:]] if detected[t] else have)
        return result


def to_json(people: list[np.ndarray]) -> str:
    """A file's content as OpenPose writes it: body 25, face 70, hands 21; x, y, confidence."""
    entries = []
    for person in people:
        face = np.zeros((70, 3))
        face[:17], face[17:68] = person[CONTOUR], person[FACE]
        face[68], face[69] = person[FACE][19:25].mean(0), person[FACE][25:31].mean(0)
        parts = {
            "pose_keypoints_2d": person[BODY],
            "face_keypoints_2d": face,
            "hand_left_keypoints_2d": person[LEFT_HAND],
            "hand_right_keypoints_2d": person[RIGHT_HAND],
        }
        entry: dict[str, list[float] | list[int]] = {"person_id": [-1]}
        for name, rows in parts.items():
            rows = np.where(rows[:, 2:] > 0, rows, 0.0)
            entry[name] = [round(float(v), 3) for v in rows.ravel()]
        for name in ("pose", "face", "hand_left", "hand_right"):
            entry[f"{name}_keypoints_3d"] = []
        entries.append(entry)
    return json.dumps({"version": 1.3, "people": entries}, separators=(",", ":"))
