"""Object poses in the BOP benchmark's layout: one scene a camera, millimetres."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from intercap_core.camera.rig import Camera, Rig
from intercap_core.camera.transforms import rigid
from intercap_core.export.motion import Motion
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.rigid.twist import moved, twists


def object_id(mesh_path: Path) -> int:
    """BOP numbers its objects: the number that the mesh's file name starts with, or 1."""
    number = re.match(r"\d+", mesh_path.stem)
    return max(1, int(number.group())) if number else 1


@dataclass(frozen=True)
class Exposures:
    """Which images show the motion's T frames, and when: ``image_of`` (T, C) the set whose image
    of each camera shows each frame, -1 = none; ``times`` (T,) s of the frames; ``time_offset``
    (C,) s by which each camera exposes later."""

    image_of: np.ndarray
    times: np.ndarray
    time_offset: np.ndarray


def write(
    folder: Path,
    motion: Motion,
    rig: Rig,
    mesh: ObjectMesh,
    obj_id: int,
    exposures: Exposures,
) -> None:
    """Write ``models/`` and one scene folder a camera, numbered in the rig's order.

    Images are numbered by their frame set; each has the pose at its own exposure. ``motion`` is in
    the master camera's frame.
    """
    models = folder / "models"
    models.mkdir(parents=True)
    scaled = trimesh.Trimesh(
        mesh.vertices * 1e3, mesh.faces, vertex_colors=mesh.colours, process=False
    )
    scaled.export(models / f"obj_{obj_id:06d}.ply", vertex_normal=False)
    _dump(models / "models_info.json", {str(obj_id): model_info(mesh)})
    lenses: dict[str, Any] = {}
    poses = rigid(motion.rotation, motion.translation)
    twist = twists(poses, np.ones(len(motion), bool), exposures.times)
    for number, camera in enumerate(rig):
        scene = folder / "scenes" / f"{number:06d}"
        scene.mkdir(parents=True)
        seen = moved(poses, exposures.time_offset[number] * twist)
        images = {int(image): t for t, image in enumerate(exposures.image_of[:, number])}
        shown = {image: seen[t] for image, t in sorted(images.items()) if image >= 0}
        _dump(scene / "scene_camera.json", scene_camera(camera, list(shown)))
        _dump(scene / "scene_gt.json", scene_gt(camera, shown, obj_id))
        lenses[f"{number:06d}"] = {
            "camera": camera.name,
            "width": camera.colour.width,
            "height": camera.colour.height,
            "distortion_k1_k2_p1_p2_k3_k4_k5_k6": camera.colour.distortion.tolist(),
        }
    _dump(folder / "lenses.json", lenses)


def scene_camera(camera: Camera, images: Sequence[int]) -> dict[str, Any]:
    """Of each of the ``images``: ``cam_K`` row by row, pixels; world = the master camera, its
    translation in millimetres."""
    pose = camera.colour_from_master
    entry = {
        "cam_K": camera.colour.matrix.ravel().tolist(),
        "depth_scale": 1.0,
        "cam_R_w2c": pose[:3, :3].ravel().tolist(),
        "cam_t_w2c": (1e3 * pose[:3, 3]).tolist(),
    }
    return {str(image): entry for image in images}


def scene_gt(camera: Camera, poses: Mapping[int, np.ndarray], obj_id: int) -> dict[str, Any]:
    """``cam_R_m2c`` and ``cam_t_m2c``: colour camera from model, translation in millimetres.

    ``poses``: master_from_object (4, 4) of each image by its number.
    """
    in_camera = {image: camera.colour_from_master @ pose for image, pose in poses.items()}
    return {
        str(image): [
            {
                "cam_R_m2c": pose[:3, :3].ravel().tolist(),
                "cam_t_m2c": (1e3 * pose[:3, 3]).tolist(),
                "obj_id": obj_id,
            }
        ]
        for image, pose in in_camera.items()
    }


def model_info(mesh: ObjectMesh) -> dict[str, Any]:
    """Size, diameter and symmetries of the model, millimetres."""
    low, high = 1e3 * mesh.vertices.min(0), 1e3 * mesh.vertices.max(0)
    info: dict[str, Any] = {
        "diameter": 1e3 * mesh.diameter,
        **{f"min_{axis}": low[i] for i, axis in enumerate("xyz")},
        **{f"size_{axis}": (high - low)[i] for i, axis in enumerate("xyz")},
    }
    symmetry = mesh.symmetry
    if symmetry.axis is not None and symmetry.offset is not None:
        info["symmetries_continuous"] = [
            {"axis": symmetry.axis.tolist(), "offset": (1e3 * symmetry.offset).tolist()}
        ]
    elif symmetry.sphere:  # BOP has no sphere: turns about two axes generate every rotation
        info["symmetries_continuous"] = [
            {"axis": axis, "offset": [0.0, 0.0, 0.0]} for axis in ([0, 0, 1], [1, 0, 0])
        ]
    if len(symmetry.discrete) > 1:
        scaled = np.array(symmetry.discrete[1:])
        scaled[:, :3, 3] *= 1e3
        info["symmetries_discrete"] = scaled.reshape(-1, 16).tolist()
    return info


def _dump(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
