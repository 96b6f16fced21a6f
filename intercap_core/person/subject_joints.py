"""Triangulates the subject's keypoints, with left and right corrected.

1. :func:`steady_sides`: with few views, limbs that jump between the sides are corrected in each
   view by the least image motion.
2. :func:`at_set_times`: keypoints are moved from each camera's exposure to the time of the set.
3. :func:`triangulate_people`: the views of each set are made consistent, the sides of all sets are
   chosen (:mod:`.left_right`), then a limb of a view counts as exchanged if its reprojection error
   is much lower with the sides exchanged.
4. :func:`fill_middles`: neck and mid hip from shoulders and hips.
"""

from __future__ import annotations

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.triangulation import (
    Triangulation,
    pixel_scale,
    reproject,
    triangulate,
)
from intercap_core.geometry.solve.time_series import cheapest_sequence, limited_velocity
from intercap_core.person.left_right import find_mirrored, make_views_agree
from intercap_core.person.sides import LIMBS, PARTNER, exchange_everywhere, exchange_limb

# Hands reach 5 m/s in everyday tasks, and people stand two metres from the cameras of a ring:
# faster motion in an image is another detection. Radians per second.
MAX_IMAGE_SPEED_RAD_S = 2.5
MUCH_BETTER = 0.5  # cost exchanged over cost as detected, at most; tuned on the studio


def at_set_times(
    keypoints: np.ndarray,
    times: np.ndarray,
    time_offset: np.ndarray,
    rig: Rig,
    *,
    min_confidence: float,
) -> np.ndarray:
    """Move keypoints (T, C, K, 3) from each camera's exposure to ``times`` (T,).

    Uses the velocity in the image, from neighbouring sets and limited at jumps. ``time_offset``:
    (C,) seconds by which cameras expose late.
    """
    result = keypoints.copy()
    known = keypoints[..., 2] >= min_confidence
    for c in np.flatnonzero(time_offset):
        speed = MAX_IMAGE_SPEED_RAD_S * rig[int(c)].colour.fx
        seen = keypoints[:, c, :, :2]
        velocity = limited_velocity(seen, times, max_speed=speed, known=known[:, c])
        result[:, c, :, :2] = seen - time_offset[c] * velocity
    return result


def fill_middles(points: np.ndarray) -> None:
    """Fill a missing neck and mid hip of ``points`` (..., 135, 3), in place, by shoulders and hips.

    Only in space: the initial pose and the volume of the body use these points. The fit uses
    keypoints in images, where they would count the errors of shoulders and hips twice.
    """
    # OpenPose learnt both points as these middles of COCO's
    for middle, end in (("neck", "shoulder"), ("mid_hip", "hip")):
        at = points[..., KEYPOINT_INDEX[middle], :]
        ends = [KEYPOINT_INDEX[f"left_{end}"], KEYPOINT_INDEX[f"right_{end}"]]
        at[...] = np.where(np.isnan(at), points[..., ends, :].mean(-2), at)


def triangulate_people(
    keypoints: np.ndarray,
    rig: Rig,
    times: np.ndarray | None = None,
    *,
    min_confidence: float,
    max_error_px: float,
) -> tuple[np.ndarray, Triangulation]:
    """Triangulate the subject, with sides exchanged by views, build or motion.

    Args:
        keypoints: (T, C, 135, 3 or more) x, y, confidence, and further values of each point.
        times: (T,) seconds; None = motion from set to set is not evaluated.
        min_confidence: keypoints below are ignored.
        max_error_px: largest reprojection error of an inlier, px at 1080p.

    Returns:
        The keypoints with corrected sides, and the triangulation of T * 135 points.
    """
    keypoints = keypoints.copy()
    agreed = make_views_agree(keypoints, rig, min_confidence=min_confidence)
    triangulation = _triangulate(keypoints, rig, min_confidence, max_error_px)
    seeing = np.stack(
        [(keypoints[:, :, limb, 2] >= min_confidence).any(2).sum(1) for limb in LIMBS], 1
    )
    share = agreed.sum(1) / np.maximum(seeing, 1)
    turned = find_mirrored(triangulation.points.reshape(len(keypoints), -1, 3), share[:, :3], times)
    if turned.any():
        keypoints, triangulation = exchange_everywhere(keypoints, triangulation, turned)
    for _ in range(2):
        points = triangulation.points.reshape(len(keypoints), -1, 3)
        if not _exchange(keypoints, points, rig, min_confidence, max_error_px):
            break
        triangulation = _triangulate(keypoints, rig, min_confidence, max_error_px)
    return keypoints, triangulation


