"""Rows of distances between body and object, which move with both."""

from __future__ import annotations

import numpy as np

from intercap_core.joint.equations import NormalEquations
from intercap_core.joint.geometry import PosedGeometry
from intercap_core.joint.state import ALL


def add_distances(
    name: str,
    posed: PosedGeometry,
    residual: np.ndarray,
    weight: np.ndarray,
    energy: float | None,
    equations: NormalEquations,
) -> None:
    """Add rows of the N skin vertices' distances to the object.

    ``residual`` (T, N) metres, whose derivative is that of the distance wherever ``weight`` (T, N),
    1/m^2, is not 0; ``energy`` that of a robust term, None for plain least squares.
    """
    index = np.flatnonzero(weight.any(axis=0))
    near = posed.proximity
    rows = np.concatenate(
        [posed.skin_by_body(near.normals, index), near.by_object[:, index]], axis=2
    )
    equations.add_rows(name, ALL, rows, weight[:, index], residual[:, index], energy)
