"""E_beta of a subject: a Gaussian of the shape, narrower where gender and height are known.

The open body is of both genders; its file ``open_body_genders.npz`` holds the mean and covariance
of its shape among women and among men. A licensed file is of its own gender: its betas are standard
normal, by its definition. A height is one linear measurement of betas (the vertices at the crown
and at the soles of the rest pose), and narrows the Gaussian as such (Kalman's update).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.loading import OPEN_BODY, BodyFile

GENDERS_FILE = OPEN_BODY.with_name("open_body_genders.npz")
# m. Stated heights exceed measured ones by 1 to 2 cm with a spread of 2 to 3 (Gorber et al. 2007,
# "A comparison of direct vs. self-report measures for assessing height, weight and body mass
# index", Obesity Reviews 8), and people fall by 1 to 2 cm over a day.
HEIGHT_SIGMA_M = 0.02


@dataclass(frozen=True, eq=False)
class ShapePrior:
    """betas = mean (S,) + root (S,S) z, with z standard normal."""

    mean: np.ndarray
    root: np.ndarray

    @classmethod
    def of(cls, file: BodyFile, gender: str, height_m: float | None = None) -> ShapePrior:
        """Of a subject of this gender, and height where it is known, for a body file."""
        count = file.shape_directions.shape[2]
        mean, covariance = np.zeros(count), np.eye(count)
        if file.path == OPEN_BODY and gender in _genders():
            mean, covariance = (values[..., :count] for values in _genders()[gender])
            covariance = covariance[:count]
        if height_m is not None:
            crown, sole = file.template[:, 1].argmax(), file.template[:, 1].argmin()
            by_shape = file.shape_directions[crown, 1] - file.shape_directions[sole, 1]
            expected = np.ptp(file.template[:, 1]) + by_shape @ mean
            gain = covariance @ by_shape / (by_shape @ covariance @ by_shape + HEIGHT_SIGMA_M**2)
            mean = mean + gain * (height_m - expected)
            covariance = covariance - np.outer(gain, by_shape @ covariance)
        return cls(mean, np.linalg.cholesky((covariance + covariance.T) / 2))

    def centred(self, file: BodyFile) -> BodyFile:
        """The same bodies with z in place of betas: shapes in units of this prior."""
        directions = file.shape_directions
        template = file.template + directions @ self.mean
        return replace(file, template=template, shape_directions=directions @ self.root)

    def betas(self, z: Tensor) -> Tensor:
        """The file's own betas (...,S) of shapes (...,S) in units of this prior."""
        mean, root = (torch.as_tensor(values).to(z) for values in (self.mean, self.root))
        return mean + z @ root.T


@cache
def _genders() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Mean (30,) and covariance (30,30) of the open body's betas, by gender."""
    with np.load(GENDERS_FILE, allow_pickle=False) as file:
        names, mean, covariance = (file[name] for name in ("genders", "mean", "covariance"))
    return {
        str(name): (mean[i].astype(float), covariance[i].astype(float))
        for i, name in enumerate(names)
    }
