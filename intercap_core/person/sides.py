"""Left and right keypoints: index tables, exchange of sides, and sides stated by the user.

The annotation ``left_right`` lists images in which a detector exchanged the sides. Their keypoints
are exchanged back before all other steps. If the automatic correction
later exchanges them again, its result is reversed in that set (:func:`hold_sides`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.annotation import ExchangedSides
from intercap_core.body.keypoints import BODY, KEYPOINT_INDEX, LEFT_HAND, PARTNER, RIGHT_HAND
from intercap_core.errors import UserError
from intercap_core.geometry.camera.triangulation import Triangulation


def _both_sides(*names: str) -> np.ndarray:
    return np.array(
        [KEYPOINT_INDEX[f"{side}_{name}"] for side in ("left", "right") for name in names]
    )


# Keypoint indices, (2n,): n of the left side, then the same n of the right side.
ARMS = _both_sides("shoulder", "elbow", "wrist")
LEGS = _both_sides("hip", "knee", "ankle", "big_toe", "small_toe", "heel")
HEAD = _both_sides("eye", "ear")
HANDS = np.r_[LEFT_HAND, RIGHT_HAND]
LIMBS: tuple[np.ndarray, ...] = (ARMS, LEGS, HEAD, HANDS)
BODY_POINTS = np.arange(BODY.start, BODY.stop)


def swap_sides(keypoints: np.ndarray) -> np.ndarray:
    """Keypoints (..., 135, n) with left and right exchanged."""
    return keypoints[..., PARTNER, :]


def exchange_points(values: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Values (T, 135, ...) with left and right exchanged for the limbs ``which`` (T, 4) bool."""
    result = values.copy()
    for limb, at in zip(LIMBS, which.T, strict=True):
        rows = np.flatnonzero(at)[:, None]
        result[rows, limb] = values[rows, PARTNER[limb]]
    return result


def exchange_everywhere(
    keypoints: np.ndarray, points: Triangulation, which: np.ndarray
) -> tuple[np.ndarray, Triangulation]:
    """Return keypoints and triangulation with left and right exchanged, in all views of a set.

    Args:
        keypoints: (T, C, 135, n).
        points: triangulation of T * 135 points.
        which: (T, 4) bool, limbs to exchange in each set, in the order of :data:`LIMBS`.
    """
    keypoints = np.swapaxes(exchange_points(np.swapaxes(keypoints, 1, 2), which), 1, 2)
    parts = (points.points, points.inlier, points.error, points.view_error)
    by_set = (part.reshape(len(which), -1, *part.shape[1:]) for part in parts)
    exchanged = (exchange_points(part, which) for part in by_set)
    return keypoints, Triangulation(*(part.reshape(-1, *part.shape[2:]) for part in exchanged))


def exchange_limb(keypoints: np.ndarray, t: np.ndarray, c: np.ndarray, limb: np.ndarray) -> None:
    """Exchange left and right of ``limb`` in N images of ``keypoints`` (T, C, 135, n), in place.

    ``t``, ``c``: (N,) set and camera of each image.
    """
    keypoints[t[:, None], c[:, None], limb] = keypoints[t[:, None], c[:, None], PARTNER[limb]]


def images_with_stated_sides(
    stated: Sequence[ExchangedSides], names: Sequence[str], image_of: np.ndarray, sequence: str
) -> np.ndarray:
    """Mask (T, C) of the images in which the user states that left and right are exchanged.

    Args:
        stated: entries of the annotation; their ranges count recorded frames.
        names: camera names.
        image_of: (T, C) recorded frame whose image shows each moment; -1 = none.
        sequence: name, for messages.

    Raises:
        UserError: an entry names an unknown camera.
    """
    result = np.zeros(image_of.shape, bool)
    for number, sides in enumerate(stated):
        if sides.camera is not None and sides.camera not in names:
            raise UserError(
                f"sequence {sequence}: the annotation's left_right[{number}] names camera "
                f"{sides.camera!r}; the recording has {', '.join(names)}"
            )
        cameras = [sides.camera is None or name == sides.camera for name in names]
        result |= (image_of >= sides.start) & (image_of < sides.end) & np.array(cameras)
    return result


def hold_sides(
    keypoints: np.ndarray, points: Triangulation, given: np.ndarray, stated: np.ndarray
) -> tuple[np.ndarray, Triangulation]:
    """Apply the sides stated by the user to the corrected keypoints and points.

    If the correction exchanged a limb in most of a set's stated images, the limb is exchanged back
    in all views of the set. ``given`` are the keypoints before the correction, with the stated
    sides in the images ``stated`` (T, C) bool.
    """
    wrong = np.zeros((len(keypoints), len(LIMBS)), bool)
    for number, limb in enumerate(LIMBS if stated.any() else ()):
        own, other = keypoints[:, :, limb], swap_sides(given)[:, :, limb]
        same = (own == given[:, :, limb]).all((2, 3))
        exchanged = (own == other).all((2, 3))
        wrong[:, number] = (stated & exchanged & ~same).sum(1) > (stated & same & ~exchanged).sum(1)
    return exchange_everywhere(keypoints, points, wrong) if wrong.any() else (keypoints, points)
