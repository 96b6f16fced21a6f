"""Calibrations as other tools write them: the text and bytes of their own files."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation


@dataclass(frozen=True, eq=False)
class View:
    """A camera as OpenCV has it; ``distortion`` (8,), ``camera_from_world`` (4, 4) in metres."""

    size: tuple[int, int]
    matrix: np.ndarray
    distortion: np.ndarray
    camera_from_world: np.ndarray

    @property
    def turn(self) -> np.ndarray:
        """Rotation vector (3,)."""
        return Rotation.from_matrix(self.camera_from_world[:3, :3]).as_rotvec()

    @property
    def shift(self) -> np.ndarray:
        """Translation (3,)."""
        return self.camera_from_world[:3, 3]


Views = Mapping[str, View]


def write_pose2sim(folder: Path, views: Views) -> Path:
    """``Calib_scene.toml``: metres, four coefficients, sizes with a decimal point."""
    return _write_toml(folder / "Calib_scene.toml", views, list(views), 4, 1.0, "fisheye = false\n")


def write_qualisys(folder: Path, views: Views) -> Path:
    """``Calib.qca.txt``: millimetres, 1/64 pixels, y up, and a camera that sees markers alone."""
    text = "<?xml version='1.0' encoding='ASCII'?>\n<calibration>\n<cameras>\n"
    text += '<camera model="Oqus 3+" serial="markers"/>\n'
    for name, view in views.items():
        turn = cv2.Rodrigues(view.turn)[0]
        axes = np.diag([1.0, -1.0, -1.0]) @ turn
        x, y, z = -1000 * turn.T @ view.shift.ravel()
        rows = " ".join(f'r{i + 1}{j + 1}="{axes[i, j]:.17g}"' for i, j in np.ndindex(3, 3))
        k = 64 * view.matrix
        k1, k2, p1, p2 = view.distortion[:4]
        text += (
            f'<camera model="Miqus Video" serial="{name}">\n'
            f'<fov_video left="8" top="4" right="{view.size[0] + 7}" bottom="{view.size[1] + 3}"/>'
            f'<transform x="{x:.17g}" y="{y:.17g}" z="{z:.17g}" {rows}/>\n'
            f'<intrinsic focalLengthU="{k[0, 0]}" focalLengthV="{k[1, 1]}" '
            f'centerPointU="{k[0, 2] + 512}" centerPointV="{k[1, 2] + 256}" '
            f'radialDistortion1="{k1}" radialDistortion2="{k2}" '
            f'tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/>\n</camera>\n'
        )
    path = folder / "Calib.qca.txt"
    path.write_text(text + "</cameras>\n</calibration>\n")
    return path


def write_anipose(folder: Path, views: Views) -> Path:
    """``calibration.toml``: millimetres, five coefficients, tables cam_0, cam_1, ..."""
    tables = [f"cam_{number}" for number in range(len(views))]
    return _write_toml(folder / "calibration.toml", views, tables, 5, 1000.0, "")


def _write_toml(
    path: Path, views: Views, tables: list[str], count: int, unit: float, more: str
) -> Path:
    text = ""
    for table, (name, view) in zip(tables, views.items(), strict=True):
        size = ", ".join(f"{float(n)}" if more else f"{n}" for n in view.size)
        rows = ", ".join(_row(row) for row in view.matrix)
        text += (
            f'[{table}]\nname = "{name}"\nsize = [ {size},]\nmatrix = [ {rows},]\n'
            f"distortions = {_row(view.distortion[:count])}\nrotation = {_row(view.turn)}\n"
            f"translation = {_row(unit * view.shift)}\n{more}\n"
        )
    path.write_text(text + "[metadata]\nadjusted = false\nerror = 0.0\n")
    return path


def _row(numbers: np.ndarray) -> str:
    return f"[ {', '.join(repr(float(number)) for number in numbers)},]"


def write_easymocap(folder: Path, views: Views, *, sizes: bool = False) -> Path:
    """``intri.yml`` and ``extri.yml`` with CRLF line ends, as EasyMocap's own writer has them."""
    names = "names:\n" + "".join(f'  - "{name}"\n' for name in views)
    lenses, poses = names, names
    for name, view in views.items():
        lenses += _matrix(f"K_{name}", view.matrix)
        lenses += _matrix(f"dist_{name}", view.distortion[None, :5])
        if sizes:
            lenses += f"H_{name}: {view.size[1]}\nW_{name}: {view.size[0]}\n"
        poses += _matrix(f"R_{name}", view.turn[:, None])
        poses += _matrix(f"Rot_{name}", view.camera_from_world[:3, :3])
        poses += _matrix(f"T_{name}", view.shift[:, None])
    for file, text in (("intri.yml", lenses), ("extri.yml", poses)):
        content = f"%YAML:1.0\n---\n{text}".replace("\n", "\r\n")
        (folder / file).write_bytes(content.encode())
    return folder


