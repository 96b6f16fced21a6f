"""Instance candidates with the errors of a segmentation network, in COCO's result format.

Errors last for 0.3 to 1 s and partly agree between views: borders, labels, misses, merged person
and object, false instances. The order is random, and scores hardly separate true from false
instances.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from pycocotools import mask as coco

from intercap_core.formats.detections.class_names import COCO_NAMES
from intercap_core.geometry.camera.masks import encode_window
from intercap_core.studio.noise import NoiseSource
from intercap_core.studio.render import BODY, OBJECT, PASSER_BY

LABELS = {
    "suitcase": "suitcase", "skateboard": "skateboard", "football": "sports ball",
    "umbrella": "umbrella", "tennis_racquet": "tennis racket", "toolbox": "suitcase",
    "chair": "chair", "bottle": "bottle", "cup": "cup", "stool": "chair",
}  # fmt: skip
CONFUSED = {
    "suitcase": ("handbag", "backpack", "refrigerator"), "skateboard": ("surfboard", "snowboard"),
    "sports ball": ("frisbee", "apple"), "umbrella": ("baseball bat", "tie"),
    "tennis racket": ("baseball bat", "frisbee"), "chair": ("bench", "dining table", "toilet"),
    "bottle": ("vase", "wine glass"), "cup": ("bowl", "vase", "wine glass"),
}  # fmt: skip
OTHER_THINGS = ("book", "tv", "potted plant", "clock", "vase", "handbag", "chair", "bottle")
CATEGORY_IDS = {name: number for number, name in COCO_NAMES.items()}
EPISODE_S = (0.3, 1.0)  # range of the duration of an error
AGREEMENT = 0.5  # share of the errors' variance that all views have in common


@dataclass(frozen=True)
class Labels:
    """True labels of one camera's image."""

    identity: np.ndarray
    """(h, w) surface in each pixel (:data:`.render.BODY`, ...; 0 = room) of a window of the image
    whose first pixel is (x0, y0)."""
    x0: int
    y0: int
    size: tuple[int, int]
    """Width and height of the image."""
    visible: float
    """Share of the object that is not occluded."""
    blur_px: float
    """Motion of the object during the exposure, px."""


class MaskSimulator:
    """The network over one recording; the errors of its cameras partly agree."""

    def __init__(
        self, noise: NoiseSource, frames: int, object_name: str, passer_by: bool = False
    ) -> None:
        self.noise, self.frames, self.passer_by = noise, frames, passer_by
        self.label = LABELS.get(object_name, object_name)
        shared = noise.detector_rng("masks")
        self.shared = {
            name: noise.process(shared, frames, 1, shared.uniform(*EPISODE_S))[:, 0]
            for name in ("label", "miss", "merge", "split", "person")
        }


