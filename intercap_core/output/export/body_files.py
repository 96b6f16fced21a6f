"""The open body beside an export: the file that was fitted with, and the same in the two layouts of
columns that readers of SMPL-X files know.

The project's file has as many shape as expression columns, 30 + 30. Readers of the field take
expression from column 10 of a file with fewer than 400 columns and from column 300 of any other, so
they would take columns of shape for it.
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
from intercap_core.output.export.about import BodyFile

_POSE_DIRECTIONS = 9 * (len(JOINT_NAMES) - 1)  # of a rotation matrix a joint but the pelvis
_FRAME = "rest pose of the body: y up, facing z, x to its left; origin near the chest"


@dataclass(frozen=True)
class Layout:
    """``shape`` columns of betas, followed by ``expression`` columns."""

    shape: int
    expression: int

    @property
    def name(self) -> str:
        return f"{self.shape}_{self.expression}"


SMALL, FULL = Layout(10, 10), Layout(300, 100)


@dataclass(frozen=True)
class Written:
    """A body file of an export: its name, the digest of its content and which columns are whose."""

    name: str
    digest: str
    betas: str
    expression: str


def layouts(body: BodyFile) -> Sequence[Layout]:
    """Those that hold as many columns as the parameters have."""
    return [
        layout
        for layout in (SMALL, FULL)
        if body.num_betas <= layout.shape and body.num_expression <= layout.expression
    ]


def write(folder: Path, body: BodyFile) -> Sequence[Written]:
    """Write the body's file, its maps of named points and regions, and a file for each layout into
    the new ``folder``; says what was written. Licensed files are not copied: nothing is written.

    Columns beyond those of the parameters are zero, and so are the pose blend shapes, which the
    open body has none of; the numbers are those of the file, bit by bit.
    """
    if not body.is_open:
        return ()
    folder.mkdir()
    shutil.copyfile(body.path, folder / body.path.name)
    shutil.copyfile(maps_path(body.path), maps_path(folder / body.path.name))
    with np.load(body.path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    half = arrays["shapedirs"].shape[2] // 2
    found = [
        Written(body.path.name, file_digest(body.path), f"0:{half}", f"{half}:{2 * half}"),
    ]
    for layout in layouts(body):
        path = folder / f"{body.path.stem}_{layout.name}.npz"
        np.savez_compressed(path, allow_pickle=True, **_laid_out(arrays, body, layout))
        start = layout.shape
        found.append(
            Written(
                path.name,
                file_digest(path),
                f"0:{body.num_betas}",
                f"{start}:{start + body.num_expression}",
            )
        )
    return found


def _laid_out(
    arrays: dict[str, np.ndarray], body: BodyFile, layout: Layout
) -> dict[str, np.ndarray]:
    table = arrays["shapedirs"]
    vertices, half = len(table), table.shape[2] // 2
    columns = np.zeros((vertices, 3, layout.shape + layout.expression), table.dtype)
    columns[..., : body.num_betas] = table[..., : body.num_betas]
    expression = slice(layout.shape, layout.shape + body.num_expression)
    columns[..., expression] = table[..., half : half + body.num_expression]
    return {
        **arrays,
        "shapedirs": columns,
        "posedirs": np.zeros((vertices, 3, _POSE_DIRECTIONS), table.dtype),
        # a pickled dictionary, as in the published files: readers ask for it
        "joint2num": np.array({name: place for place, name in enumerate(JOINT_NAMES)}),
        "surface_model_type": np.array(body.surface_model),
        "fitted_with": np.array(f"{body.path.name}, digest {file_digest(body.path)}"),
        "frame": np.array(_FRAME),
        "up_axis": np.array("y"),
        "units": np.array("metres"),
    }