def _matrix(key: str, values: np.ndarray) -> str:
    rows, columns = values.shape
    data = ", ".join(f"{number:.6f}" for number in values.ravel())
    return f"{key}: !!opencv-matrix\n  rows: {rows}\n  cols: {columns}\n  dt: d\n  data: [{data}]\n"


def write_colmap(
    folder: Path, views: Views, *, metres: float, binary: bool, image: str = "{}/frame_000001.png"
) -> Path:
    """A sparse model whose unit is ``metres`` long; lenses are FULL_OPENCV."""
    if binary:
        lenses, images = struct.pack("<Q", len(views)), struct.pack("<Q", len(views))
    else:
        text = "# Camera list with one line of data per camera:\n"
        text += "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        shown = "# Image list with two lines of data per image:\n"
        shown += "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
        shown += "#   POINTS2D[] as (X, Y, POINT3D_ID)\n"
    for number, (name, view) in enumerate(views.items(), start=1):
        k = view.matrix
        lens = [k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5]
        lens += view.distortion.tolist()
        x, y, z, w = Rotation.from_matrix(view.camera_from_world[:3, :3]).as_quat()
        pose = [w, x, y, z, *(view.shift / metres)]
        if binary:
            lenses += struct.pack("<iiQQ12d", number, 6, *view.size, *lens)
            images += struct.pack("<i7di", number, *pose, number)
            images += image.format(name).encode() + b"\0"
            images += struct.pack("<Qddqddq", 2, 1.5, 2.5, -1, 10.0, 20.0, 7)
        else:
            width, height = view.size
            text += (
                f"{number} FULL_OPENCV {width} {height} {' '.join(map(repr, map(float, lens)))}\n"
            )
            shown += f"{number} {' '.join(map(repr, map(float, pose)))} {number} "
            shown += f"{image.format(name)}\n" + ("2362.39 248.498 58396\n" if number % 2 else "\n")
    if binary:
        (folder / "cameras.bin").write_bytes(lenses)
        (folder / "images.bin").write_bytes(images)
    else:
        (folder / "cameras.txt").write_text(text)
        (folder / "images.txt").write_text(shown)
    return folder


def write_nerfstudio(
    folder: Path, views: Views, *, metres: float, image: str = "images/{}.png"
) -> Path:
    """``transforms.json`` with a lens in each frame; its unit is ``metres`` long."""
    frames = []
    for name, view in views.items():
        pose = np.linalg.inv(view.camera_from_world) @ np.diag([1.0, -1, -1, 1])
        pose[:3, 3] /= metres
        lens = {
            "fl_x": view.matrix[0, 0], "fl_y": view.matrix[1, 1],
            "cx": view.matrix[0, 2] + 0.5, "cy": view.matrix[1, 2] + 0.5,
            "w": view.size[0], "h": view.size[1],
            **dict(zip(("k1", "k2", "p1", "p2"), view.distortion[:4].tolist(), strict=True)),
        }  # fmt: skip
        frames.append({"file_path": image.format(name), "transform_matrix": pose.tolist(), **lens})
    content = {
        "camera_model": "OPENCV",
        "frames": frames,
        "applied_transform": np.eye(4)[:3].tolist(),
    }
    path = folder / "transforms.json"
    path.write_text(json.dumps(content, indent=4))
    return path
