"""The open body in an export, in the layout of SMPL-X files: 300 shape and 100 expression columns.

The project's file has 30 columns of each. Readers of SMPL-X files take the expression from column
300, or from column 10 of a file of fewer than 400 columns: of the project's file, shape columns.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from intercap_core.body.artefact import file_digest
from intercap_core.body.joints import JOINT_NAMES
from intercap_core.body.maps import maps_path
from intercap_core.output.export.about import ExportBody

_POSE_DIRECTIONS = 9 * (len(JOINT_NAMES) - 1)  # a 3x3 matrix per joint except the pelvis
_FRAME = "rest pose of the body: y up, facing z, x to its left; origin near the chest"
_SHAPE, _EXPRESSION = 300, 100  # columns of a file of SMPL-X


def write(folder: Path, body: ExportBody) -> dict[str, dict[str, str]]:
    """Write the body file, and its maps of points and regions, into ``folder``.

    Columns beyond those of the parameters are zero, as are the pose blend shapes, which the open
    body does not have. All other numbers are copied bit by bit.

    Returns for JSON, by name of the written file, its digest and the columns (start:stop) of betas
    and expression; {} for a licensed body, which is not written.
    """
    if not body.is_open:
        return {}
    folder.mkdir()
    path = folder / f"{body.path.stem}_{_SHAPE}_{_EXPRESSION}.npz"
    shutil.copyfile(maps_path(body.path), maps_path(path))
    with np.load(body.path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    np.savez_compressed(path, allow_pickle=True, **_laid_out(arrays, body))
    return {
        path.name: {
            "digest": file_digest(path),
            "betas": f"0:{body.num_betas}",
            "expression": f"{_SHAPE}:{_SHAPE + body.num_expression}",
        }
    }


def _laid_out(arrays: dict[str, np.ndarray], body: ExportBody) -> dict[str, np.ndarray]:
    """Return the arrays of the body file with its columns where readers of SMPL-X look."""
    table = arrays["shapedirs"]
    vertices, half = len(table), table.shape[2] // 2  # shape columns, then the expression
    columns = np.zeros((vertices, 3, _SHAPE + _EXPRESSION), table.dtype)
    columns[..., : body.num_betas] = table[..., : body.num_betas]
    columns[..., _SHAPE : _SHAPE + body.num_expression] = table[
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
