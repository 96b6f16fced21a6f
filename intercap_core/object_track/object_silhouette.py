"""Silhouette term of E_O, the object's energy: lambda_segm || (R_S - S) * S ||^2 of equation 1.

R_S is the rendered mask, S the detected one; lambda_segm is in
:mod:`intercap_core.object_track.view_fit`. One-sided as in the paper: only mask pixels that the
render misses count, so what a hand hides costs nothing. Each such pixel of the mask's contour pulls
the nearest rim point of the render. Beyond the paper, the optional background term is the same from
the other side: rim points of the render that lie on known background are pulled to the nearest
contour pixel of the mask. What a fit runs, compiled and summed, is
:mod:`.object_silhouette_kernel`; this is the plain form that it is tested against.
"""

from __future__ import annotations

import cv2
import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics

_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


def rim(mask: np.ndarray) -> np.ndarray:
    """Pixels of the mask (h, w) that touch its outside, image borders excepted: (h, w) bool.

    What lies beyond the window's border is taken as the mask going on: a silhouette cut by the
    image's edge has no contour there.
    """
    eroded = cv2.erode(mask.astype(np.uint8), _CROSS, borderType=cv2.BORDER_REPLICATE)
    return mask & (eroded == 0)


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