def steady_sides(keypoints: np.ndarray, rig: Rig, *, min_confidence: float) -> np.ndarray:
    """Exchange back limbs that jump to the other side for a while, in sets with up to four views.

    Each view and limb is considered on its own: dynamic programming selects the sides that move
    least over all sets.

    Args:
        keypoints: (T, C, 135, 3).

    Returns:
        (T, C, 135, 3) keypoints with corrected sides.
    """
    result = keypoints.copy()
    few = (keypoints[..., 2] > 0).any(2).sum(1) <= 4  # tuned on the studio
    for c, scale in enumerate(pixel_scale(rig)):
        sets = np.flatnonzero((keypoints[:, c, :, 2] > 0).any(1))
        if len(sets) < 3 or not few[sets].any():
            continue
        for limb in LIMBS:
            options = np.stack([keypoints[sets, c][:, side] for side in (limb, PARTNER[limb])])
            wrong = sets[_least_motion(options, scale, min_confidence)]
            wrong = wrong[few[wrong]]
            exchange_limb(result, wrong, np.full(len(wrong), c), limb)
    return result


def _least_motion(options: np.ndarray, scale: float, min_confidence: float) -> np.ndarray:
    """Sets (S,) bool in which the second of the limb's ``options`` (2, S, n, 3) moves less.

    Costs are pixels at 1080p, tuned on the studio.
    """
    price = np.array([0.0, 3.0 * scale])  # of an exchanged set: detectors are mostly right
    # at the start or end of the recording an exchange has only one jump, as a fast turn
    at_an_end = np.array([0.0, 100.0 * scale])
    seen, pixels = options[..., 2] >= min_confidence, options[..., :2]
    # (before, now, S - 1, n)
    both = seen[:, None, :-1] & seen[None, :, 1:]
    moved = np.linalg.norm(pixels[:, None, :-1] - pixels[None, :, 1:], axis=-1)
    moved = np.where(both, np.minimum(moved, 120.0 * scale), 0).sum(-1)
    steps = np.moveaxis(moved / np.maximum(both.sum(-1), 1), 2, 0) + price
    return cheapest_sequence(at_an_end + price, steps, at_an_end).astype(bool)


def _exchange(
    keypoints: np.ndarray, points: np.ndarray, rig: Rig, min_confidence: float, max_error_px: float
) -> bool:
    """Exchange in place the limbs of ``keypoints`` (T, C, 135, 3 or more) that fit ``points``
    (T, 135, 3) much better the other way. Returns whether there are any."""
    sets, views = keypoints.shape[:2]
    known = np.isfinite(points[..., 0])
    pixels = reproject(np.nan_to_num(points.reshape(-1, 3), nan=1.0), rig)
    pixels = np.swapaxes(pixels.reshape(sets, -1, views, 2), 1, 2)  # (T, C, 135, 2)
    limit = max_error_px * pixel_scale(rig)[:, None]
    seen = keypoints[..., 2] >= min_confidence
    exchanged = False
    for limb in LIMBS:
        detected, other = (
            _cost(
                pixels[:, :, limb],
                keypoints[:, :, side, :2],
                known[:, None, limb] & seen[:, :, side],
                limit,
            )
            for side in (limb, PARTNER[limb])
        )
        # half of the limb's points are off by the limit or more
        t, c = np.nonzero((detected > 0.25) & (other < MUCH_BETTER * detected))
        exchange_limb(keypoints, t, c, limb)
        exchanged |= len(t) > 0
    return exchanged


def _cost(
    expected: np.ndarray, detected: np.ndarray, valid: np.ndarray, limit: np.ndarray
) -> np.ndarray:
    """Mean truncated squared error (T, C) in units of the limit; NaN with fewer than two points.

    Truncated well beyond the limit, so that exchanged sides differ from other errors.
    """
    error = np.linalg.norm(expected - detected, axis=-1) / limit
    square = np.where(valid, np.minimum(error, 4.0) ** 2, 0).sum(-1)
    count = valid.sum(-1)
    return np.where(count >= 2, square / np.maximum(count, 1), np.nan)


def _triangulate(
    keypoints: np.ndarray, rig: Rig, min_confidence: float, max_error_px: float
) -> Triangulation:
    points = np.swapaxes(keypoints[..., :3], 1, 2).astype(np.float64)
    by_point = points.reshape(-1, len(rig), 3)
    weights = np.where(by_point[..., 2] >= min_confidence, by_point[..., 2], 0)
    return triangulate(by_point[..., :2], weights, rig, max_error_px=max_error_px)
