"""Mean and covariance of the open body's shape among women and among men.

The adults are those of :func:`.shape_space.sample_adults`, whom the directions themselves are of.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from . import shape_space
from .body_file import SEED, write_npz
from .source import Source

COUNT = 3000  # adults, half of each gender
GENDERS = ("female", "male")


def bake(source: Source, body: Path, path: Path) -> None:
    """Write ``path`` for the open body's file ``body``."""
    with np.load(body) as file:
        directions = file["shapedirs"].astype(float)[:, :, : shape_space.NUM_SHAPE]
        template = file["v_template"].astype(float)
    area = np.repeat(shape_space.vertex_areas(template, source.faces), 3)
    basis = directions.reshape(-1, shape_space.NUM_SHAPE)
    weighted = (basis * area[:, None]).T
    drawn = shape_space.sample_adults(COUNT, np.random.default_rng(SEED + 3))
    vertices, _, _ = shape_space.t_posed(source, source.coefficients(drawn))
    offset = (vertices - template).reshape(COUNT, -1)
    betas = np.linalg.solve(weighted @ basis, weighted @ offset.T).T
    female = drawn["gender"] > 0.5
    height = np.ptp(vertices[:, :, 1], axis=1)
    groups = [betas[female], betas[~female]]
    for name, some, tall in zip(GENDERS, groups, (height[female], height[~female]), strict=True):
        first, spread = some.mean(0)[:4].round(2), some.std(0)[:4].round(2)
        print(f"{name}: {tall.mean():.3f} +- {tall.std():.3f} m; components {first} +- {spread}")
    write_npz(path, {
        "genders": np.array(GENDERS),
        "mean": np.stack([some.mean(0) for some in groups]).astype(np.float32),
        "covariance": np.stack([np.cov(some.T) for some in groups]).astype(np.float32),
    })  # fmt: skip
