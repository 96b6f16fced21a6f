"""The open body, loaded once a process."""

from __future__ import annotations

import functools

import torch

from intercap_core.body.model import BodyModel


@functools.cache
def open_body(dtype: torch.dtype = torch.float32) -> BodyModel:
    """The open body in the given precision; shared, so tests must not change it."""
    return BodyModel.load(dtype=dtype)
