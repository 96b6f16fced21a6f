"""Exact solution of normal equations that couple neighbouring frames, by block Cholesky.

A system has T frames with n parameters each. Frame t is coupled with frames up to t + w: w = 0
without temporal terms, 1 with velocities, 2 with accelerations. Its matrix (T n x T n) is
block-banded, symmetric and positive definite. The block Cholesky factorisation over time takes
O(T (w + 1)^2 n^3) operations and O(T (w + 1) n^2) memory.

Parameters that are not coupled with other frames are eliminated first within each frame. Their rows
and columns are then zero in the factor's blocks between frames too, so that these blocks are
computed and stored without them.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import get_blas_funcs, get_lapack_funcs


def solve_banded(bands: np.ndarray, right: np.ndarray) -> np.ndarray | None:
    """Return the solutions x (T, n, k), or None if the matrix is not positive definite.

    Args:
        bands: (w+1, T, n, n), C-contiguous: ``bands[k, t]`` is block (t + k, t), rows of frame
            t + k, columns of frame t. The last k entries of ``bands[k]`` are not read. The factor
            overwrites them.
        right: (T, n, k) right-hand sides.
    """
    w1, count, n, n2 = bands.shape
    if n != n2 or w1 > count:
        raise ValueError(f"bands have shape {bands.shape}, expected (w+1, T, n, n)")
    order, starts = _elimination(bands)
    lower = [_arrange(band, order[start:]) for band, start in zip(bands, starts, strict=True)]
    if not _factorise(lower):
        return None
    x = np.empty_like(right, bands.dtype)
    x[:, order] = _substitute(lower, np.ascontiguousarray(right[:, order], bands.dtype))
    return x


def _elimination(bands: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Return the order of elimination (n,), and the first of its parameters in each band.

    Parameters are in order of the farthest frame with which they are coupled. Products of blocks
    fill the entries of all parameters with any coupling, except in the last band.
    """
    w1, count, n, _ = bands.shape
    reach = np.zeros(n, int)
    for k in range(1, w1):
        coupled = (bands[k, : count - k] != 0).any(axis=0)
        reach[coupled.any(axis=0) | coupled.any(axis=1)] = k
    first = [0, *([int((reach < 1).sum())] * (w1 - 2)), int((reach < w1 - 1).sum())]
    return np.argsort(reach, kind="stable"), first[-w1:]


def _arrange(band: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Move rows and columns ``chosen`` (m,) of blocks (T, n, n) to (T, m, m) in the same memory."""
    count, n, _ = band.shape
    size = len(chosen) ** 2
    index = (n * chosen[:, None] + chosen).ravel()
    for block in band.reshape(count, -1):
        block[:size] = np.take(block, index)
    return band.reshape(count, -1)[:, :size].reshape(count, len(chosen), len(chosen))


def _factorise(lower: list[np.ndarray]) -> bool:
    """Overwrite bands by their Cholesky factor; False if the matrix is not positive definite.

    Band k holds (T, m, m) blocks of the last m parameters. BLAS stores by columns, so that it reads
    a transposed block: the factor's lower triangle as an upper one.
    """
    own = lower[0]
    n = own.shape[1]
    (trsm,) = get_blas_funcs(("trsm",), dtype=own.dtype)
    (potrf,) = get_lapack_funcs(("potrf",), dtype=own.dtype)
    for t in range(len(own)):
        # lower[k][t - k] is block (t, t - k); finish row t from its farthest column on
        for k in range(min(len(lower) - 1, t), 0, -1):
            block = lower[k][t - k]
            m = len(block)
            for j in range(k + 1, min(len(lower) - 1, t) + 1):
                far, near = lower[j][t - j], lower[j - k][t - j]
                product = far @ near[:, len(near) - len(far) :].T
                block[m - len(far) :, m - len(near) :] -= product
            trsm(1.0, own[t - k, n - m :, n - m :].T, block.T, trans_a=1, overwrite_b=1)
            own[t, n - m :, n - m :] -= block @ block.T  # of which numpy computes one triangle
        _, info = potrf(own[t].T, clean=0, overwrite_a=1)
        if info:
            return False
    return True


def _substitute(lower: list[np.ndarray], x: np.ndarray) -> np.ndarray:
    """Overwrite right-hand sides (T, n, k) by the solutions, by a factor of :func:`_factorise`."""
    own = lower[0]
    count, n, _ = x.shape
    (trsm,) = get_blas_funcs(("trsm",), dtype=x.dtype)
    for t in range(count):
        for k in range(1, min(len(lower) - 1, t) + 1):
            first = n - lower[k].shape[1]
            x[t, first:] -= lower[k][t - k] @ x[t - k, first:]
        trsm(1.0, own[t].T, x[t].T, side=1, overwrite_b=1)
    for t in reversed(range(count)):
        for k in range(1, min(len(lower) - 1, count - 1 - t) + 1):
            first = n - lower[k].shape[1]
            x[t, first:] -= lower[k][t].T @ x[t + k, first:]
        trsm(1.0, own[t].T, x[t].T, side=1, trans_a=1, overwrite_b=1)
    return x
