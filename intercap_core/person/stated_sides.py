"""Left and right of the subject as a person states them (annotation ``left_right``).

A detector that took a back for a front names the left side right. What is stated is exchanged back
before anything is made of the keypoints, and decides in the end which side of its set is the left.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.config import ExchangedSides
from intercap_core.errors import UserError
from intercap_core.geometry.camera.triangulation import Triangulation
from intercap_core.person.sides import LIMBS, exchange_points, swapped


def stated_images(
    stated: Sequence[ExchangedSides], names: Sequence[str], image_of: np.ndarray, sequence: str
) -> np.ndarray:
    """The moments' images (T, C) bool in which left and right are stated to be exchanged.

    ``names`` of the cameras, ``image_of`` (T, C) of the scene artefact: the frame whose image shows
    each moment. Raises UserError, naming the entry, for an unknown camera.
    """
    found = np.zeros(image_of.shape, bool)
    for number, sides in enumerate(stated):
        if sides.camera is not None and sides.camera not in names:
            raise UserError(
                f"sequence {sequence}: the annotation's left_right[{number}] names camera "
                f"{sides.camera!r}; the recording has {', '.join(names)}"
            )
        cameras = [sides.camera is None or name == sides.camera for name in names]
        found |= (image_of >= sides.start) & (image_of < sides.end) & np.array(cameras)
    return found


def exchanged_back(keypoints: np.ndarray, stated: np.ndarray) -> np.ndarray:
    """Keypoints (T, C, 135, n) with left and right exchanged in the images ``stated`` (T, C)."""
    return np.where(stated[..., None, None], swapped(keypoints), keypoints)


def hold_sides(
    keypoints: np.ndarray, points: Triangulation, given: np.ndarray, stated: np.ndarray
) -> tuple[np.ndarray, Triangulation]:
    """The subject with the sides of the images ``stated`` (T, C): in sets in which most of these
    had a limb exchanged, it is exchanged again in all views.

    ``keypoints`` (T, C, 135, 3) and the triangulation of T * 135 ``points`` as they were found from
    the keypoints ``given`` (T, C, 135, 3).
    """
    count = len(keypoints)
    wrong = np.zeros((count, len(LIMBS)), bool)
    for number, limb in enumerate(LIMBS):
        own, other = keypoints[:, :, limb], swapped(given)[:, :, limb]
        same = (own == given[:, :, limb]).all((2, 3))
        exchanged = (own == other).all((2, 3))
        wrong[:, number] = (stated & exchanged & ~same).sum(1) > (stated & same & ~exchanged).sum(1)
    if not wrong.any():
        return keypoints, points
    keypoints = np.swapaxes(exchange_points(np.swapaxes(keypoints, 1, 2), wrong), 1, 2)
    parts = (points.points, points.inlier, points.error, points.view_error)
    return keypoints, Triangulation(
        *(
            exchange_points(part.reshape(count, -1, *part.shape[1:]), wrong).reshape(part.shape)
            for part in parts
        )
    )
