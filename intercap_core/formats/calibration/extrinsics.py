"""Poses of the cameras: rig files, and folders as the InterCap data set has them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import invert, is_rigid, rigid, rotation_exp
from intercap_core.inputs.documents import read_object
from intercap_core.inputs.files import parse_numbers, printable, quoted

MAX_DISTANCE_M = 100.0  # of a camera from the file's origin; beyond it, the file is in millimetres
MAX_TO_MASTER_M = 30.0  # a sports hall; beyond it, the file is in centimetres
CAMERA_NAME = re.compile(r"[A-Za-z0-9_-]+")  # also the names of HDF5 groups and of files


@dataclass(frozen=True)
class Extrinsics:
    """Poses of the colour cameras."""

    master: str
    """Name of the master camera."""
    master_from_colour: dict[str, np.ndarray]
    """(4, 4) of each camera by name, metres; exactly the identity for the master."""
    master_from_world: np.ndarray = field(default_factory=lambda: np.eye(4))
    """(4, 4), metres: to the master's frame from the frame in which the file states its poses."""


def read_extrinsics(path: Path) -> Extrinsics:
    """Read camera poses from a rig file, or from a folder as the InterCap data set has it.

    A rig file is JSON: ``{"master": "k1", "cameras": {"k1": {"master_from_camera": 4x4}, ...}}``,
    metres. A folder holds ``Color.json``, ``Color_2.json``, ... with a rotation vector ``R`` and a
    translation ``T``, x_camera = R x_world + T; the cameras are named k1, k2, ... and k1 is the
    master. Raises UserError naming file and camera if something is missing or impossible.
    """
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
            f"{path}: master {quoted(master)} is none of the cameras ({list_names(cameras)}); "
            "correct the name or add the camera"
        )
    poses = {}
    for name, entry in cameras.items():
        try:
            pose = np.array(entry["master_from_camera"], np.float64)
        except (KeyError, TypeError, ValueError, OverflowError):
            pose = np.zeros(0)
        check_camera_name(path, name)
        if not is_rigid(pose):
            raise UserError(
                f"{path}: camera {name!r} has no rigid 4x4 'master_from_camera' (rows of rotation "
                "and translation in metres, last row 0 0 0 1); correct it"
            )
        check_distance(path, f"camera {name!r}", pose[:3, 3])
        poses[name] = pose
    return relate_to_master(path, master, poses)


def _read_release_folder(folder: Path) -> Extrinsics:
    try:
        matches = {
            path: re.fullmatch(r"Color(?:_(\d+))?\.json", path.name) for path in folder.iterdir()
        }
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be read ({error.strerror}); check its permissions"
        ) from None
    files = {int(match.group(1) or 1): path for path, match in matches.items() if match}
    if 1 not in files:
        raise UserError(
            f"{folder}: holds no Color.json (the master camera); give the folder of Color*.json "
            "files, or a rig file"
        )
    poses = {}
    for number, path in sorted(files.items()):
        content = read_object(path)
        pose = parse_pose(content.get("R"), content.get("T"), f"{path}")
        check_distance(path, "the camera", pose[:3, 3])
        poses[f"k{number}"] = invert(pose)
    return relate_to_master(folder, "k1", poses)


def parse_pose(rotation: Any, translation: Any, where: str) -> np.ndarray:
    """Pose camera_from_world (4, 4) of x_camera = R x_world + T.

    Raises UserError, beginning with ``where``, for numbers that are no pose.

    Args:
        rotation: R, a 3x3 matrix or a rotation vector, radians.
        translation: T, three numbers, metres.
        where: file and camera.
    """
    r, t = parse_numbers(rotation, where, "R"), parse_numbers(translation, where, "T").ravel()
    if r.size == 3:
        length = float(np.linalg.norm(r))
        if length > 2 * np.pi:
            raise UserError(
                f"{where}: rotation vector R has length {length:.4g}, expected radians, at most a "
                "whole turn (6.28); convert degrees to radians"
            )
        r = rotation_exp(r.ravel())
    if t.size != 3 or r.shape != (3, 3) or not is_rigid(rigid(r, t)):
        raise UserError(
            f"{where}: R is no rotation (3x3, or a vector of 3) or T no vector of 3; correct it"
        )
    return rigid(r, t)


def check_camera_name(path: Path, name: str) -> None:
    """Raise UserError for a name that cannot be part of a file's name."""
    if not CAMERA_NAME.fullmatch(name):
        raise UserError(
            f"{path}: camera {quoted(name)} has a name that no file can have, expected "
            "letters, digits, '_' and '-'; rename it"
        )


def check_distance(path: Path, camera: str, translation: np.ndarray) -> None:
    """Raise UserError if a translation (3,) is too long to be in metres."""
    distance = float(np.abs(translation).max())
    if distance > MAX_DISTANCE_M:
        raise UserError(
            f"{path}: {camera} has a translation of {distance:.4g} m, expected at most "
            f"{MAX_DISTANCE_M:.0f} m, so it is likely in millimetres; write it in metres"
        )


def relate_to_master(
    path: Path, master: str, world_from_camera: dict[str, np.ndarray]
) -> Extrinsics:
    """Express poses (4, 4), metres, in the master's frame.

    Raises UserError, naming the file ``path``, if two cameras are in one place, or a camera is
    farther than ``MAX_TO_MASTER_M`` from the master.
    """
    master_from_world = invert(world_from_camera[master])
    poses = {name: master_from_world @ pose for name, pose in world_from_camera.items()}
    poses[master] = np.eye(4)
    centres = {name: pose[:3, 3] for name, pose in poses.items()}
    for name, centre in centres.items():
        if (distance := float(np.linalg.norm(centre))) > MAX_TO_MASTER_M:
            raise UserError(
                f"{path}: camera {name!r} is {distance:.4g} m from {master!r}, expected at most "
                f"{MAX_TO_MASTER_M:.0f} m, so it is likely in centimetres; write it in metres"
            )
        for other, other_centre in centres.items():
            apart = np.linalg.norm(centre - other_centre)
            if other < name and apart < 0.003:  # metres; the lenses of a phone are 10 mm apart
                raise UserError(
                    f"{path}: cameras {other!r} and {name!r} are in one place; correct the pose of "
                    "one of them"
                )
    return Extrinsics(master, poses, master_from_world)


def list_names(cameras: Iterable[str]) -> str:
    """Names of cameras for a message; of more than twelve, the first twelve."""
    names = [printable(str(name)[:40]) for name in islice(cameras, 13)]
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
