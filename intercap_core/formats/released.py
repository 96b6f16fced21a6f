"""Released results: their common form, and the files of BEHAVE.

BEHAVE has registrations of single frames, and parameters at 30 frames a second. A frame's folder,
such as ``t0003.000``, holds:

- ``person/fit02/person_fit.ply``: mesh of 6,890 vertices (SMPL-H's);
- ``person/fit02/person_fit.pkl``: ``pose`` of 156 numbers (SMPL-H's 52 joints) or 72 (SMPL's 24);
- ``<name>/fit01/<name>_fit.pkl``: the object's ``angle``, a rotation vector, and ``trans``;
- ``<name>/fit01/<name>_fit.ply``: its mesh. ``<name>`` is the object, "chair" or "sports ball".

A sequence's parameters are in ``smpl_fit_all.npz`` (``poses``, ``frame_times``) and in
``object_fit_all.npz`` (``angles``, ``trans``, ``frame_times``). Times are texts such as
"t0003.033". All poses are in the frame of Kinect 1's colour camera, metres and radians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from intercap_core.body.joints import FIRST_FINGER, JOINT_INDEX, NUM_JOINTS
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.flags import Flags
from intercap_core.formats.recordings.numbering import FRAME_FOLDER
from intercap_core.inputs.arrays import read_arrays, read_pickle

INTERCAP = ("res.pkl", "res.npz", "res_2.pkl", "res_1.pkl")  # names of result files, newest first
BEHAVE_PERSON, BEHAVE_OBJECT = "smpl_fit_all.npz", "object_fit_all.npz"  # parameters at 30 fps
PERSON_MESH = Path("person", "fit02", "person_fit.ply")  # in the folder of a frame of BEHAVE


def intercap_file(path: Path) -> Path:
    """Return the file of results in a folder; any other path is returned unchanged."""
    return next((path / name for name in INTERCAP if (path / name).is_file()), path)


@dataclass(frozen=True, eq=False)
class Recording:
    """The sequence whose results are read."""

    sequence: str
    """Its name."""
    times: np.ndarray
    """(T,) times of its frame sets on the recordings' own clock, seconds."""
    object_: ObjectEntry | None
    """Its object; None for a person alone."""
    body: Path
    """Body file whose surface is fitted to results of another body model."""
    betas: int
    """Number of shape parameters of that fit."""


@dataclass(frozen=True, eq=False)
class Results:
    """Results of another program for T frames; master camera's frame, metres and radians."""

    path: Path
    """File or folder of the results."""
    turns: Mapping[str, np.ndarray]
    """Rotation vectors by SMPL-X's names, (T, 3) or (T, 63)."""
    hands: tuple[np.ndarray, np.ndarray]
    """Left and right: full poses (T, 45), or coefficients (T, n) of the hand's pose components
    about its mean pose."""
    transl: np.ndarray
    """(T, 3) translation of SMPL-X."""
    betas: np.ndarray
    """(T, n) shape coefficients."""
    expression: np.ndarray
    """(T, n) coefficients of facial expression."""
    rotation: np.ndarray
    """(T, 3, 3) of master_from_object; NaN without an object."""
    translation: np.ndarray
    """(T, 3) of master_from_object; NaN without an object."""
    source: str
    """Description of the results, for the user."""
    flags: Flags | None = None
    """Frames without a result or not to be trusted; None = frames that are not finite."""
    surface_distance: np.ndarray | None = None
    """(T, 2) mean and 95th percentile, metres, of the distance between the converted and the
    released body surface; None if the body was not converted."""

    def __len__(self) -> int:
        return len(self.transl)

    @property
    def known(self) -> np.ndarray:
        """(T,) bool: all numbers of the frame are finite, with the object's if there is one."""
        body = [*self.turns.values(), *self.hands, self.transl, self.betas, self.expression]
        parts = [np.isfinite(part).all(axis=1) for part in body]
        if np.isfinite(self.translation).any():
            parts += [np.isfinite(self.rotation).all((1, 2)), np.isfinite(self.translation).all(1)]
        return np.all(parts, axis=0)


def check_range(path: Path, name: str, values: np.ndarray) -> None:
    """Raise UserError if coordinates or rotation vectors are too large for metres or radians."""
    finite = np.abs(values[np.isfinite(values)])
    if (finite > 100).any():
        raise UserError(f"{path}: {name} reaches {finite.max():.0f}; expected metres and radians")


_PERSON, _OBJECT_FIT = "person", "fit01"
_VERTICES = 6890  # of SMPL and SMPL-H
_POSE_SIZES = (156, 72)  # numbers of a pose of SMPL-H, of SMPL


class Skin(NamedTuple):
    """A person's surface: vertices (V, 3) float32, metres, and faces (F, 3)."""

    vertices: np.ndarray
    faces: np.ndarray


def read_skin(path: Path) -> Skin:
    """Read a ``person_fit.ply``; raises UserError unless it has 6,890 vertices of a person."""
    from intercap_core.geometry.rigid.mesh import read_mesh

    mesh = read_mesh(path)
    vertices = np.asarray(mesh.vertices, np.float32)
    if len(vertices) != _VERTICES:
        raise UserError(
            f"{path}: has {len(vertices)} vertices, expected the {_VERTICES} of SMPL-H; get "
            "BEHAVE's file again"
        )
    if not np.isfinite(vertices).all():
        raise UserError(f"{path}: has a vertex that is no number; get BEHAVE's file again")
    extent = float(np.ptp(vertices, axis=0).max())
    low, high = 0.5, 3.0  # from crouching to an arm raised
    if not low <= extent <= high:
        raise UserError(
            f"{path}: is {extent:.4g} m large, expected a person of {low:g} to {high:g} m; write "
            "it in metres"
        )
    check_range(path, "its vertices", vertices)
    return Skin(vertices, np.asarray(mesh.faces, np.int32))


