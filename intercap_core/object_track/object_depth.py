"""Depth term of E_O, the object's energy: lambda_depth || (R_D - D) * S ||^2 of equation 1.

R_D is the rendered depth, D the measured one, S the object's mask; lambda_depth is in
:mod:`intercap_core.object_track.view_fit`. Where the paper compares depth along the ray, the
residual here is the same difference taken along the normal of the rendered triangle (point to
plane): the measured point's distance to the plane that the ray hits. It is the depth difference
times the cosine of incidence, so that grazing surfaces do not dominate, and it is linear in small
motions. What a fit runs, compiled and summed, is :mod:`.object_depth_kernel`; this is the plain
form that it is tested against.
"""

from __future__ import annotations

import numpy as np


def residuals(
    observed: np.ndarray, hit: np.ndarray, normals: np.ndarray, origin: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Point-to-plane residuals (N,) in metres and their Jacobian (N, 6).

    ``observed`` (N, 3) measured points, fixed; ``hit`` (N, 3) surface points under the same
    pixels and ``normals`` (N, 3) their unit normals, which move with the object; ``origin`` (3,)
    the object's translation; all in the master frame, metres. Residual: n . (observed - hit),
    positive where the measured surface lies outside the rendered one. The Jacobian is exact for
    the motion X' = exp(w) (X - origin) + origin + d, columns w (rad) then d (m).
    """
    gap = np.einsum("ij,ij->i", normals, observed - hit)
    # d/dw [exp(w) n . (p - X')] = n x (p - X) - (X - o) x n = n x (p - o)
    turn = np.cross(normals, observed - origin)
    return gap, np.concatenate([turn, -normals], axis=1)
