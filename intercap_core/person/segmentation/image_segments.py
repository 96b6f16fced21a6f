"""What is segmented in one image without a detector."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ImageCandidate:
    """A thing in one view: COCO RLE, how likely it is one (0 to 1), its size in space.

    ``component`` is the same in all views that show the same thing.
    """

    rle: bytes
    score: float
    extent_m: float
    component: int


@dataclass(frozen=True)
class ViewSegments:
    """The person's RLE, empty = not seen, and candidates of one view. ``beside``: the RLE of where
    a border of the person's says nothing, empty = it says nothing anywhere."""

    person: bytes
    candidates: list[ImageCandidate]
    beside: bytes = b""
