"""What another program found of a sequence, in the form that every release is brought to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core.config import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.formats.released.constants import MOST_M, MOST_RAD


@dataclass(frozen=True, eq=False)
class Recording:
    """The sequence that results are asked for.

    ``times`` (T,): of its frame sets, seconds on the clock of the recordings themselves (not from
    the first on). ``object_``: None = a person alone. ``body``: the body file whose surface is
    fitted where results are of another body, with ``betas`` numbers of the shape.
    """

    sequence: str
    times: np.ndarray
    object_: ObjectEntry | None
    body: Path
    betas: int


@dataclass(frozen=True, eq=False)
class Results:
    """T frames, master camera's frame, metres and radians.

    ``turns``: rotation vectors by SMPL-X's names, (T, 3) or (T, 63); ``hands``: left and right,
    (T, 45) full poses, or (T, n) components over the hand's mean pose; ``transl`` (T, 3), ``betas``
    and ``expression`` (T, n). ``rotation`` (T, 3, 3) and ``translation`` (T, 3) are
    master_from_object, NaN throughout where there is no object. ``source``: what they are, in
    words. ``reasons`` (T,): why a frame has no result, or should not be trusted; empty = neither is
    told. ``surface_distance`` (T, 2): mean and 95th percentile of how far a body that was converted
    is from the surface that the results have; None where nothing was converted.
    """

    path: Path
    turns: Mapping[str, np.ndarray]
    hands: tuple[np.ndarray, np.ndarray]
    transl: np.ndarray
    betas: np.ndarray
    expression: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    source: str
    reasons: Sequence[str] = ()
    surface_distance: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.transl)

    @property
    def known(self) -> np.ndarray:
        """Frames (T,) whose every number is finite; of the object where there is one."""
        body = [*self.turns.values(), *self.hands, self.transl, self.betas, self.expression]
        parts = [np.isfinite(part).all(axis=1) for part in body]
        if np.isfinite(self.translation).any():
            parts += [np.isfinite(self.rotation).all((1, 2)), np.isfinite(self.translation).all(1)]
        return np.all(parts, axis=0)


def check_range(path: Path, name: str, values: np.ndarray, most: float) -> None:
    """Raise UserError where finite ``values`` are so large that their unit is another one."""
    finite = np.abs(values[np.isfinite(values)])
    if (finite > most).any():
        raise UserError(f"{path}: {name} reaches {finite.max():.0f}; expected metres and radians")


def check_metres(path: Path, name: str, values: np.ndarray) -> None:
    """The same for places in metres."""
    check_range(path, name, values, MOST_M)


def check_radians(path: Path, name: str, values: np.ndarray) -> None:
    """The same for rotation vectors."""
    check_range(path, name, values, MOST_RAD)
