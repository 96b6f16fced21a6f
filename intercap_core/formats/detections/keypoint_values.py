"""What becomes of the numbers of a keypoint file or model: what cannot be true is not seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.formats.detections.constants import EDGE_PX, SHARES_UP_TO

NOBODY = np.zeros((0, NUM_KEYPOINTS, 3), np.float32)


@dataclass
class Values:
    """Cleans the people of one camera's images of ``size`` (width, height), and counts.

    ``full_confidence`` is what counts as 1.
    """

    size: tuple[int, int]
    full_confidence: float = 1.0
    seen: int = 0
    outside: int = 0
    beyond: int = 0
    shares: int = 0

    def clean(self, people: np.ndarray) -> np.ndarray:
        """People (P, 135, 3) without those of whom nothing is seen, the rest as float32.

        A point that is not finite, lies outside the image or in its very corner (0, 0), or has no
        confidence becomes zeros; confidence beyond the full one is cut to 1.
        """
        x, y, confidence = np.moveaxis(np.asarray(people, np.float64), -1, 0)
        with np.errstate(invalid="ignore"):
            seen = np.isfinite(people).all(-1) & (confidence > 0) & ((x != 0) | (y != 0))
            inside = (np.minimum(x, y) >= -EDGE_PX) & (x < self.size[0] - EDGE_PX)
            inside &= y < self.size[1] - EDGE_PX
        beyond = seen & (confidence > self.full_confidence)
        self.seen += int(seen.sum())
        self.outside += int((seen & ~inside).sum())
        self.beyond += int(beyond.sum())
        known = seen & inside
        share = np.minimum(np.where(known, confidence, 0) / self.full_confidence, 1)
        result = np.where(known[..., None], np.stack([x, y, share], -1), 0).astype(np.float32)
        present = known.any(-1)
        shares = present & (result[..., :2].max((1, 2), initial=0) <= SHARES_UP_TO)
        self.shares += int(shares.sum())
        return result[present & ~shares]

    def notes(self) -> list[str]:
        """What was changed, in words."""
        notes = []
        width, height = self.size
        if self.outside:
            wrong = 2 * self.outside > self.seen
            hint = "; are they of images of another size, or of another camera?" if wrong else ""
            notes.append(
                f"{self.outside} of {self.seen} keypoints lie outside the image of "
                f"{width}x{height} pixels and count as not seen{hint}"
            )
        if self.shares:
            notes.append(
                f"{self.shares} people left out whose points all lie within {SHARES_UP_TO:g} "
                "pixels of the upper left corner: coordinates must be pixels, not shares of the "
                "image"
            )
        if self.beyond:
            notes.append(
                f"{self.beyond} of {self.seen} confidences are beyond {self.full_confidence:g} and "
                "count as 1; detections.keypoint_full_confidence says what is full"
            )
        return notes
