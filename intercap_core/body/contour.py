"""The jaw line of the face (dlib's landmarks 0 to 16) as a camera sees it.

It is an outline, so other points of the skin make it as the head turns. SMPL-X files hold a table
of them for every degree of the head's yaw between -39 and 39, as FLAME and SMPLify-X use it;
beyond, the outermost row stays. Within a linearisation the row is held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

CONTOUR_POINTS = 17
_MAX_YAW_DEG = 39
_AXES_OF_TABLE = (1.0, -1.0, -1.0)  # the table's cameras have y up and look along -z


@dataclass(frozen=True)
class FaceContour:
    """Jaw lines as mixtures of vertices: row a for a head turned by -a degrees, 39 + a by a.

    vertex_ids (N,) are all vertices used, ascending; place (79,17,3) where each corner stands among
    them, weights (79,17,3) the corners' shares.
    """

    vertex_ids: np.ndarray
    place: Tensor
    weights: Tensor

    @classmethod
    def build(
        cls,
        faces: np.ndarray,
        contour_faces: np.ndarray,
        contour_barycentric: np.ndarray,
        device: torch.device,
        dtype: torch.dtype,
    ) -> FaceContour:
        """From the file's dynamic landmarks: faces (79,17) and barycentric coordinates."""
        vertex_ids, place = np.unique(faces[contour_faces], return_inverse=True)
        return cls(
            vertex_ids,
            torch.as_tensor(place.reshape(contour_barycentric.shape), device=device),
            torch.as_tensor(contour_barycentric, dtype=dtype, device=device),
        )

    def mix(self, values: Tensor, rows: Tensor) -> Tensor:
        """Of values (B,N,...) at the vertices, those of the jaw lines of rows (B,C): (B,C,17,...).

        Works alike for positions (B,N,3) and for their derivatives (B,N,3,P).
        """
        batch, views = rows.shape
        tail = values.shape[2:]
        each = torch.arange(batch, device=rows.device)[:, None, None, None]
        corners = values[each, self.place[rows]].reshape(batch, views, CONTOUR_POINTS, 3, -1)
        mixed = (self.weights[rows][..., None, :] @ corners)[..., 0, :]
        return mixed.reshape(batch, views, CONTOUR_POINTS, *tail)


def contour_rows(master_from_head: Tensor, camera_from_master: Tensor) -> Tensor:
    """The table's row (B,C) for heads (B,3,3) in cameras (C,3,3), both rotations.

    A head at rest has y up and faces +z; cameras have x right, y down, z forward. The yaw is the
    middle one of the angles about z, y and x (the camera's), as in FLAME's
    `find_dynamic_lmk_idx_and_bcoords`, so neither nodding nor tilting the head changes it:
    tan yaw = -R_20 / |(R_00, R_10)|.
    """
    turn = master_from_head.new_tensor(_AXES_OF_TABLE)[:, None] * camera_from_master
    x_axis = torch.einsum("cij,bj->bci", turn, master_from_head[:, :, 0])
    yaw = torch.atan2(-x_axis[..., 2], torch.hypot(x_axis[..., 0], x_axis[..., 1]))
    degrees = torch.rad2deg(-yaw).round().clamp(-_MAX_YAW_DEG, _MAX_YAW_DEG).long()
    return torch.where(degrees < 0, _MAX_YAW_DEG - degrees, degrees)
