"""What the joint problem is a sum of: one term of equation 6, or one that goes beyond it.

Rows that several terms add alike: distances of body and object, steps of points.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np

from intercap_core.joint.equations import RATE, NormalEquations, Rows
from intercap_core.joint.geometry import PosedGeometry
from intercap_core.joint.proximity import Proximity, along_by_object
from intercap_core.joint.state import ALL, State


class Term(ABC):
    """One part of the joint energy.

    ``name`` is what its energy is called in joint.h5; E_G and E_G' share one. What stays fixed
    while the energy is minimised is held by the term and taken anew by :meth:`refresh`.
    """

    name: str

    def refresh(self, state: State) -> None:  # noqa: B027  most terms hold nothing
        """Take anew at ``state`` what is held during a round; nothing for most terms."""

    @abstractmethod
    def add(self, state: State, equations: NormalEquations) -> None:
        """Add the term's energy and its Gauss-Newton equations, linearised at ``state``."""


def weigh_steps(
    rate: np.ndarray, weight: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Geman-McClure weights (T, N) and energies (T,) of rates (T, N, 3) that have ``weight``
    (T, N): what slides faster than ``scale`` truly slides."""
    square = np.square(rate).sum(2)
    share = scale**2 / (scale**2 + square)
    return weight * share**2, 0.5 * (weight * square * share).sum(axis=1)


def add_distances(
    name: str,
    posed: PosedGeometry,
    near: Proximity,
    residual: np.ndarray,
    weight: np.ndarray,
    energy: np.ndarray | None,
    equations: NormalEquations,
) -> None:
    """Add rows of the N skin vertices' distances ``near`` to the object.

    ``residual`` (T, N) metres, whose derivative is that of the distance wherever ``weight`` (T, N),
    1/m^2, is not 0; ``energy`` (T,) that of a robust term, None for plain least squares.
    """

    def rows(frames: slice, index: np.ndarray) -> np.ndarray:
        normals, skin = near.normals[frames, index], posed.skin[frames, index]
        by_body = posed.skin_by_body(frames, index, normals[:, :, None])
        by_object = -along_by_object(skin, normals, posed.state.translation[frames])
        return np.concatenate([by_body, by_object[:, :, None]], axis=3)

    equations.add_rows(name, ALL, rows, weight, residual[..., None], energy)


def add_steps(
    name: str,
    columns: slice,
    points: np.ndarray,
    rows: Rows,
    weight: np.ndarray,
    outlier: float,
    equations: NormalEquations,
) -> None:
    """Add the steps of points (T, N, 3), metres, from frame to frame, as stiff parts.

    ``rows`` are their derivatives over ``columns``; ``weight`` (T - 1, N), 1/m^2, of each step,
    which counts less towards and beyond ``outlier``, metres.
    """
    step = np.diff(points, axis=0)
    weights, energy = weigh_steps(step, weight, outlier)
    equations.add_rows(name, columns, rows, weights, step, energy, stencil=RATE, stiff=True)
