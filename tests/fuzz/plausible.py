"""Kinds of input files, and what a reader must not return of any file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.formats.calibration.extrinsics import Extrinsics
from intercap_core.formats.detections.instance import Instance
from intercap_core.geometry.camera import masks
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import is_rigid

LONGEST_LABEL = 200  # characters; the artefact stores all labels at the length of the longest
IMAGE_SIZE = (320, 240)  # of the images that the detections belong to
_NEAR = np.stack(np.meshgrid([-0.2, 0.0, 0.2], [-0.2, 0.0, 0.2]), -1).reshape(-1, 2)


class ImplausibleError(Exception):
    """A file was accepted, and what was loaded cannot be true."""


class Notes(list[str]):
    """Parts of the files that a reader left out, with the reasons."""


@dataclass(frozen=True)
class Kind:
    """One kind of input file."""

    name: str
    form: str
    """Damage that is done: json, yaml, toml, text, zip or bytes."""
    make: Callable[[Path], object]
    """Writes good files into a folder."""
    damaged: Sequence[str]
    """The files that are damaged, one in a case."""
    read: Callable[[Path], Any]
    """Reads the folder; returns what :func:`check_plausible` checks."""
    named: Sequence[str] = ()
    """What a refusal may call the file, besides its name."""


def within(low: float, high: float, *values: Any) -> None:
    """Every array or number is finite and within bounds."""
    for value in values:
        found = np.asarray(value, np.float64)
        if found.size and not (found.min() >= low and found.max() <= high):
            raise ImplausibleError(
                f"{found.min():.4g} to {found.max():.4g}, not {low:g} to {high:g}"
            )


def check_plausible(value: Any) -> Notes:
    """Check everything that a reader returned, and collect its notes."""
    notes = Notes()
    if isinstance(value, Notes):
        notes += value
    elif isinstance(value, Intrinsics):
        _check_lens(value)
    elif isinstance(value, Extrinsics):
        places = np.array([pose[:3, 3] for pose in value.master_from_colour.values()])
        apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + np.eye(len(places))
        if len(places) > 1 and apart.min() < 1e-3:
            raise ImplausibleError("two cameras are in one place")
        check_plausible(value.master_from_colour)
    elif isinstance(value, Instance):
        masks.decode(value.rle, IMAGE_SIZE[1], IMAGE_SIZE[0])
        within(-0.1, 1.3, value.score)
        within(-2 * IMAGE_SIZE[0], 3 * IMAGE_SIZE[0], np.array(value.box, np.float32))
        if min(value.box[2:]) < 0 or len(value.label) > LONGEST_LABEL:
            raise ImplausibleError(f"a box is {value.box} of {value.label!r:.60}")
        value.label.encode()
    elif isinstance(value, np.ndarray) and value.shape == (4, 4):
        if not is_rigid(value, 1e-2):
            raise ImplausibleError(f"a pose is {value}")
        within(-100, 100, value[:3, 3])
    elif isinstance(value, str):
        value.encode()
    elif isinstance(value, bool | int | float | np.number) or (
        isinstance(value, np.ndarray) and value.dtype.kind in "biuf"
    ):
        within(-(2.0**64), 2.0**64, value)
    elif isinstance(value, Mapping):
        notes += check_plausible([*value.keys(), *value.values()])
    elif isinstance(value, list | tuple | set):
        for inner in value:
            notes += check_plausible(inner)
    elif is_dataclass(value):
        notes += check_plausible([getattr(value, field.name) for field in fields(value)])
    return notes


def _check_lens(lens: Intrinsics) -> None:
    """The lens images its surroundings once, at a plausible scale."""
    side = max(lens.width, lens.height)
    within(0.2, 20, lens.fx / side, lens.fy / side)
    within(-1, 2, lens.cx / lens.width, lens.cy / lens.height)
    within(1, 40_000, lens.width, lens.height)
    half = min(lens.width, lens.height) / 2 / min(lens.fx, lens.fy)
    pixels = lens.project(np.column_stack([_NEAR / 0.4 * half, np.ones(len(_NEAR))]))
    away = np.linalg.norm(pixels - [lens.cx, lens.cy], axis=1)
    if not away.max() <= 6 * side or (np.delete(away, 4) < 1e-3 * side).any():
        raise ImplausibleError(f"the lens images its edge {away.round(1)} px from its centre")