def read_person_pose(path: Path) -> np.ndarray:
    """Read rotation vectors (55, 3), in SMPL-X's order, from a ``person_fit.pkl``."""
    return _as_smplx(_numbers(_named(path), "pose", path).reshape(1, -1), path)[0]


def read_object_pose(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read rotation vector (3,) and translation (3,) from an ``<object>_fit.pkl``."""
    values = _named(path)
    angle, trans = (_numbers(values, name, path).ravel() for name in ("angle", "trans"))
    for name, vector in (("angle", angle), ("trans", trans)):
        if vector.shape != (3,) or not np.isfinite(vector).all():
            raise UserError(f"{path}: {name} holds {vector.size} numbers, expected 3 finite ones")
        check_range(path, name, vector)
    return angle, trans


def object_fits(frame: Path) -> list[Path]:
    """Files ``<name>/fit01/<name>_fit.pkl`` of a frame's folder, for any name of the object."""
    return [
        path
        for folder in sorted(frame.iterdir())
        if folder.name != _PERSON
        and (path := folder / _OBJECT_FIT / f"{folder.name}_fit.pkl").is_file()
    ]


def person_poses_at_30_fps(folder: Path) -> dict[int, np.ndarray]:
    """Rotation vectors (55, 3) in SMPL-X's order by time, microseconds; {} without the file."""
    path = folder / BEHAVE_PERSON
    if not (path.exists() or path.is_symlink()):  # a dangling link is refused
        return {}
    values = read_arrays(path, advice="get the file again")
    poses = _as_smplx(_numbers(values, "poses", path), path)
    if "frame_times" not in values and (folder / BEHAVE_OBJECT).is_file():  # as first released
        values |= read_arrays(folder / BEHAVE_OBJECT, ["frame_times"], advice="get the file again")
    # Some sequences have more poses than times: frames without an object were removed at the end.
    return dict(zip(_times(values, path, len(poses)), poses, strict=False))


def object_poses_at_30_fps(folder: Path) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Rotation vector and translation by time, microseconds; {} without the file."""
    path = folder / BEHAVE_OBJECT
    if not (path.exists() or path.is_symlink()):
        return {}
    values = read_arrays(path, advice="get the file again")
    angles, trans = (_numbers(values, name, path) for name in ("angles", "trans"))
    for name, vectors in (("angles", angles), ("trans", trans)):
        if vectors.ndim != 2 or vectors.shape[1] != 3 or len(vectors) != len(angles):
            raise UserError(f"{path}: {name} is {vectors.shape}, expected ({len(angles)}, 3)")
        check_range(path, name, vectors)
    both = zip(angles, trans, strict=True)
    return dict(zip(_times(values, path, len(angles)), both, strict=False))


def _as_smplx(poses: np.ndarray, path: Path) -> np.ndarray:
    """Convert poses (T, 156) or (T, 72) to rotation vectors (T, 55, 3) in SMPL-X's order.

    Jaw and eyes are at rest, and so are fingers in SMPL's poses.
    """
    if poses.ndim != 2 or poses.shape[1] not in _POSE_SIZES:
        size = poses.shape[-1] if poses.ndim else 1
        raise UserError(
            f"{path}: a pose has {size} numbers, expected the 156 of SMPL-H or the 72 of SMPL"
        )
    if not np.isfinite(poses).all():
        raise UserError(f"{path}: a pose has values that are no numbers; get the file again")
    check_range(path, "a pose", poses)
    rotations = poses.reshape(len(poses), -1, 3)
    result = np.zeros((len(poses), NUM_JOINTS, 3))
    # The order from pelvis to wrists is that of SMPL-X. SMPL-H has no jaw and no eyes.
    body = JOINT_INDEX["jaw"]
    result[:, :body] = rotations[:, :body]
    fingers = result[:, FIRST_FINGER:]
    if rotations.shape[1] == body + fingers.shape[1]:
        fingers[:] = rotations[:, body:]
    return result


def _named(path: Path) -> Mapping[str, Any]:
    values = read_pickle(path)
    if not isinstance(values, dict):
        raise UserError(f"{path}: holds {type(values).__name__}, expected numbers by name")
    return values


def _numbers(values: Mapping[str, Any], name: str, path: Path) -> np.ndarray:
    if name not in values:
        raise UserError(f"{path}: has no entry {name!r}; expected BEHAVE's results")
    try:
        return np.asarray(values[name], np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{path}: {name} is no array of numbers") from None


def _times(values: Mapping[str, np.ndarray], path: Path, most: int) -> list[int]:
    """Times of ``frame_times``, microseconds, at most as many as there are poses."""
    texts = np.atleast_1d(values.get("frame_times", np.zeros(0)))
    matches = [FRAME_FOLDER.fullmatch(str(text)) for text in texts]
    if not matches or not all(matches) or len(matches) > most:
        raise UserError(
            f"{path}: frame_times are not times such as 't0003.033', one for each of {most} poses; "
            "get BEHAVE's file again"
        )
    return [round(float(match.group(1)) * 1e6) for match in matches if match]
