"""Which segmentation candidate of a view shows the object: render, compare and preserve."""

from __future__ import annotations

import numba

from intercap_core.geometry.rigid.shots import Rendering
from intercap_core.object_track.constants import LIKELY_LABEL_BONUS, MIN_RENDERED_PX
from intercap_core.object_track.reduced_mask import ReducedMask
from intercap_core.object_track.view import Candidate, View


def choose(
    view: View, predicted: Rendering, min_overlap: float, labels: tuple[str, ...]
) -> Candidate | None:
    """The candidate of largest overlap with the visible render; likely labels break ties.

    The paper's render-compare-and-preserve; None where no overlap reaches ``min_overlap``.
    """
    best, best_rank = None, 0.0
    if predicted.area < MIN_RENDERED_PX:
        return None
    for candidate in view.candidates:
        overlap = mask_overlap(predicted, candidate.mask, view.person)
        rank = overlap + (LIKELY_LABEL_BONUS if candidate.label in labels else 0.0)
        if overlap >= min_overlap and rank > best_rank:
            best, best_rank = candidate, rank
    return best


def mask_overlap(image: Rendering, mask: ReducedMask, person: ReducedMask) -> float:
    """IoU of a mask and the part of a render that no person outside the mask hides."""
    if not image.meets(mask.x0, mask.y0, *mask.mask.shape):
        return 0.0
    visible, common = _compare(
        image.face, image.x0, image.y0, person.mask, person.x0, person.y0, mask.mask, mask.x0,
        mask.y0,
    )  # fmt: skip
    return common / max(1, visible + mask.area - common)


def visible_pixels(image: Rendering, person: ReducedMask) -> int:
    """How many pixels of a render no person hides."""
    if not image.meets(person.x0, person.y0, *person.mask.shape):
        return image.area
    hidden = _covered(image.face, image.x0, image.y0, person.mask, person.x0, person.y0)
    return image.area - hidden


@numba.njit(cache=True, nogil=True)
def _compare(face, x0, y0, person, px, py, mask, mx, my):
    """Rendered pixels that are visible, and those of them in the mask; origins of each window."""
    visible, common = 0, 0
    for v in range(face.shape[0]):
        own, other = v + y0 - my, v + y0 - py
        for u in range(face.shape[1]):
            if face[v, u] < 0:
                continue
            x = u + x0
            if 0 <= own < mask.shape[0] and 0 <= x - mx < mask.shape[1] and mask[own, x - mx]:
                visible += 1
                common += 1
            elif not (
                0 <= other < person.shape[0]
                and 0 <= x - px < person.shape[1]
                and person[other, x - px]
            ):
                visible += 1
    return visible, common


@numba.njit(cache=True, nogil=True)
def _covered(face, x0, y0, mask, mx, my):
    """Rendered pixels in the mask."""
    count = 0
    for y in range(max(y0, my), min(y0 + face.shape[0], my + mask.shape[0])):
        for x in range(max(x0, mx), min(x0 + face.shape[1], mx + mask.shape[1])):
            if face[y - y0, x - x0] >= 0 and mask[y - my, x - mx]:
                count += 1
    return count
