"""Normal equations of all frames: block-banded, since accelerations tie three frames together."""

from __future__ import annotations

import numpy as np

from intercap_core.energy.smoothness import STENCIL
from intercap_core.refine.state import SIZE


class NormalEquations:
    """Sums weighted J^T J and J^T r of terms.

    ``diagonal`` (T, n, n), ``first`` (T-1, n, n) the blocks (t, t+1), ``second`` (T-2, n, n) the
    blocks (t, t+2), ``gradient`` (T, n) and ``energy`` of each term, one half of the weighted sum
    of squares.
    """

    def __init__(self, frames: int) -> None:
        self.diagonal = np.zeros((frames, SIZE, SIZE))
        self.first = np.zeros((max(frames - 1, 0), SIZE, SIZE))
        self.second = np.zeros((max(frames - 2, 0), SIZE, SIZE))
        self.gradient = np.zeros((frames, SIZE))
        self.energy: dict[str, float] = {}

    @property
    def total(self) -> float:
        """Energy of all terms."""
        return float(sum(self.energy.values()))

    def add_blocks(
        self, term: str, columns: slice, hessian: np.ndarray, gradient: np.ndarray, energy: float
    ) -> None:
        """Add ready J^T W J (T, m, m) and J^T W r (T, m) over ``columns`` of every frame."""
        self.diagonal[:, columns, columns] += hessian
        self.gradient[:, columns] += gradient
        self.energy[term] = self.energy.get(term, 0.0) + energy

    def add_rows(
        self,
        term: str,
        columns: slice,
        jacobian: np.ndarray,
        weights: np.ndarray,
        residuals: np.ndarray,
    ) -> None:
        """Add rows: ``jacobian`` (T, N, m) over ``columns``, ``weights`` and ``residuals``
        (T, N)."""
        weighted = (jacobian * weights[..., None]).transpose(0, 2, 1)
        self.add_blocks(
            term,
            columns,
            weighted @ jacobian,
            (weighted @ residuals[..., None])[..., 0],
            0.5 * float((weights * residuals**2).sum()),
        )

    def add_accelerations(
        self,
        term: str,
        columns: slice,
        jacobian: np.ndarray,
        weights: np.ndarray,
        residuals: np.ndarray,
        scale: float,
    ) -> None:
        """Add second differences of rows: ``jacobian`` (T, N, m) of the rows' values, ``weights``
        (T-2, N) and ``residuals`` (T-2, N) of their differences times ``scale``."""
        if len(jacobian) < 3:
            self.energy.setdefault(term, 0.0)
            return
        count = len(jacobian) - 2
        parts = [jacobian[k : k + count] * (STENCIL[k] * scale) for k in range(3)]
        weighted = [(part * weights[..., None]).transpose(0, 2, 1) for part in parts]
        for k in range(3):
            at = slice(k, k + count)
            self.diagonal[at, columns, columns] += weighted[k] @ parts[k]
            self.gradient[at, columns] += (weighted[k] @ residuals[..., None])[..., 0]
        for k in range(2):
            self.first[k : k + count, columns, columns] += weighted[k] @ parts[k + 1]
        self.second[:count, columns, columns] += weighted[0] @ parts[2]
        energy = 0.5 * float((weights * residuals**2).sum())
        self.energy[term] = self.energy.get(term, 0.0) + energy
