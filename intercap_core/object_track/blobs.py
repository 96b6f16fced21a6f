"""Candidates whose mask covers both person and object: the object's part of the mask."""

from __future__ import annotations

import cv2
import numpy as np

from intercap_core.object_track.constants import (
    BLOB_MIN_REST_SHARE,
    BLOB_PERSON_SHARE,
    MASK_BORDER_PX,
)
from intercap_core.object_track.reduced_mask import ReducedMask


def without_person(mask: ReducedMask, person: ReducedMask, step: int) -> ReducedMask | None:
    """The largest part, outside the person's mask, of a candidate that covers person and object.

    None where the candidate does not cover the person, or is the person alone. ``step`` is the
    reduction of both masks; slivers along the person's silhouette are discarded.
    """
    if not mask.area or not person.area:
        return None
    here = person.window(mask.x0, mask.y0, *mask.mask.shape)
    if (here & mask.mask).sum() < BLOB_PERSON_SHARE * person.area:
        return None
    rest = (mask.mask & ~here).astype(np.uint8)
    size = max(3, 2 * round(0.5 * MASK_BORDER_PX / step) + 1)
    opened = cv2.morphologyEx(rest, cv2.MORPH_OPEN, np.ones((size, size), np.uint8))
    count, parts, sizes, _ = cv2.connectedComponentsWithStats(opened)
    if count < 2:
        return None
    largest = 1 + int(sizes[1:, cv2.CC_STAT_AREA].argmax())
    left, top, width, height, area = sizes[largest]
    if area < BLOB_MIN_REST_SHARE * mask.area:
        return None
    kept = parts[top : top + height, left : left + width] == largest
    return ReducedMask(mask.x0 + int(left), mask.y0 + int(top), kept)
