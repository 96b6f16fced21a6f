"""What the calibration files of other tools have in common: names, units, one pose a camera."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import CAMERA_NAME, MAX_DISTANCE_M, named, placed
from intercap_core.formats.calibration.opencv import CalibratedCamera, Calibration
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import invert
from intercap_core.inputs.quotes import quoted

MIN_RIG_M = 0.05  # between the two cameras farthest apart; nearer: the scale is wrong
SAME_POSE_M = 0.01  # images of one fixed camera that differ by more were not taken from one place
SAME_POSE_DEG = 0.3


@dataclass(frozen=True)
class Recorded:
    """What the recordings say to a calibration: names, and the size of a camera's images.

    ``size_of`` gives width and height of the first image, None where it cannot be read.
    """

    names: Collection[str] = ()
    size_of: Callable[[str], tuple[int, int] | None] = field(default=lambda name: None)


@dataclass(frozen=True, eq=False)
class OtherCamera:
    """One camera as another tool has it; OpenCV's axes.

    ``names``: what it may be called, best first. ``camera_from_world`` (4, 4) in the file's unit.
    """

    names: tuple[str, ...]
    lens: Intrinsics
    camera_from_world: np.ndarray


def put_together(
    path: Path,
    tool: str,
    cameras: Sequence[OtherCamera],
    recorded: Recorded,
    *,
    scale: float | None,
    unit: str | None,
) -> Calibration:
    """Name the cameras as the recordings do and bring them to metres; the first is the master.

    ``scale``: metres for one unit of the file, as the user states it. ``unit`` says what is known
    of a unit that the file does not fix, None where it is the metre by the tool's documentation.
    Raises UserError for names that are unsafe, used twice or none of the recordings', for a scale
    that is missing, and for one that cannot be.
    """
    if not cameras:
        raise UserError(f"{path}: holds no camera; calibrate again, or name another file")
    if unit is not None and scale is None:
        raise UserError(
            f"{path}: {unit}, so nothing says how long a metre is in this file of {tool}; state "
            "metres for one of its units in column calibration_scale of the table of sequences "
            "(1 = metres, 0.001 = millimetres; else a distance that you measured between two "
            "cameras, divided by that in the file)"
        )
    poses: dict[str, np.ndarray] = {}
    known: dict[str, CalibratedCamera] = {}
    for camera in cameras:
        name = next((n for n in camera.names if n in recorded.names), camera.names[0])
        if not CAMERA_NAME.fullmatch(name):
            raise UserError(
                f"{path}: camera {quoted(name)} has a name that no file can have, expected "
                "letters, digits, '_' and '-'; rename it"
            )
        if name in poses:
            raise UserError(f"{path}: two cameras are named {name!r}; rename one")
        pose = camera.camera_from_world.copy()
        pose[:3, 3] *= scale or 1.0
        poses[name] = invert(pose)
        known[name] = CalibratedCamera(camera.lens)
    _check_names(path, poses, recorded)
    _check_size(path, np.stack([pose[:3, 3] for pose in poses.values()]), scale)
    return Calibration(known, placed(path, next(iter(poses)), poses))


def fixed_cameras(
    path: Path,
    images: Iterable[tuple[str, Intrinsics, np.ndarray]],
    recorded: Recorded,
    *,
    scale: float | None,
) -> list[OtherCamera]:
    """The cameras of images, each a path, a lens and camera_from_world (4, 4) in the file's unit.

    An image belongs to the recorded camera that a folder of its path or its own name says; where
    none does, to its folder, or to itself. Cameras come in order of their names. Raises UserError
    for a camera whose images were taken from several places.
    """
    found: dict[str, list[tuple[str, Intrinsics, np.ndarray]]] = {}
    for image, lens, pose in images:
        found.setdefault(_camera_of(image, recorded.names), []).append((image, lens, pose))
    for name, shots in found.items():
        for image, _, pose in shots[1:]:
            apart = float(np.linalg.norm(invert(pose)[:3, 3] - invert(shots[0][2])[:3, 3]))
            apart *= scale or 0.0  # without a scale, which is demanded later, turns alone tell
            turned = np.degrees(
                Rotation.from_matrix(pose[:3, :3] @ shots[0][2][:3, :3].T).magnitude()
            )
            if apart > SAME_POSE_M or turned > SAME_POSE_DEG:
                raise UserError(
                    f"{path}: camera {name!r} has {len(shots)} images, of which {shots[0][0]} and "
                    f"{image} are {apart:.3g} m and {turned:.2g} degrees apart, expected one place "
                    "for each fixed camera; keep one image a camera, in a folder named after the "
                    "camera or named so itself"
                )
    return [OtherCamera((name,), found[name][0][1], found[name][0][2]) for name in sorted(found)]


def _camera_of(image: str, recorded: Collection[str]) -> str:
    path = PurePosixPath(image.replace("\\", "/"))
    folders = [part for part in path.parent.parts if part not in (".", "..", "/")]
    for name in [*reversed(folders), path.stem]:
        if name in recorded:
            return name
    own = [name for name in folders if name != "images"]
    return own[-1] if own else path.stem


def _check_names(path: Path, poses: Collection[str], recorded: Recorded) -> None:
    if recorded.names and not set(poses) & set(recorded.names):
        raise UserError(
            f"{path}: its cameras are {named(poses)}, the recordings are of "
            f"{named(sorted(recorded.names))}: none is the same; give both the same names"
        )


def _check_size(path: Path, centres: np.ndarray, scale: float | None) -> None:
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1).max()
    far = np.abs(centres).max()
    stated = "" if scale is None else f" with calibration_scale {scale:g}"
    if far > MAX_DISTANCE_M:
        raise UserError(
            f"{path}: a camera is {far:.4g} m from the origin{stated}, expected at most "
            f"{MAX_DISTANCE_M:.0f} m; state the unit in column calibration_scale of the table of "
            "sequences (0.001 = the file is in millimetres)"
        )
    if len(centres) > 1 and apart < MIN_RIG_M:
        raise UserError(
            f"{path}: all its cameras lie within {1000 * apart:.3g} mm{stated}, expected at least "
            f"{1000 * MIN_RIG_M:.0f} mm; correct the scale, or calibrate again"
        )
