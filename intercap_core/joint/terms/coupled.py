"""Rows that several terms add alike: distances of body and object, steps of points."""

from __future__ import annotations

import numpy as np

from intercap_core.energy import stick
from intercap_core.energy.smoothness import RATE
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


def add_steps(
    name: str,
    columns: slice,
    points: np.ndarray,
    rows: np.ndarray,
    weight: np.ndarray,
    outlier: float,
    equations: NormalEquations,
) -> None:
    """Add the steps of points (T, N, 3), metres, from frame to frame, as stiff parts.

    ``rows`` (T, N, 3, m) their derivatives over ``columns``; ``weight`` (T - 1, N), 1/m^2, of each
    step, which counts less towards and beyond ``outlier``, metres.
    """
    frames, count = points.shape[:2]
    step = np.diff(points, axis=0)
    weights, energy = stick.robust(step, weight, outlier)
    equations.add_differences(
        name,
        columns,
        RATE,
        rows.reshape(frames, 3 * count, -1),
        np.repeat(weights, 3, axis=1),
        step.reshape(frames - 1, -1),
        energy,
        tie=True,
    )
