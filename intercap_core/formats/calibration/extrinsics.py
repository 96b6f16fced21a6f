"""Files that say where the cameras of a capture are."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import invert, is_rigid, rigid
from intercap_core.inputs.json_files import read_object
from intercap_core.inputs.quotes import printable, quoted

MAX_DISTANCE_M = 100.0  # from the file's origin; farther: the file is in millimetres
MAX_APART_M = 30.0  # of a camera from the master: a hall; farther: the file is in centimetres
MIN_APART_M = 0.003  # of two cameras' centres of projection; a phone's lenses are 10 mm apart
CAMERA_NAME = re.compile(r"[A-Za-z0-9_-]+")  # names datasets and files
RELEASE_NAME = re.compile(r"Color(?:_(\d+))?\.json")


@dataclass(frozen=True)
class Extrinsics:
    """Poses of the colour cameras: name -> (4, 4), metres; the master's is the identity.

    ``master_from_world`` (4, 4), metres: from the frame that the file itself is written in.
    """

    master: str
    master_from_colour: dict[str, np.ndarray]
    master_from_world: np.ndarray = field(default_factory=lambda: np.eye(4))


def read_extrinsics(path: Path) -> Extrinsics:
    """Read camera poses from a rig file, or from a folder as the InterCap dataset has it.

    A rig file is JSON: ``{"master": "k1", "cameras": {"k1": {"master_from_camera": 4x4}, ...}}``,
    metres. A folder holds ``Color.json``, ``Color_2.json``, ... with a rotation vector ``R`` and a
    translation ``T``, x_camera = R x_world + T; the cameras are named k1, k2, ... and k1 is the
    master. Raises UserError naming file and camera where something is missing or impossible.
    """
    path = Path(path)
    return _read_release_folder(path) if path.is_dir() else _read_rig_file(path)


def write_rig_file(path: Path, extrinsics: Extrinsics) -> None:
    """Write the rig file that :func:`read_extrinsics` reads."""
    cameras = {
        name: {"master_from_camera": pose.tolist()}
        for name, pose in extrinsics.master_from_colour.items()
    }
    content = {"master": extrinsics.master, "cameras": cameras}
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _read_rig_file(path: Path) -> Extrinsics:
    content = read_object(path)
    master = content.get("master")
    cameras = content.get("cameras")
    if not isinstance(cameras, dict) or not cameras or not isinstance(master, str):
        raise UserError(
            f"{path}: expected 'master' (a camera's name) and 'cameras' (names and poses); see "
            "docs/recordings.md"
        )
    if master not in cameras:
        raise UserError(
            f"{path}: master {quoted(master)} is none of the cameras ({named(cameras)}); correct "
            "the name or add the camera"
        )
    poses = {}
    for name, entry in cameras.items():
        try:
            pose = np.array(entry["master_from_camera"], np.float64)
        except (KeyError, TypeError, ValueError, OverflowError):
            pose = np.zeros(0)
        if not CAMERA_NAME.fullmatch(name):
            raise UserError(
                f"{path}: camera {quoted(name)} has a name that no file can have, expected "
                "letters, digits, '_' and '-'; rename it"
            )
        if not is_rigid(pose):
            raise UserError(
                f"{path}: camera {name!r} has no rigid 4x4 'master_from_camera' (rows of rotation "
                "and translation in metres, last row 0 0 0 1); correct it"
            )
        check_distance(path, f"camera {name!r}", pose[:3, 3])
        poses[name] = pose
    return placed(path, master, poses)


def _read_release_folder(folder: Path) -> Extrinsics:
    try:
        matches = {p: RELEASE_NAME.fullmatch(p.name) for p in folder.iterdir()}
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be read ({error.strerror}); check its permissions"
        ) from None
    files = {int(m.group(1) or 1): p for p, m in matches.items() if m}
    if 1 not in files:
        raise UserError(
            f"{folder}: holds no Color.json (the master camera); give the folder of Color*.json "
            "files, or a rig file"
        )
    poses = {}
    for number, path in sorted(files.items()):
        content = read_object(path)
        try:
            turn, shift = (np.array(content[k], np.float64).reshape(3) for k in ("R", "T"))
        except (KeyError, TypeError, ValueError, OverflowError):
            raise UserError(
                f"{path}: expected a rotation vector 'R' and a translation 'T' of three numbers "
                "each; correct it"
            ) from None
        if not (np.isfinite(turn).all() and np.isfinite(shift).all()):
            raise UserError(
                f"{path}: rotation vector 'R' or translation 'T' holds no finite number; calibrate "
                "this camera again"
            )
        check_distance(path, "the camera", shift)
        poses[f"k{number}"] = invert(rigid(Rotation.from_rotvec(turn).as_matrix(), shift))
    return placed(folder, "k1", poses)


def check_distance(path: Path, camera: str, shift: np.ndarray) -> None:
    """Raise UserError where a translation (3,) is too far for metres."""
    distance = float(np.abs(shift).max())
    if distance > MAX_DISTANCE_M:
        raise UserError(
            f"{path}: {camera} has a translation of {distance:.4g} m, expected at most "
            f"{MAX_DISTANCE_M:.0f} m, so it is likely in millimetres; write it in metres"
        )


def placed(path: Path, master: str, world_from_camera: dict[str, np.ndarray]) -> Extrinsics:
    """The poses in the master's frame; raises UserError, naming the file, where two cameras are in
    one place or one is farther off than a room is wide."""
    found = relative_to(master, world_from_camera)
    centres = {name: pose[:3, 3] for name, pose in found.master_from_colour.items()}
    for name, centre in centres.items():
        if (far := float(np.linalg.norm(centre))) > MAX_APART_M:
            raise UserError(
                f"{path}: camera {name!r} is {far:.4g} m from {master!r}, expected at most "
                f"{MAX_APART_M:.0f} m, so it is likely in centimetres; write it in metres"
            )
        for other, there in centres.items():
            if other < name and np.linalg.norm(centre - there) < MIN_APART_M:
                raise UserError(
                    f"{path}: cameras {other!r} and {name!r} are in one place; correct the pose of "
                    "one of them"
                )
    return found


def named(cameras: Iterable[str]) -> str:
    """Names of cameras for a message, the first of many."""
    names = [printable(str(name)[:40]) for name in islice(cameras, 13)]
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")


def relative_to(master: str, world_from_camera: dict[str, np.ndarray]) -> Extrinsics:
    """Express the poses in the master's frame; exactly the identity for the master itself."""
    master_from_world = invert(world_from_camera[master])
    poses = {name: master_from_world @ pose for name, pose in world_from_camera.items()}
    poses[master] = np.eye(4)
    return Extrinsics(master, poses, master_from_world)
