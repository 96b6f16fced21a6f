"""The open body, loaded once a process, and random numbers to pose it."""

from __future__ import annotations

import functools

import torch

from intercap_core.body.kinematics import vertex_normals
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters


@functools.cache
def open_body(dtype: torch.dtype = torch.float32) -> BodyModel:
    """The open body in the given precision; shared, so tests must not change it."""
    return BodyModel.load(dtype=dtype)


def random_normal(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """Standard normal numbers from a generator of their own."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, dtype=dtype, generator=generator)


def posed_normals(model: BodyModel, params: BodyParameters) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices and unit normals (B,V,3) of posed bodies."""
    vertices = model.forward(params).vertices
    return vertices, vertex_normals(vertices, model.faces)
