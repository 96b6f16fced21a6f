"""What the suite knows of one kind of file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


class ImplausibleError(Exception):
    """A file was accepted, and what was loaded cannot be true."""


@dataclass(frozen=True)
class Kind:
    """``make`` writes good files into a folder; ``damaged`` are those of them, by name, that a case
    damages one of. ``read`` reads them and raises ImplausibleError for what must not be accepted;
    it returns notes of what was left out, which count as refusals of a part.

    ``form`` picks the mutations: json, yaml, toml, table, text, zip, pickle or bytes. ``share`` of
    the cases, 1 = as many as others have; slow readers have fewer.
    """

    name: str
    form: str
    make: Callable[[Path], object]
    damaged: Sequence[str]
    read: Callable[[Path], Sequence[str] | None]
    share: float = 1.0
    named: Sequence[str] = field(default=())  # what a refusal may call the file, beside its name


def finite(**values: Any) -> None:
    """Every array or number is finite."""
    for name, value in values.items():
        if not np.isfinite(np.asarray(value, np.float64)).all():
            raise ImplausibleError(f"{name} is not finite")


def within(low: float, high: float, **values: Any) -> None:
    """Every array or number is finite and within bounds."""
    finite(**values)
    for name, value in values.items():
        found = np.asarray(value, np.float64)
        if found.size and (found.min() < low or found.max() > high):
            raise ImplausibleError(
                f"{name} is {found.min():.4g} to {found.max():.4g}, not {low:g} to {high:g}"
            )