class CameraMasks:
    """Candidates of one camera.

    Args:
        clutter: (H, W) mask of the twin, another object of the same class in the room, or None.
        size: width and height of the images.
    """

    border_px = 2.2  # RMS displacement of borders, px at 1080p
    max_border_px = 5.0  # largest displacement, px at 1080p
    wrong_label = 0.15  # probability of a wrong label
    merged = 0.06  # probability of one mask for person and object
    split = 0.05  # probability of half the object's mask
    miss_free = 0.10  # probability of a miss in full view
    miss_hidden = 0.85  # probability of a miss when all is hidden
    miss_blurred = 0.7  # probability of a miss at strong motion blur
    blur_px = 12.0  # motion during the exposure that counts as strong, px at 1080p
    person_missed = 0.015  # probability of a missed person
    clutter = 0.35  # probability of each false instance in a frame
    twin = 0.85  # probability that another object of the same class is detected
    min_pixels = 30  # smaller masks are not detected
    margin_px = 12  # room around a mask for a border that moves outward

    def __init__(
        self, network: MaskSimulator, name: str, clutter: np.ndarray | None, size: tuple[int, int]
    ) -> None:
        noise, frames = network.noise, network.frames
        self.network, self.noise, self.size = network, noise, size
        self._rng = rng = noise.detector_rng("masks", name)

        def episodes(kind: str, probability: float) -> np.ndarray:
            seconds, shared = rng.uniform(*EPISODE_S), network.shared[kind]
            return noise.episodes(rng, frames, probability, seconds, shared, AGREEMENT)[:, 0]

        self._wrong_label = episodes("label", self.wrong_label)
        self._merged, self._split = episodes("merge", self.merged), episodes("split", self.split)
        self._person_missed = episodes("person", self.person_missed)
        miss = noise.process(rng, frames, 1, rng.uniform(*EPISODE_S))[:, 0]
        self._miss = np.sqrt(AGREEMENT) * network.shared["miss"] + np.sqrt(1 - AGREEMENT) * miss
        self._wrong = rng.integers(0, 1000, frames // 8 + 2)
        # slow waves that move the borders in and out, one set for the object, one for the person
        self._waves = noise.process(rng, frames, 24, rng.uniform(*EPISODE_S)).reshape(-1, 2, 12)
        self._directions = rng.normal(size=(2, 12, 2))
        self._phases = rng.uniform(0, 2 * np.pi, (2, 12))
        self._twin = clutter if clutter is not None and clutter.sum() > self.min_pixels else None
        self._clutter = self._false_instances()
        often = [self.twin] * (self._twin is not None) + [self.clutter] * len(self._clutter)
        self._clutter_on = np.concatenate([noise.episodes(rng, frames, p, 0.7) for p in often], 1)
        # columns: person, object, unused, fate of the object's own mask if merged, false instances
        self._score = noise.process(rng, frames, 4 + len(often), 0.3)
        if network.passer_by:
            self._expect_passer_by(noise.detector_rng("masks", name, "passer-by"))

    def _expect_passer_by(self, rng: np.random.Generator) -> None:
        """Draw waves, misses and scores of a second person."""
        noise, frames = self.noise, self.network.frames
        waves = noise.process(rng, frames, 12, rng.uniform(*EPISODE_S))[:, None]
        self._waves = np.concatenate([self._waves, waves], 1)
        self._directions = np.concatenate([self._directions, rng.normal(size=(1, 12, 2))])
        self._phases = np.concatenate([self._phases, rng.uniform(0, 2 * np.pi, (1, 12))])
        seconds = rng.uniform(*EPISODE_S)
        self._other_missed = noise.episodes(rng, frames, self.person_missed, seconds)[:, 0]
        self._other_score = noise.process(rng, frames, 1, 0.3)[:, 0]

    def _false_instances(self) -> list[tuple[str, dict[str, Any]]]:
        """Label and RLE of false instances that do not move."""
        width, height = self.size
        instances = []
        for _ in range(3):
            label = OTHER_THINGS[self._rng.integers(len(OTHER_THINGS))]
            blob = np.zeros((height, width), np.uint8)
            centre = (int(self._rng.uniform(0, width)), int(self._rng.uniform(0, height)))
            axes = self._rng.uniform(15, 90, 2) * width / 1920
            angle = self._rng.uniform(0, 180)
            cv2.ellipse(blob, centre, (int(axes[0]), int(axes[1])), angle, 0, 360, 1, -1)
            instances.append((label, _encode(blob, 0, 0, self.size)))
        return instances

    def candidates(self, t: int, truth: Labels) -> list[dict[str, Any]]:
        """COCO results of set ``t`` without image_id, in random order."""
        instances: list[tuple[str, dict[str, Any], float]] = []
        person = self._bordered(truth, BODY, t)
        prop = self._bordered(truth, OBJECT, t)
        score = 0.72 + 0.12 * self._score[t]
        if self._merged[t] and prop is not None and person is not None:
            person = person | prop
            if self._score[t, 3] > 0:  # half the time the object's own mask is missing then
                prop = None
        if person is not None and not self._person_missed[t]:
            instances.append(("person", self._rle(person, truth), score[0] + 0.15))
        if self.network.passer_by and not self._other_missed[t]:
            other = self._bordered(truth, PASSER_BY, t)
            if other is not None:
                instances.append(
                    ("person", self._rle(other, truth), 0.87 + 0.12 * self._other_score[t])
                )
        missed = self.miss_free + (self.miss_hidden - self.miss_free) * (1 - truth.visible) ** 2
        blur = truth.blur_px / (self.blur_px * self.size[0] / 1920)
        missed = 1 - (1 - missed) * (1 - self.miss_blurred * (1 - np.exp(-(blur**2))))
        threshold = np.clip(missed * self.noise.scale, 0, 0.97)
        rank = 0.5 * (1 + np.tanh(0.8 * self._miss[t]))
        if prop is not None and rank > threshold:
            if self._split[t]:
                prop = self._half(prop, t)
            instances.append((self._object_label(t), self._rle(prop, truth), score[1]))
        for k, (label, rle) in enumerate(self._standing(truth)):
            if self._clutter_on[t, k] and coco.area(rle):
                instances.append((label, rle, score[4 + k] - 0.08))
        order = self.noise.detector_rng("mask order", t, truth.x0, truth.y0).permutation(
            len(instances)
        )
        return [self._result(*instances[i]) for i in order]

    def _standing(self, truth: Labels) -> list[tuple[str, dict[str, Any]]]:
        """Static false instances, first the unoccluded part of the object's twin."""
        if self._twin is None:
            return self._clutter
        height, width = truth.identity.shape
        left = self._twin.copy()
        left[truth.y0 : truth.y0 + height, truth.x0 : truth.x0 + width] &= truth.identity == 0
        return [(self.network.label, _encode(left, 0, 0, self.size)), *self._clutter]

    def _object_label(self, t: int) -> str:
        """Label of the object in set ``t``; a wrong label stays for up to eight sets."""
        label = self.network.label
        if not self._wrong_label[t]:
            return label
        others = CONFUSED.get(label, OTHER_THINGS)
        return others[self._wrong[t // 8] % len(others)]

    def _result(self, label: str, rle: dict[str, Any], score: float) -> dict[str, Any]:
        """An instance in COCO's result format, with the category's name."""
        box = [round(float(v), 2) for v in coco.toBbox(rle)]
        counts = rle["counts"].decode() if isinstance(rle["counts"], bytes) else rle["counts"]
        return {
            "category": label,
            "category_id": CATEGORY_IDS.get(label, 0),
            "segmentation": {"size": [int(n) for n in rle["size"]], "counts": counts},
            "score": round(float(np.clip(score, 0.06, 0.99)), 4),
            "bbox": box,
        }

    def _bordered(self, truth: Labels, kind: int, t: int) -> np.ndarray | None:
        """Mask (h + 2m, w + 2m), m = ``margin_px``, with its border moved; None if it is too small.

        The border moves by a sum of random plane waves over the image, added to the signed distance
        from the border. ``kind``: BODY, OBJECT or PASSER_BY.
        """
        mask = truth.identity == kind
        if mask.sum() < self.min_pixels:
            return None
        margin = self.margin_px
        whole = np.pad(mask, margin).astype(np.uint8)
        x0, y0, width, height = cv2.boundingRect(whole)
        part = (
            slice(max(y0 - margin, 0), y0 + height + margin),
            slice(max(x0 - margin, 0), x0 + width + margin),
        )
        padded = np.ascontiguousarray(whole[part])
        inside = cv2.distanceTransform(padded, cv2.DIST_L2, 3)
        outside = cv2.distanceTransform(1 - padded, cv2.DIST_L2, 3)
        rows, columns = np.nonzero(padded)
        size = max(np.sqrt(len(rows)), 12.0)
        step = max(1, int(size / 24))  # the waves are long: drawn coarsely, then enlarged
        y, x = np.mgrid[: padded.shape[0] : step, : padded.shape[1] : step]
        x, y = (x - columns.mean()) / size, (y - rows.mean()) / size
        which = kind - 1  # kinds count from 1
        coarse = np.zeros(x.shape)
        for k in range(12):
            direction = self._directions[which, k] * (2.0 + 0.5 * k)
            wave = np.cos(direction[0] * x + direction[1] * y + self._phases[which, k])
            coarse += self._waves[t, which, k] * np.sqrt(2 / 12) * wave
        scale = self.size[0] / 1920 * self.noise.scale
        coarse = np.clip(
            coarse * self.border_px * scale, -self.max_border_px * scale, self.max_border_px * scale
        )
        offset = cv2.resize(coarse.astype(np.float32), padded.shape[::-1])
        moved = np.zeros(whole.shape, bool)
        moved[part] = (inside - outside + offset) > 0
        return moved if moved.sum() >= self.min_pixels else None

    def _half(self, mask: np.ndarray, t: int) -> np.ndarray:
        """Part of a mask, as if the network took the object for two."""
        rows, columns = np.nonzero(mask)
        angle = self._phases[0, t % 12]
        along = np.cos(angle) * columns + np.sin(angle) * rows
        keep = along > np.quantile(along, 0.35)
        part = np.zeros_like(mask)
        part[rows[keep], columns[keep]] = True
        return part

    def _rle(self, mask: np.ndarray, truth: Labels) -> dict[str, Any]:
        return _encode(mask, truth.x0 - self.margin_px, truth.y0 - self.margin_px, truth.size)


def _encode(mask: np.ndarray, x0: int, y0: int, size: tuple[int, int]) -> dict[str, Any]:
    """COCO RLE of a window at (x0, y0), which may reach beyond the image."""
    width, height = size
    left, top = max(-x0, 0), max(-y0, 0)
    window = mask[top : max(height - y0, 0), left : max(width - x0, 0)] != 0
    counts = encode_window(window, x0 + left, y0 + top, height, width)
    return {"size": [height, width], "counts": counts}
