"""The open body in an export: the fitted file, and its content in two layouts of other readers.

The project's file has 30 shape columns and 30 expression columns. Readers of SMPL-X files take the
expression from column 10 if a file has fewer than 400 columns, otherwise from column 300. In the
project's file they would find shape columns there.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from intercap_core.body.artefact import file_digest
from intercap_core.body.joints import JOINT_NAMES
from intercap_core.body.maps import maps_path
from intercap_core.output.export.about import ExportBody

_POSE_DIRECTIONS = 9 * (len(JOINT_NAMES) - 1)  # a 3x3 matrix per joint except the pelvis
_FRAME = "rest pose of the body: y up, facing z, x to its left; origin near the chest"


# Numbers of shape columns, and of the expression columns that follow them, by layout
_LAYOUTS = ((10, 10), (300, 100))


@dataclass(frozen=True)
class WrittenBody:
    """A body file of an export."""

    name: str
    """File name."""
    digest: str
    """Digest of the file."""
    betas: str
    """Columns of the shape, as start:stop."""
    expression: str
    """Columns of the expression, as start:stop."""


def write(folder: Path, body: ExportBody) -> Sequence[WrittenBody]:
    """Write the body file, its maps of points and regions, and a file per layout into ``folder``.

    Layouts with fewer columns than the parameters are left out.

    Columns beyond those of the parameters are zero, as are the pose blend shapes, which the open
    body does not have. All other numbers are copied bit by bit. Returns the written files, none
    for a licensed body.
    """
    if not body.is_open:
        return ()
    folder.mkdir()
    shutil.copyfile(body.path, folder / body.path.name)
    shutil.copyfile(maps_path(body.path), maps_path(folder / body.path.name))
    with np.load(body.path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    half = arrays["shapedirs"].shape[2] // 2  # shape columns; the others are the expression
    written = [
        WrittenBody(body.path.name, file_digest(body.path), f"0:{half}", f"{half}:{2 * half}")
    ]
    for start, expression in _LAYOUTS:
        if body.num_betas > start or body.num_expression > expression:
            continue
        path = folder / f"{body.path.stem}_{start}_{expression}.npz"
        np.savez_compressed(
            path, allow_pickle=True, **_laid_out(arrays, body, start, start + expression)
        )
        written.append(
            WrittenBody(
                path.name,
                file_digest(path),
                f"0:{body.num_betas}",
                f"{start}:{start + body.num_expression}",
            )
        )
    return written


def _laid_out(
    arrays: dict[str, np.ndarray], body: ExportBody, start: int, total: int
) -> dict[str, np.ndarray]:
    """Return the arrays of the body file with the expression from column ``start`` of ``total``."""
    table = arrays["shapedirs"]
    vertices, half = len(table), table.shape[2] // 2
    columns = np.zeros((vertices, 3, total), table.dtype)
    columns[..., : body.num_betas] = table[..., : body.num_betas]
    columns[..., start : start + body.num_expression] = table[
        ..., half : half + body.num_expression
    ]
    return {
        **arrays,
        "shapedirs": columns,
        "posedirs": np.zeros((vertices, 3, _POSE_DIRECTIONS), table.dtype),
        # a pickled dictionary, which readers expect, as in the published files
        "joint2num": np.array({name: place for place, name in enumerate(JOINT_NAMES)}),
        "surface_model_type": np.array(body.surface_model),
        "fitted_with": np.array(f"{body.path.name}, digest {file_digest(body.path)}"),
        "frame": np.array(_FRAME),
        "up_axis": np.array("y"),
        "units": np.array("metres"),
    }
