"""Results as the InterCap release has them: SMPL-X parameters and poses of the object by frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.errors import UserError
from intercap_core.formats.released import (
    INTERCAP,
    Results,
    check_range,
    intercap_file,
)
from intercap_core.inputs.arrays import read_arrays, read_pickle

_HANDS = 45  # numbers of a hand's full pose; fewer are components
_TURNS = {"global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3}


def read_results(path: Path) -> Results:
    """Results as the InterCap release has them: a file, or a folder that holds one of ``INTERCAP``.

    ``body_pose`` may be (1, 63 T) as released or (T, 63), shapes one for all or one a frame, hands
    components or full poses. Nothing that the file says is executed. Raises UserError naming file
    and entry where something is missing, of another shape, or not in metres.
    """
    path = intercap_file(Path(path))
    if path.is_dir():
        raise UserError(f"{path}: holds none of {', '.join(INTERCAP)}; name the file of results")
    values = _stacked(_load(path), path)
    transl = _array(values, "transl", path, 3)
    total = len(transl)
    turns = {name: _array(values, name, path, size, total) for name, size in _TURNS.items()}
    hands = tuple(_hand(values, side, path, total) for side in ("left", "right"))
    betas, expression = (_shape(values, name, path, total) for name in ("betas", "expression"))
    rotation = np.full((total, 3, 3), np.nan)
    translation = np.full((total, 3), np.nan)
    if values.get("ob_pose") is not None and len(values["ob_pose"]):
        vectors = _array(values, "ob_pose", path, 3, total)
        translation = _array(values, "ob_trans", path, 3, total)
        some = np.isfinite(vectors).all(axis=1)
        rotation[some] = Rotation.from_rotvec(vectors[some]).as_matrix()
    check_range(path, "transl", transl)
    check_range(path, "ob_trans", translation)
    for name, turn in turns.items():
        check_range(path, name, turn)
    hand_poses = hands[0], hands[1]
    return Results(
        path, turns, hand_poses, transl, betas, expression, rotation, translation, path.name
    )


def _load(path: Path) -> Any:
    return read_arrays(path) if path.suffix == ".npz" else read_pickle(path)


def _stacked(loaded: Any, path: Path) -> dict[str, Any]:
    """The entries of all frames; of a list of frames, ``res_1.pkl``, put together."""
    if isinstance(loaded, list) and loaded and all(isinstance(frame, dict) for frame in loaded):
        names = set.intersection(*(set(frame) for frame in loaded))
        return {name: [np.ravel(frame[name]) for frame in loaded] for name in names}
    if isinstance(loaded, dict):
        return loaded
    raise UserError(
        f"{path}: holds {type(loaded).__name__}, expected the results of all frames by name, or a "
        "list of frames"
    )


def _array(
    values: Mapping[str, Any], name: str, path: Path, size: int, total: int | None = None
) -> np.ndarray:
    """An entry as (T, size) float64."""
    if name not in values:
        raise UserError(f"{path}: has no entry {name!r}; expected the InterCap release's results")
    try:
        found = np.asarray(values[name], np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{path}: {name} is no array of numbers") from None
    if found.size == 0 or found.size % size or (total is not None and found.size != total * size):
        expected = f"({total or 'frames'}, {size})"
        raise UserError(f"{path}: {name} is {found.shape}, expected {expected}")
    return found.reshape(-1, size)


def _hand(values: Mapping[str, Any], side: str, path: Path, total: int) -> np.ndarray:
    """The full pose where it is told, else components."""
    full = f"{side}_hand_pose_axis_angle"
    if full in values:
        return _array(values, full, path, _HANDS, total)
    name = f"{side}_hand_pose"
    size = np.size(values[name]) // total if name in values else 1
    if size > _HANDS:
        raise UserError(f"{path}: {name} has {size} numbers a frame, expected {_HANDS} or fewer")
    return _array(values, name, path, max(size, 1), total)


def _shape(values: Mapping[str, Any], name: str, path: Path, total: int) -> np.ndarray:
    """(T, n), of one for all frames too."""
    if name not in values:
        raise UserError(f"{path}: has no entry {name!r}; expected the InterCap release's results")
    found = np.atleast_2d(np.asarray(values[name], np.float64))
    found = found.reshape(-1, found.shape[-1])
    if len(found) not in (1, total) or not found.size:
        raise UserError(f"{path}: {name} is {found.shape}, expected ({total}, n) or (1, n)")
    return np.broadcast_to(found, (total, found.shape[1]))
