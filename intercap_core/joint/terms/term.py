"""Base class of the terms of the joint energy, and equations that several terms share.

A term states its equation and its settings, and is listed in ``TERMS`` of
:mod:`intercap_core.joint.problem`. ``docs/extending.md`` shows a complete example.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar, TypeVar

import numpy as np

from intercap_core.body.lemo import MotionEncoder
from intercap_core.config import JointSettings
from intercap_core.joint.equations import RATE, BandedEquations, Rows
from intercap_core.joint.floor import FloorPlane
from intercap_core.joint.geometry import Geometry, PosedGeometry
from intercap_core.joint.proximity import Proximity, along_by_object
from intercap_core.joint.sequential import Trust
from intercap_core.joint.state import ALL, State

SLIP_OUTLIER = 0.15  # slip that counts a quarter, m/s, above the fits' jitter; tuned on the studio

T = TypeVar("T", bound="JointTerm")


class Data(StrEnum):
    """Data that not every recording has."""

    OBJECT = "object"
    FLOOR = "floor"


@dataclass(frozen=True, kw_only=True)
class Equation:
    """A term's row in the table of docs/equations.md, which `intercap dev docs` generates."""

    symbol: str
    """The paper's symbol, or a name if the paper has none."""
    source: str
    """Equation number in the paper (``A.n`` of its appendix), or "beyond"."""
    formula: str
    """Formula, in Markdown."""
    settings: tuple[str, ...] = ()
    """Fields of ``JointSettings`` that weigh or select the term."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TermContext:
    """Inputs of the terms' constructors: start of the fit, settings, data of the recording."""

    geometry: Geometry
    """Meshes of body and object; terms share one instance."""
    settings: JointSettings
    """Settings of the joint fit, weights of terms among them."""
    start: State
    """The sequential fits, at which the joint fit starts."""
    trust: Trust
    """Frames in which the sequential fits are trusted."""
    fps: float
    """Frames per second."""
    floor: FloorPlane | None = None
    """The floor; None if the scene has none, or if the sequential fits contradict it."""
    encoder: MotionEncoder | None = None
    """LEMO's motion encoder, if the settings name its weights."""
    up: np.ndarray | None = None
    """Unit vector (3,) against gravity in the master frame; None if the scene has no floor."""
    terms: list[JointTerm] = field(default_factory=list)
    """Terms that have been built so far."""

    def has(self, data: Data) -> bool:
        """Whether the recording has these data."""
        return self.geometry.has_object if data == Data.OBJECT else self.floor is not None

    def find(self, kind: type[T]) -> T:
        """The term of this class, which precedes the caller in ``TERMS``."""
        return next(term for term in self.terms if isinstance(term, kind))


class JointTerm(ABC):
    """One part of the joint energy.

    Each residual is divided by the standard deviation of its measurement, so that a weight of 1
    means "as strong as its evidence". Quantities that stay fixed during a round of minimisation
    (correspondences, robust weights) are attributes that :meth:`refresh` computes.
    """

    name: ClassVar[str]
    """Name of its energy in joint.h5. Terms of the same name share one entry."""
    equation: ClassVar[Equation]
    """Its row in docs/equations.md."""
    needs: ClassVar[frozenset[Data]] = frozenset()
    """Data without which the term is left out."""

    def __init__(self, context: TermContext) -> None:
        """Read settings and constant data from ``context``."""
        self.geometry = context.geometry

    @classmethod
    def applies(cls, context: TermContext) -> bool:
        """Whether the term is part of the energy of this recording."""
        return all(context.has(data) for data in cls.needs)

    def refresh(self, state: State) -> None:  # noqa: B027  most terms hold nothing fixed
        """Compute at ``state`` what stays fixed during the next round of minimisation."""

    @abstractmethod
    def add(self, state: State, equations: BandedEquations) -> None:
        """Add the energy and its Gauss-Newton equations, linearised at ``state``."""

    def add_distances(
        self,
        posed: PosedGeometry,
        near: Proximity,
        residual: np.ndarray,
        weight: np.ndarray,
        equations: BandedEquations,
        energy: np.ndarray | None = None,
    ) -> None:
        """Add rows of the distances of the N skin samples to the object.

        Args:
            near: the distances and their derivatives.
            residual: (T, N) metres; where ``weight`` > 0 its derivative is that of the distance.
            weight: (T, N) 1/m^2.
            energy: (T,) energy of a robust term; None for plain least squares.
        """

        def rows(frames: slice, index: np.ndarray) -> np.ndarray:
            normals, skin = near.normals[frames, index], posed.skin[frames, index]
            by_body = posed.skin_by_body(frames, index, normals[:, :, None])
            by_object = -along_by_object(skin, normals, posed.state.translation[frames])
            return np.concatenate([by_body, by_object[:, :, None]], axis=3)

        equations.add_rows(self.name, ALL, rows, weight, residual[..., None], energy)

    def add_steps(
        self,
        columns: slice,
        points: np.ndarray,
        rows: Rows,
        weight: np.ndarray,
        outlier: float | np.ndarray,
        equations: BandedEquations,
    ) -> None:
        """Add the displacements of points from frame to frame (Geman-McClure), undamped.

        Args:
            points: (T, N, 3) metres.
            rows: derivatives of the points by the unknowns ``columns``.
            weight: (T - 1, N) 1/m^2 of each displacement.
            outlier: displacement at which a point counts a quarter, metres; of all or each (N,).
        """
        step = np.diff(points, axis=0)
        square = np.square(step).sum(2)
        share = outlier**2 / (outlier**2 + square)
        energy = 0.5 * (weight * square * share).sum(axis=1)
        weights = weight * share**2
        equations.add_rows(
            self.name, columns, rows, weights, step, energy, stencil=RATE, stiff=True
        )
