"""How far off a fitted joint may be, stated from the normal equations."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.model import BodyModel

# What no residual shows, because it is the same in every frame: how thick the clothes truly are,
# and where inside the limb the detector's joint and the body model's shape put the bone.
_SYSTEMATIC_BODY_M = 0.005
_SYSTEMATIC_HAND_M = 0.003
_FIRST_FINGER = 25
_CHUNK = 32


def joint_sigma(
    model: BodyModel, vectors: Tensor, columns: Tensor, hessian: Tensor, excess: Tensor
) -> Tensor:
    """Standard deviation (B,55) of each joint's coordinates, metres.

    vectors (B,P) solutions; hessian (B,n,n) of the whitened energy by the parameters ``columns``
    (n,), whose inverse is their covariance; ``excess`` (B,) >= 1 scales it where the residuals are
    larger than the noise they were weighed by. The systematic part is added in squares.
    """
    sigma = vectors.new_zeros(len(vectors), 55)
    for start in range(0, len(vectors), _CHUNK):
        at = slice(start, start + _CHUNK)
        lin = model.linearise(model.parameters(vectors[at]), vertex_ids=np.array([0]), joints=True)
        by = lin.full()[:, 1:][..., columns].double()
        factor = torch.linalg.cholesky(hessian[at].double())
        flat = by.reshape(len(by), -1, len(columns)).transpose(1, 2)
        half = torch.linalg.solve_triangular(factor, flat, upper=False)
        variance = (half**2).sum(1).reshape(len(by), 55, 3).mean(2)
        sigma[at] = (variance * excess[at, None]).sqrt().to(sigma.dtype)
    systematic = torch.full((55,), _SYSTEMATIC_BODY_M).to(sigma)
    systematic[_FIRST_FINGER:] = _SYSTEMATIC_HAND_M
    return (sigma**2 + systematic**2).sqrt()
