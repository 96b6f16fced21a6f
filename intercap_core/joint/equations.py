"""Normal equations of all frames: block-banded, since accelerations tie three frames together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from intercap_core.joint.state import ALL
from intercap_core.solve.banded import BandedSystem

# Derivatives (F, K, R, m) of K of a term's N values, R numbers each, in the F frames of a slice.
Rows = Callable[[slice, np.ndarray], np.ndarray]

# Rows are made for so many frames at a time: few enough that they stay in the cache.
_FRAMES_TOGETHER = 8
# Values of less weight than this share of their term's largest change nothing: the tail of a
# Gaussian over a contact patch would have a row of each of its vertices.
_NEGLIGIBLE = 1e-12


class NormalEquations:
    """Sums weighted J^T J and J^T r of terms.

    ``bands`` (w+1, T, n, n) as in :class:`BandedSystem`, w = 2 or fewer for short recordings,
    ``gradient`` (T, n) and ``energy`` of each term, one half of the weighted sum of squares.
    ``damped`` (T, n) is the diagonal without its stiff parts: damping by their large values would
    freeze an object that has to move as one over many frames.
    """

    def __init__(self, frames: int) -> None:
        self.bands = np.zeros((min(3, frames), frames, ALL.stop, ALL.stop))
        self.damped = np.zeros((frames, ALL.stop))
        self.gradient = np.zeros((frames, ALL.stop))
        self.energy: dict[str, float] = {}

    def step(self, damping: float) -> np.ndarray | None:
        """The damped Gauss-Newton step (T, n), or None where the matrix is not definite."""
        matrix = torch.tensor(self.bands)
        matrix[0].diagonal(dim1=1, dim2=2).add_(torch.from_numpy(damping * self.damped))
        factor = BandedSystem(matrix).factorise(in_place=True)
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
        self.damped[:, columns] += hessian.diagonal(axis1=1, axis2=2)
        self.gradient[:, columns] += gradient
        self.energy[term] = self.energy.get(term, 0.0) + energy

    def add_rows(
        self,
        term: str,
        columns: slice,
        rows: Rows,
        weights: np.ndarray,
        residuals: np.ndarray,
        energy: float | None = None,
        *,
        stencil: tuple[float, ...] = (1.0,),
        stiff: bool = False,
    ) -> None:
        """Add values, or their differences over neighbouring frames; ``stiff``: not damped.

        ``rows`` derive the values by ``columns``, ``stencil`` (w+1,) are the factors of frames
        t .. t+w; ``weights`` (T-w, N) and ``residuals`` (T-w, N, R) are those of the differences.
        ``energy`` is that of a robust term, None for plain least squares.
        """
        if energy is None:
            energy = 0.5 * float((weights[..., None] * residuals**2).sum())
        self.energy[term] = self.energy.get(term, 0.0) + energy
        frames, ahead = len(self.gradient), len(stencil) - 1
        if frames <= ahead:
            return
        forces = _over_stencil(stencil, weights[..., None] * residuals)
        # of the values of frame t with those of frames t, t + 1, ..
        couplings = [
            _over_stencil([f * g for f, g in zip(stencil, stencil[d:], strict=False)], weights)
            for d in range(ahead + 1)
        ]
        counts = couplings[0] > _NEGLIGIBLE * couplings[0].max(initial=0.0)
        for start in range(0, frames, _FRAMES_TOGETHER):
            stop = min(start + _FRAMES_TOGETHER, frames)
            last = min(stop + ahead, frames)
            used = np.flatnonzero(counts[start:last].any(axis=0))
            if not len(used):
                continue
            jacobian = rows(slice(start, last), used)
            size = jacobian.shape[2]
            jacobian = jacobian.reshape(last - start, -1, jacobian.shape[3])
            force = forces[start:stop, used].reshape(stop - start, 1, -1)
            self.gradient[start:stop, columns] += (force @ jacobian[: stop - start])[:, 0]
            for d, coupling in enumerate(couplings):
                here = slice(start, min(stop, frames - d))
                count = max(here.stop - here.start, 0)
                weighted = np.repeat(coupling[here, used], size, axis=1)[..., None]
                block = (jacobian[d : d + count] * weighted).transpose(0, 2, 1) @ jacobian[:count]
                self.bands[d, here, columns, columns] += block
                if d == 0 and not stiff:
                    self.damped[here, columns] += block.diagonal(axis1=1, axis2=2)


def _over_stencil(factors: Sequence[float], values: np.ndarray) -> np.ndarray:
    """Sum over k of ``factors`` (k,) times ``values`` (T - w, ...) of k frames before."""
    out = np.zeros((len(values) + len(factors) - 1, *values.shape[1:]))
    for k, factor in enumerate(factors):
        out[k : k + len(values)] += factor * values
    return out
