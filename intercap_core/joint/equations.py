"""Normal equations of all frames: block-banded, since accelerations tie three frames together."""

from __future__ import annotations

import numpy as np
import torch

from intercap_core.joint.state import ALL
from intercap_core.solve.banded import BandedSystem


class NormalEquations:
    """Sums weighted J^T J and J^T r of terms.

    ``bands`` (w+1, T, n, n) as in :class:`BandedSystem`, w = 2 or fewer for short recordings,
    ``gradient`` (T, n) and ``energy`` of each term, one half of the weighted sum of squares.
    ``ties`` are stiff parts of the matrix, each over some columns, that are not damped: damping by
    their large diagonal would freeze an object that has to move as one over many frames.
    """

    def __init__(self, frames: int) -> None:
        self.bands = np.zeros((min(3, frames), frames, ALL.stop, ALL.stop))
        self.ties: list[tuple[slice, np.ndarray]] = []
        self.gradient = np.zeros((frames, ALL.stop))
        self.energy: dict[str, float] = {}

    def step(self, damping: float) -> np.ndarray | None:
        """The damped Gauss-Newton step (T, n), or None where the matrix is not definite."""
        damped = BandedSystem(torch.from_numpy(self.bands)).damped(damping).bands
        for columns, tie in self.ties:
            damped[:, :, columns, columns] += torch.from_numpy(tie)
        factor = BandedSystem(damped).factorise()
        if factor is None:
            return None
        return factor.solve(-torch.from_numpy(self.gradient)).numpy()

    @property
    def total(self) -> float:
        """Energy of all terms."""
        return float(sum(self.energy.values()))

    def add_blocks(
        self,
        term: str,
        columns: slice,
        hessian: np.ndarray,
        gradient: np.ndarray,
        energy: float,
    ) -> None:
        """Add ready J^T W J (T, m, m) and J^T W r (T, m) over ``columns`` of every frame."""
        self.bands[0][:, columns, columns] += hessian
        self.gradient[:, columns] += gradient
        self.energy[term] = self.energy.get(term, 0.0) + energy

    def add_rows(
        self,
        term: str,
        columns: slice,
        jacobian: np.ndarray,
        weights: np.ndarray,
        residuals: np.ndarray,
        energy: float | None = None,
    ) -> None:
        """Add rows: ``jacobian`` (T, N, m) over ``columns``, ``weights`` and ``residuals``
        (T, N). ``energy`` is that of a robust term, None for plain least squares."""
        weighted = (jacobian * weights[..., None]).transpose(0, 2, 1)
        self.add_blocks(
            term,
            columns,
            weighted @ jacobian,
            (weighted @ residuals[..., None])[..., 0],
            0.5 * float((weights * residuals**2).sum()) if energy is None else energy,
        )

    def add_differences(
        self,
        term: str,
        columns: slice,
        stencil: tuple[float, ...],
        jacobian: np.ndarray,
        weights: np.ndarray,
        residuals: np.ndarray,
        energy: float,
        *,
        tie: bool = False,
    ) -> None:
        """Add differences of rows over neighbouring frames; ``tie``: to the stiff parts.

        ``stencil`` (w+1,) factors of frames t .. t+w; ``jacobian`` (T, N, m) of the rows' values;
        ``weights`` and ``residuals`` (T-w, N) and ``energy`` of their differences.
        """
        count = len(jacobian) + 1 - len(stencil)
        self.energy[term] = self.energy.get(term, 0.0) + energy
        if count < 1:
            return
        parts = [jacobian[k : k + count] * factor for k, factor in enumerate(stencil)]
        weighted = [(part * weights[..., None]).transpose(0, 2, 1) for part in parts]
        bands = self.bands[:, :, columns, columns]
        if tie:
            bands = np.zeros_like(bands)
            self.ties.append((columns, bands))
        for k, rows in enumerate(weighted):
            self.gradient[k : k + count, columns] += (rows @ residuals[..., None])[..., 0]
            for j in range(k + 1):
                # frame t + k against frame t + j, stored with the earlier one
                bands[k - j, j : j + count] += rows @ parts[j]
