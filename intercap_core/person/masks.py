"""Chooses the subject's candidate mask, by the keypoints inside it rather than by its label."""

from __future__ import annotations

import numpy as np
from pycocotools import mask as coco_mask

from intercap_core.body.keypoints import SKELETON, keypoint_pairs
from intercap_core.errors import UserError
from intercap_core.formats.detections.instance import PERSON_LABEL
from intercap_core.formats.detections.read import Candidate
from intercap_core.geometry.camera.masks import Runs

# (14, 2) indices of the 25 body points. The middles of bones are samples too: wrists and ankles lie
# at a mask's edge, the middle of a limb does not.
BONES = keypoint_pairs(SKELETON)


def choose_mask(
    candidates: list[Candidate], points: np.ndarray, seen: np.ndarray, where: str
) -> bytes:
    """RLE of the subject's candidate in one image; empty if none fits.

    At least half of the subject's points must lie inside the mask. Of several such candidates, the
    one of greatest score is chosen: share of points inside, minus half of the share of the mask
    outside the subject's box, plus 0.15 for the label of a person. The weights are untuned.

    ``points`` (25, 2) are pixels of the body, ``seen`` (25,) the usable ones. Raises UserError,
    with the name ``where`` of the image, if the RLE of a candidate does not decode.
    """
    bones = BONES[seen[BONES].all(1)]
    samples = np.concatenate([points[seen], points[bones].mean(1)])
    if len(samples) < 4:
        return b""
    x, y = np.rint(samples).astype(np.int64).T
    best, best_score = b"", 0.0
    for candidate in candidates:
        try:
            runs = candidate.runs
        except ValueError as error:
            raise UserError(
                f"{where}, candidate {candidate.index} ({candidate.label}): {error}; re-run stage "
                "'detections' for this sequence"
            ) from None
        share = float(runs.sample(x, y).mean())
        if share < 0.5:
            continue
        score = share - 0.5 * _share_outside(runs, samples)
        score += 0.15 * (candidate.label == PERSON_LABEL)
        if score > best_score:
            best, best_score = candidate.rle, score
    return best


def merge_other_candidates(candidates: list[Candidate], person: bytes) -> bytes:
    """RLE of the union of all candidates but the person; empty if there are none.

    Candidates with at least half of their area inside the mask ``person`` are parts of the person
    and left out. The RLEs must be valid, see :func:`choose_mask`.
    """
    if not person or not candidates:
        return b""
    width, height = candidates[0].image_size
    mask = {"size": [height, width], "counts": person}
    others = [
        {"size": [height, width], "counts": candidate.rle}
        for candidate in candidates
        if candidate.rle != person
    ]
    if not others:
        return b""
    # with iscrowd = 1, pycocotools returns intersection over the area of the first mask
    within = coco_mask.iou(others, [mask], [1])[:, 0]
    apart = [other for other, share in zip(others, within, strict=True) if share < 0.5]
    return bytes(coco_mask.merge(apart)["counts"]) if apart else b""


def _share_outside(runs: Runs, samples: np.ndarray) -> float:
    """Share of the mask's area outside the box of ``samples`` (N, 2), px, with a margin.

    The mask is sampled on a grid of at most about 64 x 64 points.
    """
    low, high = samples.min(0), samples.max(0)
    margin = 0.25 * float((high - low).max())  # for hair, soles and clothes; untuned
    x0, y0, width, height = runs.box
    if not width or not height:
        return 1.0
    step = max(1, int(max(width, height) / 64))
    y, x = np.mgrid[y0 : y0 + height : step, x0 : x0 + width : step]
    inside = runs.sample(x, y)
    grid = np.stack([x, y], -1)
    in_box = ((grid >= low - margin) & (grid <= high + margin)).all(-1)
    return float((inside & ~in_box).sum() / max(1, inside.sum()))
