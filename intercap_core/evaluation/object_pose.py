"""Errors of an object's pose against the true pose."""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.solve.robust import MEDIAN_CHI_3

# A pose with a larger error of either kind is lost (docs/evaluation.md).
LOST_TRANSLATION_M = 0.050
LOST_ROTATION_DEG = 20.0


def posed_point(rotation: np.ndarray, translation: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Position (..., 3) of the object's point (3,) under poses (..., 3, 3), (..., 3)."""
    return rotation @ point + translation


def lost(translation_error_m: np.ndarray, rotation_error_degrees: np.ndarray) -> np.ndarray:
    """Mask (...) of lost poses: errors above 50 mm or 20 degrees.

    Errors are infinite if the object exists and no stage found it.
    """
    return (translation_error_m > LOST_TRANSLATION_M) | (rotation_error_degrees > LOST_ROTATION_DEG)


def first_seen_found(
    translation_error_m: np.ndarray, rotation_error_degrees: np.ndarray, views: np.ndarray
) -> bool | None:
    """Whether the error is below 20 mm and 10 degrees in the first frame that shows the object.

    None if no camera ever sees the object.

    Args:
        translation_error_m, rotation_error_degrees: (T,).
        views: (T,) number of cameras that see the object.
    """
    seen = np.flatnonzero(views > 0)
    if len(seen) == 0:
        return None
    first = seen[0]
    return bool(translation_error_m[first] < 0.020 and rotation_error_degrees[first] < 10.0)


def normalised_translation_error(
    translation: np.ndarray, true_translation: np.ndarray, covariance: np.ndarray
) -> np.ndarray:
    """Mahalanobis length (T,) of the translation error, divided by its expected median.

    The median of the result is 1 if the covariance is calibrated. NaN if the covariance is not
    positive definite.

    Args:
        translation, true_translation: (T, 3) metres.
        covariance: (T, 6, 6) of rotation vector (rad) and translation (m), in this order.
    """
    block = covariance[:, 3:, 3:]
    error = translation - true_translation
    length = np.full(len(error), np.nan)
    known = np.isfinite(block).all((1, 2))
    known[known] = np.linalg.eigvalsh(block[known])[:, 0] > 0
    solved = np.linalg.solve(block[known], error[known][..., None])[..., 0]
    length[known] = np.sqrt(np.einsum("ti,ti->t", error[known], solved))
    return length / MEDIAN_CHI_3
