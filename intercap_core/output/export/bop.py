"""Object poses in the BOP benchmark's layout: one scene a camera, millimetres."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.export.about import About
from intercap_core.output.export.meshes import ply
from intercap_core.output.export.motion import Coordinates, Motion
from intercap_core.output.export.silhouettes import Exposures, Shown, frames_of, images_of

UNITS = "millimetres, radians, pixels; rotations are matrices row by row"
LEAST_VISIBLE = 0.1  # share of an object that is seen, of BOP's targets (BOP Challenge 2019)


def object_id(mesh_path: Path) -> int:
    """BOP numbers its objects: the number that the mesh's file name starts with, or 1."""
    number = re.match(r"\d+", mesh_path.stem)
    return max(1, int(number.group())) if number else 1


def write(
    folder: Path,
    motion: Motion,
    rig: Rig,
    mesh: ObjectMesh,
    obj_id: int,
    exposures: Exposures,
    about: About,
    bodies: np.ndarray | None,
    poses: Sequence[dict[int, np.ndarray]],
) -> None:
    """Write ``models/``, one scene folder a camera, numbered in the rig's order, and the targets.

    Images are numbered by their frame set; each has the pose at its own exposure (``poses`` by
    camera and image, see :func:`.silhouettes.object_poses`). With ``bodies`` (T, V, 3) masks and
    boxes are drawn, with what the body hides. ``motion`` is in the master camera's frame.
    """
    _write_model(folder / "models", mesh, obj_id)
    lenses: dict[str, Any] = {}
    targets = []
    for number, camera in enumerate(rig):
        scene = folder / "scenes" / f"{number:06d}"
        scene.mkdir(parents=True)
        shown = poses[number]
        _dump(scene / "scene_camera.json", scene_camera(camera, list(shown)))
        _dump(scene / "scene_gt.json", scene_gt(camera, shown, obj_id))
        lens = camera.colour
        lenses[f"{number:06d}"] = {
            "camera": camera.name,
            "width": lens.width,
            "height": lens.height,
            "distortion_k1_k2_p1_p2_k3_k4_k5_k6": lens.distortion.tolist(),
        }
        if number == 0:
            _dump(folder / "camera.json", _camera(camera))
        info: dict[str, Any] = {}
        if bodies is not None:
            images = images_of(camera, number, motion, bodies, mesh, shown, exposures)
            info = {str(one.image): [_draw(scene, one, camera)] for one in images}
            _dump(scene / "scene_gt_info.json", info)
        frame_of = frames_of(exposures, number)
        shows = {
            str(image): {"frame": frame_of[image], "flagged": about.flags[frame_of[image]]}
            for image in shown
        }
        _dump(scene / "scene_about.json", {"camera": camera.name, "images": shows})
        targets += [
            {"scene_id": number, "im_id": image, "obj_id": obj_id, "inst_count": 1}
            for image in shown
            if not info or info[str(image)][0]["visib_fract"] >= LEAST_VISIBLE
        ]
    _dump(folder / "test_targets_bop19.json", targets)
    _dump(folder / "lenses.json", lenses)
    text = about.text(Coordinates.of(motion, UNITS))
    (folder / "about.json").write_text(text, encoding="utf-8")


def _write_model(folder: Path, mesh: ObjectMesh, obj_id: int) -> None:
    folder.mkdir(parents=True)
    scaled = trimesh.Trimesh(
        mesh.vertices * 1e3, mesh.faces, vertex_colors=mesh.colours, process=False
    )
    lines = [f"object {mesh.name}", "frame: the object's own", "units: millimetres"]
    (folder / f"obj_{obj_id:06d}.ply").write_bytes(ply(scaled, lines))
    _dump(folder / "models_info.json", {str(obj_id): model_info(mesh)})


def _camera(camera: Camera) -> dict[str, Any]:
    """BOP's camera.json holds one lens: the first camera's; each scene's own is in its scene."""
    lens = camera.colour
    return {
        "fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy,
        "width": lens.width, "height": lens.height, "depth_scale": 1.0,
    }  # fmt: skip


def _draw(scene: Path, shown: Shown, camera: Camera) -> dict[str, Any]:
    """Write both masks of the object in an image; returns its entry of scene_gt_info."""
    for name, mask in (("mask", shown.whole_object), ("mask_visib", shown.object_)):
        (scene / name).mkdir(exist_ok=True)
        path = scene / name / f"{shown.image:06d}_000000.png"
        path.write_bytes(cv2.imencode(".png", mask.image(camera))[1].tobytes())
    whole, visible = shown.whole_object.area, shown.object_.area
    return {
        "bbox_obj": shown.whole_object.box(),
        "bbox_visib": shown.object_.box(),
        "px_count_all": whole,
        "px_count_valid": whole,
        "px_count_visib": visible,
        "visib_fract": visible / whole if whole else 0.0,
    }


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
