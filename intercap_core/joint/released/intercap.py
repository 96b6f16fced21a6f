"""Read results in the InterCap release's format: SMPL-X parameters and object poses by frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.parameters import POSE_BLOCKS
from intercap_core.errors import UserError
from intercap_core.formats.released import INTERCAP, Results, check_range, intercap_file
from intercap_core.inputs.arrays import read_arrays, read_pickle

# Length of a full axis-angle hand pose; shorter vectors are PCA coefficients.
FULL_HAND = dict(POSE_BLOCKS)["left_hand_pose"]


def read_results(path: Path) -> Results:
    """Read a file of results, or a folder that holds one of ``INTERCAP``; executes no pickled code.

    ``body_pose`` may be (1, 63 T) as released or (T, 63), shapes (n,) or (T, n), hands components
    or full poses. Raises UserError, naming file and entry, if an entry is missing, has another
    shape or is not in metres.
    """
    path = intercap_file(Path(path))
    if path.is_dir():
        raise UserError(f"{path}: holds none of {', '.join(INTERCAP)}; name the file of results")
    values = _stack_frames(read_arrays(path) if path.suffix == ".npz" else read_pickle(path), path)
    transl = _array(values, "transl", path, 3)
    total = len(transl)
    turns = {
        name: _array(values, name, path, size, total)
        for name, size in POSE_BLOCKS
        if not name.endswith("_hand_pose")
    }
    rotation = np.full((total, 3, 3), np.nan)
    translation = np.full((total, 3), np.nan)
    hands = _hand(values, "left", path, total), _hand(values, "right", path, total)
    betas, expression = (_shape(values, name, path, total) for name in ("betas", "expression"))
    if values.get("ob_pose") is not None and len(values["ob_pose"]):
        vectors = _array(values, "ob_pose", path, 3, total)
        translation = _array(values, "ob_trans", path, 3, total)
        known = np.isfinite(vectors).all(axis=1)
        rotation[known] = Rotation.from_rotvec(vectors[known]).as_matrix()
    check_range(path, "transl", transl)
    check_range(path, "ob_trans", translation)
    for name, turn in turns.items():
        check_range(path, name, turn)
    return Results(path, turns, hands, transl, betas, expression, rotation, translation, path.name)


def _stack_frames(loaded: Any, path: Path) -> dict[str, Any]:
    """Entries of all frames by name; ``res_1.pkl`` is a list with the entries of each frame."""
    if isinstance(loaded, list) and loaded and all(isinstance(frame, dict) for frame in loaded):
        names = set.intersection(*(set(frame) for frame in loaded))
        return {name: [np.ravel(frame[name]) for frame in loaded] for name in names}
    if isinstance(loaded, dict):
        return loaded
    raise UserError(
        f"{path}: holds {type(loaded).__name__}, expected the results of all frames by name, or a "
        "list of frames"
    )


def _entry(values: Mapping[str, Any], name: str, path: Path) -> Any:
    if name not in values:
        raise UserError(f"{path}: has no entry {name!r}; expected the InterCap release's results")
    return values[name]


def _array(
    values: Mapping[str, Any], name: str, path: Path, size: int, total: int | None = None
) -> np.ndarray:
    """Entry as (T, size) float64."""
    try:
        array = np.asarray(_entry(values, name, path), np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{path}: {name} is no array of numbers") from None
    if array.size == 0 or array.size % size or (total is not None and array.size != total * size):
        expected = f"({total or 'frames'}, {size})"
        raise UserError(f"{path}: {name} is {array.shape}, expected {expected}")
    return array.reshape(-1, size)


def _hand(values: Mapping[str, Any], side: str, path: Path, total: int) -> np.ndarray:
    """Full pose (T, 45) if the file has one, else components (T, n)."""
    full = f"{side}_hand_pose_axis_angle"
    if full in values:
        return _array(values, full, path, FULL_HAND, total)
    name = f"{side}_hand_pose"
    size = np.size(values[name]) // total if name in values else 1
    if size > FULL_HAND:
        raise UserError(f"{path}: {name} has {size} numbers a frame, expected {FULL_HAND} or fewer")
    return _array(values, name, path, max(size, 1), total)


def _shape(values: Mapping[str, Any], name: str, path: Path, total: int) -> np.ndarray:
    """Entry (T, n); a shape (n,) or (1, n) of all frames is repeated."""
    shape = np.atleast_2d(np.asarray(_entry(values, name, path), np.float64))
    shape = shape.reshape(-1, shape.shape[-1])
    if len(shape) not in (1, total) or not shape.size:
        raise UserError(f"{path}: {name} is {shape.shape}, expected ({total}, n) or (1, n)")
    return np.broadcast_to(shape, (total, shape.shape[1]))
