"""Normal equations of all frames: block-banded, since accelerations couple three frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from intercap_core.geometry.solve.banded import solve_banded
from intercap_core.geometry.solve.thread_pool import ThreadPool
from intercap_core.joint.state import ALL

ACCELERATION = (1.0, -2.0, 1.0)  # stencil over frames t, t+1, t+2
RATE = (-1.0, 1.0)  # stencil over frames t, t+1

Rows = Callable[[slice, np.ndarray], np.ndarray]
"""Function (frames, index) that returns the Jacobian (F, K, R, m) of some of a term's values.

``frames`` is a slice of F frames, ``index`` (K,) selects among the term's N values (for example
points). Each value has R components, and m is the number of unknowns on which it depends.
"""


class BandedEquations:
    """Sums of weighted J^T J and J^T r of all terms, by the n = 174 unknowns of T frames.

    Attributes:
        bands: (w+1, T, n, n) blocks of J^T J as in :func:`solve_banded`: ``bands[d, t]`` couples
            frame t + d with frame t. w = 2, less for recordings of one or two frames.
        damped: (T, n) diagonal of J^T J to which the damping is relative. It omits stiff rows:
            damping by their large values would freeze an object that has to move as one over many
            frames.
        gradient: (T, n) J^T r.
        energies_only: whether all but ``energies`` stays 0.
        energies: (T,) of each term, one half of the weighted sum of squares; the energy of a
            difference between frames is divided equally among them.
    """

    def __init__(
        self, frames: int, threads: ThreadPool | None = None, *, energies_only: bool = False
    ) -> None:
        """Start with zeros.

        Args:
            frames: number T of frames.
            threads: compute rows, a few frames each; None for one thread.
            energies_only: compute no derivatives; all but ``energies`` stays 0.
        """
        self._threads, self.energies_only = threads or ThreadPool(), energies_only
        self.bands = np.zeros((min(3, frames), 0 if energies_only else frames, ALL.stop, ALL.stop))
        self.damped = np.zeros((frames, ALL.stop))
        self.gradient = np.zeros((frames, ALL.stop))
        self.energies: dict[str, np.ndarray] = {}

    def copy(self, bands: np.ndarray | None = None) -> BandedEquations:
        """A copy, in the memory ``bands`` if given: allocation takes half of the time."""
        made = BandedEquations(0, self._threads)
        made.bands = np.empty_like(self.bands) if bands is None else bands
        made.bands[...], made.damped = self.bands, self.damped.copy()
        made.gradient, made.energies = self.gradient.copy(), dict(self.energies)
        return made

    @property
    def is_spent(self) -> bool:
        """Whether ``bands`` were consumed by a solution, or never computed."""
        return not self.bands.size

    def step(self, damping: np.ndarray) -> np.ndarray | None:
        """The Gauss-Newton step (T, n), or None if the matrix is not positive definite.

        See :meth:`solve` for ``damping``.
        """
        step = self.solve(damping, -self.gradient[..., None])
        return None if step is None else step[..., 0]

    def solve(self, damping: np.ndarray, right: np.ndarray) -> np.ndarray | None:
        """The solutions for k right-hand sides (T, n, k); None as in :meth:`step`.

        ``damping`` (T,) times ``damped`` is added to the diagonal. The solution consumes ``bands``
        to save memory: another one needs new equations.
        """
        matrix, self.bands = self.bands, np.zeros((0, 0, 0, 0))
        each = np.arange(matrix.shape[-1])
        matrix[0][:, each, each] += damping[:, None] * self.damped
        return solve_banded(matrix, right)

    @property
    def energy(self) -> dict[str, float]:
        """Energy of each term, over all frames."""
        return {term: float(values.sum()) for term, values in self.energies.items()}

    @property
    def total(self) -> float:
        """Energy of all terms."""
        return float(sum(values.sum() for values in self.energies.values()))

    @property
    def by_frame(self) -> np.ndarray:
        """Energy (T,) of all terms."""
        return np.sum(list(self.energies.values()), axis=0)

    def hold(self, columns: slice) -> None:
        """Give unknowns ``columns`` that no term constrains the step 0, by ones on the diagonal."""
        if not self.energies_only:
            own = self.bands[0][:, columns, columns]
            own += np.eye(own.shape[-1])

    def add_energy(self, term: str, energy: np.ndarray) -> None:
        """Add the energy (T,) of a term."""
        self.energies[term] = self.energies.get(term, 0.0) + energy

    def add_blocks(
        self,
        term: str,
        columns: slice,
        hessian: np.ndarray,
        gradient: np.ndarray,
        energy: np.ndarray,
    ) -> None:
        """Add J^T W J (T, m, m), J^T W r (T, m) and energy (T,) over ``columns`` of each frame."""
        self.add_energy(term, energy)
        if self.energies_only:
            return
        self.bands[0][:, columns, columns] += hessian
        self.damped[:, columns] += hessian.diagonal(axis1=1, axis2=2)
        self.gradient[:, columns] += gradient

    def add_rows(
        self,
        term: str,
        columns: slice,
        rows: Rows,
        weights: np.ndarray,
        residuals: np.ndarray,
        energy: np.ndarray | None = None,
        *,
        stencil: tuple[float, ...] = (1.0,),
        stiff: bool = False,
    ) -> None:
        """Add residuals of each frame, or of differences over w + 1 neighbouring frames.

        With f(t) a term's values in frame t, the residual of a difference is the sum over k of
        ``stencil[k]`` f(t + k). The Jacobian of f is computed once for each frame. The block of
        frames t + d and t is the product of their Jacobians. Its weight is the sum over all
        differences that contain both frames.

        Args:
            term: name of the energy.
            columns: unknowns of a frame on which its values depend.
            rows: Jacobian of the values by these unknowns.
            weights: (T-w, N) of the differences, including robust weights.
            residuals: (T-w, N, R) of the differences.
            energy: (T-w,) of a robust term; None for plain least squares.
            stencil: (w+1,) factors of the frames t .. t+w; the default is the value itself.
            stiff: leave these rows out of the damping.
        """
        frames, ahead = len(self.gradient), len(stencil) - 1
        if energy is None:
            energy = 0.5 * (weights[..., None] * residuals**2).sum(axis=(1, 2))
        shared = np.zeros(frames)
        if frames > ahead:
            shared = _over_stencil(np.full(ahead + 1, 1 / (ahead + 1)), energy)
        self.add_energy(term, shared)
        if frames <= ahead or self.energies_only:
            return
        forces = _over_stencil(stencil, weights[..., None] * residuals)
        # [d] (T - d, N): weight of the product of the Jacobians of frames t + d and t
        couplings = [
            _over_stencil([f * g for f, g in zip(stencil, stencil[d:], strict=False)], weights)
            for d in range(ahead + 1)
        ]
        # leave out negligible weights, as of most vertices of a contact patch, to save their rows
        counts = couplings[0] > 1e-7 * couplings[0].max(initial=0.0)

        chunk = 8  # frames whose rows are computed at a time: few enough to stay in the cache

        def add_chunk(start: int) -> None:
            stop = min(start + chunk, frames)
            last = min(stop + ahead, frames)
            used = np.flatnonzero(counts[start:last].any(axis=0))
            if not len(used):
                return
            jacobian = rows(slice(start, last), used)
            size = jacobian.shape[2]
            jacobian = jacobian.reshape(last - start, -1, jacobian.shape[3])
            force = forces[start:stop, used].reshape(stop - start, 1, -1)
            self.gradient[start:stop, columns] += (force @ jacobian[: stop - start])[:, 0]
            for d, coupling in enumerate(couplings):
                here = slice(start, min(stop, frames - d))
                count = max(here.stop - here.start, 0)
                weight = np.repeat(coupling[here, used], size, axis=1)[..., None]
                if d:
                    ahead_of = (jacobian[d : d + count] * weight).transpose(0, 2, 1)
                    self.bands[d, here, columns, columns] += ahead_of @ jacobian[:count]
                    continue
                # numpy computes only one triangle of a product A^T A, which is twice as fast
                scaled = jacobian[:count] * np.sqrt(weight)
                block = scaled.transpose(0, 2, 1) @ scaled
                self.bands[0, here, columns, columns] += block
                if not stiff:
                    self.damped[here, columns] += block.diagonal(axis1=1, axis2=2)

        self._threads.map(add_chunk, range(0, frames, chunk))


def _over_stencil(factors: Sequence[float] | np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return out[t] = sum over k of factors[k] values[t - k], with values 0 outside of their range.

    ``factors`` (m,) and ``values`` (n, ...) give the result (n + m - 1, ...).
    """
    out = np.zeros((len(values) + len(factors) - 1, *values.shape[1:]))
    for k, factor in enumerate(factors):
        out[k : k + len(values)] += factor * values
    return out
