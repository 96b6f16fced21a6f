"""Motion terms E_S (body) and E_A (object) of equation 6 (A.1, A.3): small accelerations.

    E_A = 1 / (T - 2) sum over t of || W'_(t-1) + W'_(t+1) - 2 W'_t ||^2  over object vertices W'
    E_S = 1 / (Q (T - 2)) sum over t of || z_(t+1) - z_t ||^2  over latents z of LEMO's network

with T frames, A.2's latent vectors z and Q, the number of LEMO's virtual markers (not Q_t). For a
rigid body E_A depends on the vertices only through their mean and covariance, so six points with
the same moments give the same energy. E_S is E_A's form over the body's joints, since LEMO's
weights are not free. Beyond the paper: both are robust, since a start, a stop or an impact is an
outlier of smooth motion. Differences and jitter also serve the drift terms
(:mod:`intercap_core.joint.terms.drift`).
"""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.solve.robust import SIGMA_PER_MAD

ACCELERATION = (1.0, -2.0, 1.0)  # of frames t-1, t, t+1
RATE = (-1.0, 1.0)  # of frames t, t+1
_FOURTH = (1.0, -4.0, 6.0, -4.0, 1.0)


def accelerations(points: np.ndarray, fps: float) -> np.ndarray:
    """Second differences (T-2, N, 3) of points (T, N, 3), in units per second squared."""
    return (points[:-2] - 2 * points[1:-1] + points[2:]) * fps**2


def robust(acceleration: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Pseudo-Huber weights (T-2, N) and energies (T-2,) of accelerations (T-2, N, 3): quadratic
    below ``scale``, linear above."""
    root = np.sqrt(1.0 + np.square(acceleration / scale).sum(axis=2))
    return 1.0 / root, scale**2 * (root - 1.0).sum(axis=1)


def jitter(points: np.ndarray, valid: np.ndarray) -> float:
    """Standard deviation, in metres, of noise that is independent from frame to frame in points
    (T, N, 3), from the median size of fourth differences: motion itself hardly has any. Only runs
    of ``valid`` (T,) frames count; 0 where there is none of five."""
    count = len(points) - len(_FOURTH) + 1
    if count < 1:
        return 0.0
    whole = np.all([valid[k : k + count] for k in range(len(_FOURTH))], axis=0)
    if not whole.any():
        return 0.0
    fourth = np.sum([f * points[k : k + count] for k, f in enumerate(_FOURTH)], axis=0)
    return float(
        SIGMA_PER_MAD * np.median(np.abs(fourth[whole])) / np.sqrt(np.square(_FOURTH).sum())
    )


def moment_points(vertices: np.ndarray, least: float = 0.0) -> np.ndarray:
    """Six points (6, 3) with the mean and covariance of ``vertices`` (V, 3).

    Mean + and - sqrt(3 lambda_i) e_i along the principal axes: any sum of squares of an affine map
    over the vertices is V / 6 times the same sum over these points. None is nearer to the mean than
    ``least``, metres: a thin thing's own points would leave its spin free.
    """
    mean = vertices.mean(axis=0)
    covariance = np.cov((vertices - mean).T, bias=True)
    values, axes = np.linalg.eigh(covariance)
    arms = (axes * np.maximum(np.sqrt(3 * np.maximum(values, 0.0)), least)).T
    return np.concatenate([mean + arms, mean - arms])


def points_by_object(
    points: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Object points (N, 3) moved to all frames (T, N, 3), and their derivative (T, N, 3, 6) by
    (w, d) for the motion X' = exp(w)(X - t) + t + d."""
    arm = np.einsum("tij,nj->tni", rotation, points)
    jacobian = np.zeros((*arm.shape, 6))
    jacobian[..., 0, 1], jacobian[..., 0, 2] = arm[..., 2], -arm[..., 1]
    jacobian[..., 1, 0], jacobian[..., 1, 2] = -arm[..., 2], arm[..., 0]
    jacobian[..., 2, 0], jacobian[..., 2, 1] = arm[..., 1], -arm[..., 0]
    jacobian[..., [0, 1, 2], [3, 4, 5]] = 1.0
    return arm + translation[:, None], jacobian
