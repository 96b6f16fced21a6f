"""Robust penalties rho(s) of squared residuals s, and their slopes: weights of Gauss-Newton.

Convention of all solvers: a residual vector r with s = |r|^2 costs rho(s) / 2, whose gradient is
w J^T r with w = d rho / d s. Replacing rho by the parabola of weight w keeps the gradient and
leaves a positive semi-definite Hessian w J^T J (iteratively reweighted least squares). All rho have
rho(0) = 0 and slope 1 at 0, so the scale alone determines from which size on residuals lose weight.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from numba.extending import register_jitable

if TYPE_CHECKING:
    from torch import Tensor


class Robust(NamedTuple):
    """A robust penalty at squared residuals."""

    rho: Tensor
    """(...) penalty."""
    weight: Tensor
    """(...) slope of the penalty, in (0, 1]."""


# Standard deviation over median absolute deviation of a Gaussian: 1 / Phi^-1(3/4) (Hampel 1974).
SIGMA_PER_MAD = 1.4826
# Median length of a 3D normal error, in standard deviations of one coordinate: the median of the
# chi distribution with three degrees of freedom.
MEDIAN_CHI_3 = 1.5382
# Residual, in standard deviations, at which a measurement counts a quarter: the scale of Geman and
# McClure for keypoints and for images of the object. Tuned on the studio.
OUTLIER_SIGMAS = 4.0


@register_jitable
def geman_mcclure_weight(squared: Any, scale: Any) -> Any:
    """Return the weight in (0, 1] of squared residuals: the slope of :func:`geman_mcclure`'s rho.

    ``squared`` (...) and ``scale``^2 have the same units. Takes tensors, arrays and numbers, also
    inside compiled kernels.
    """
    share = scale * scale / (squared + scale * scale)
    return share * share


def geman_mcclure(squared: Tensor, scale: float | Tensor) -> Robust:
    """Return the penalty of Geman and McClure 1987, the paper's rho_J.

    rho = scale^2 s / (s + scale^2), which is at most scale^2. The paper writes it as
    rho^2 r^2 / (r^2 + rho^2). Its slope is (scale^2 / (s + scale^2))^2.
    """
    import torch

    c2 = torch.as_tensor(scale, dtype=squared.dtype) ** 2
    share = c2 / (squared + c2)
    return Robust(share * squared, share * share)
