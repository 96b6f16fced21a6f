"""Triangulates the subject's keypoints, with left and right corrected.

1. :func:`steady_sides`: with few views, limbs that jump between the sides are corrected in each
   view by the least image motion.
2. :func:`at_set_times`: keypoints are moved from each camera's exposure to the time of the set.
3. :func:`triangulate_people`: the views of each set are made consistent and the sides of all sets
   are chosen (:mod:`.left_right`). Then a limb of a view is exchanged if that makes its
   reprojection error much lower.
4. :func:`fill_middles`: missing necks and mid hips are computed from shoulders and hips.
"""

from __future__ import annotations

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_INDEX, PARTNER
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.triangulation import (
    Triangulation,
    pixel_scale,
    reproject,
    triangulate,
)
from intercap_core.geometry.solve.time_series import cheapest_sequence, limited_velocity
from intercap_core.person.left_right import find_mirrored, make_views_agree
from intercap_core.person.sides import LIMBS, exchange_everywhere, exchange_limb

# Largest angular speed of a keypoint, rad/s: hands reach 5 m/s in everyday tasks, at two metres
# from the cameras of a ring. Faster jumps in an image are wrong detections. Between two known
# neighbours limited_velocity limits a jump by itself; this limit serves gaps, and jumps in a row.
MAX_IMAGE_SPEED_RAD_S = 2.5


def at_set_times(
    keypoints: np.ndarray,
    times: np.ndarray,
    time_offset: np.ndarray,
    rig: Rig,
    *,
    min_confidence: float,
) -> np.ndarray:
    """Move keypoints (T, C, K, 3) from each camera's exposure to ``times`` (T,).

    Uses the velocity in the image, from neighbouring sets and limited at jumps.

    Args:
        keypoints: (T, C, K, 3) x, y, confidence.
        times: (T,) seconds of the sets.
        time_offset: (C,) seconds from the time of a set to the exposure of each camera.
        min_confidence: keypoints of lower confidence have no velocity.
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
    """Fill a missing (NaN) neck and mid hip of ``points`` (..., 135, 3), in place.

    They become the middles of the shoulders and of the hips, as OpenPose defines them on COCO. Only
    3D points are filled; the initial pose and the volume of the person use them. Keypoints in
    images are not, because the fit would then count errors of shoulders and hips twice.
    """
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
    """Triangulate the subject, with left and right corrected by views, anatomy and motion.

    Args:
        keypoints: (T, C, 135, 3 or more) x, y, confidence, and further values of each point.
        times: (T,) seconds; None = motion from set to set is not evaluated.
        min_confidence: keypoints of lower confidence are ignored.
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
    """Exchange back limbs that jump to the other side for some time, in sets of up to four views.

    For each view and limb, dynamic programming selects the sides of least image motion over all
    sets. With more views, their agreement decides (:mod:`.left_right`).

    Args:
        keypoints: (T, C, 135, 3).
        min_confidence: keypoints of lower confidence have no motion.

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
    """Mask (S,) of the sets that are exchanged in the sequence of least motion.

    Costs are pixels at 1080p, times ``scale``; tuned on the studio.

    Args:
        options: (2, S, n, 3) the limb's keypoints as detected, and with the sides exchanged.
        scale: pixels of the camera per pixel at 1080p.
        min_confidence: keypoints of lower confidence have no motion.
    """
    price = np.array([0.0, 3.0 * scale])  # for each exchanged set: detectors are mostly right
    # For an exchange in the first or last set. It has a single jump, which may also be a fast turn
    # of the body.
    at_an_end = np.array([0.0, 100.0 * scale])
    seen, pixels = options[..., 2] >= min_confidence, options[..., :2]
    # axes: option in the set before, option in this set, S - 1, n
    both = seen[:, None, :-1] & seen[None, :, 1:]
    moved = np.linalg.norm(pixels[:, None, :-1] - pixels[None, :, 1:], axis=-1)
    # a jump counts at most 120 px at 1080p
    moved = np.where(both, np.minimum(moved, 120.0 * scale), 0).sum(-1)
    steps = np.moveaxis(moved / np.maximum(both.sum(-1), 1), 2, 0) + price
    return cheapest_sequence(at_an_end + price, steps, at_an_end).astype(bool)


def _exchange(
    keypoints: np.ndarray, points: np.ndarray, rig: Rig, min_confidence: float, max_error_px: float
) -> bool:
    """Exchange limbs of single images that fit the triangulated points much better afterwards.

    ``keypoints`` (T, C, 135, 3 or more) are changed in place; ``points`` (T, 135, 3) are
    triangulated points, NaN = unknown. Returns whether any limb was exchanged.
    """
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
        # detected > 0.25: the root mean square error is more than half of the limit. The exchange
        # must halve the cost at least. Both are tuned on the studio.
        t, c = np.nonzero((detected > 0.25) & (other < 0.5 * detected))
        exchange_limb(keypoints, t, c, limb)
        exchanged |= len(t) > 0
    return exchanged


def _cost(
    expected: np.ndarray, detected: np.ndarray, valid: np.ndarray, limit: np.ndarray
) -> np.ndarray:
    """Mean squared reprojection error (T, C) of a limb over the squared ``limit``.

    NaN with fewer than two valid points. Errors are truncated at four times the limit: a lower
    bound would give exchanged sides the same cost as other large errors.
    """
    error = np.linalg.norm(expected - detected, axis=-1) / limit
    square = np.where(valid, np.minimum(error, 4.0) ** 2, 0).sum(-1)
    count = valid.sum(-1)
    return np.where(count >= 2, square / np.maximum(count, 1), np.nan)


def _triangulate(
    keypoints: np.ndarray, rig: Rig, min_confidence: float, max_error_px: float
) -> Triangulation:
    """Triangulate keypoints (T, C, 135, 3 or more), weighted by their confidence."""
    points = np.swapaxes(keypoints[..., :3], 1, 2).astype(np.float64)
    by_point = points.reshape(-1, len(rig), 3)
    weights = np.where(by_point[..., 2] >= min_confidence, by_point[..., 2], 0)
    return triangulate(by_point[..., :2], weights, rig, max_error_px=max_error_px)
