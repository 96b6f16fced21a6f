"""Silhouette term of the object's energy: lambda_segm || (R_S - S) * S ||^2 of equation 1.

One-sided as in the paper: only mask pixels that the render misses count, so what a hand hides
costs nothing. Each such pixel of the mask's contour pulls the nearest rim point of the render. The
optional background term is the same from the other side: rim points of the render that lie on
known background are pulled to the nearest contour pixel of the mask.
"""

from __future__ import annotations

import cv2
import numpy as np

from intercap_core.camera.intrinsics import Intrinsics

_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


def rim(mask: np.ndarray) -> np.ndarray:
    """Pixels of the mask (h, w) that touch its outside, image borders excepted: (h, w) bool.

    What lies beyond the window's border is taken as the mask going on: a silhouette cut by the
    image's edge has no contour there.
    """
    eroded = cv2.erode(mask.astype(np.uint8), _CROSS, borderType=cv2.BORDER_REPLICATE)
    return mask & (eroded == 0)


class NearestRim:
    """For every pixel of a window, the nearest of a set of rim pixels."""

    def __init__(self, rim_mask: np.ndarray) -> None:
        """``rim_mask`` (h, w) bool, at least one pixel set."""
        self.pixels = np.argwhere(rim_mask)[:, ::-1]  # (R, 2) x, y in row-major order
        source = np.where(rim_mask, 0, 255).astype(np.uint8)
        distance, labels = cv2.distanceTransformWithLabels(
            source, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        self.distance = distance
        self._labels = labels
        self._of_label = np.zeros(int(labels.max()) + 1, np.int64)
        self._of_label[labels[rim_mask]] = np.arange(len(self.pixels))

    def index(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Index (N,) into :attr:`pixels` of the rim pixel nearest to window pixels (N,), (N,)."""
        return self._of_label[self._labels[y, x]]


def residuals(
    points: np.ndarray,
    targets: np.ndarray,
    lens: Intrinsics,
    camera_from_master: np.ndarray,
    origin: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Contour distances (N,) in pixels of ``lens`` and their Jacobian (N, 6).

    ``points`` (N, 3) rim points of the object, master frame, metres, which move with it;
    ``targets`` (N, 2) the image points they should project to; ``origin`` (3,) the object's
    translation. Residual: |projection - target|; its derivative is taken along the line between
    the two (zero where they coincide). Motion and columns as in :mod:`.object_depth`.
    """
    rotation = camera_from_master[:3, :3]
    projected, by_point = lens.project_with_jacobian(
        points @ rotation.T + camera_from_master[:3, 3]
    )
    offset = projected - targets
    distance = np.linalg.norm(offset, axis=1)
    direction = offset / np.maximum(distance, 1e-9)[:, None]
    along = np.einsum("ni,nij->nj", direction, by_point) @ rotation
    return distance, np.concatenate([np.cross(points - origin, along), along], axis=1)
