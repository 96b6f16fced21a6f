"""Object poses in the layout of the BOP benchmark: one scene per camera, millimetres."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.export.format import Content, ExportFormat
from intercap_core.output.export.meshes import ply
from intercap_core.output.export.motion import Coordinates
from intercap_core.output.export.silhouettes import Silhouettes

SPLIT = "test"  # folder of the scenes: in BOP, images whose poses are known
UNITS = "millimetres, radians, pixels; rotations are matrices row by row"


def object_id(mesh_path: Path) -> int:
    """Return the number that the mesh's file name starts with, else 1."""
    number = re.match(r"\d+", mesh_path.stem)
    return max(1, int(number.group())) if number else 1


def scene_folder(folder: Path, number: int) -> Path:
    """Return the folder of the scene of the rig's camera ``number``."""
    return folder / SPLIT / f"{number:06d}"


def write(folder: Path, content: Content) -> Coordinates:
    """Write ``models/``, one scene folder per camera in the rig's order, and the targets.

    An image has the number of its frame set. The image of a delayed camera shows an earlier frame,
    which ``scene_about.json`` names. Poses are those at the image's own exposure. Depth images that
    a scene folder already has determine the pixels with valid depth.
    """
    scenes, about, coordinates = (
        content.scenes,
        content.about,
        Coordinates.of(content.motion, UNITS),
    )
    assert scenes.mesh is not None and content.object_ is not None
    obj_id = object_id(content.object_.mesh)
    _write_model(folder / "models", scenes.mesh, obj_id)
    lenses: dict[str, Any] = {}
    targets = []
    for number, camera in enumerate(scenes.rig):
        scene = scene_folder(folder, number)
        scene.mkdir(parents=True, exist_ok=True)
        poses = scenes.poses[number]
        cameras, objects = _scene(camera, poses, obj_id)
        _dump(scene / "scene_camera.json", cameras)
        _dump(scene / "scene_gt.json", objects)
        lenses[scene.name] = {"camera": camera.name, **scenes.lens_of(number)}
        info: dict[str, Any] = {}
        if content.settings.masks:
            info = {
                str(drawn.image): [_write_masks(scene, drawn, camera)]
                for drawn in scenes.draw(number)
            }
            _dump(scene / "scene_gt_info.json", info)
        frame_of = scenes.frames_of(number)
        frames = {
            str(image): {"frame": frame_of[image], **about.flags.at(frame_of[image])}
            for image in poses
        }
        _dump(scene / "scene_about.json", {"camera": camera.name, "images": frames})
        targets += [
            {"scene_id": number, "im_id": image, "obj_id": obj_id, "inst_count": 1}
            for image in poses
            if not info or info[str(image)][0]["visib_fract"] >= 0.1  # as BOP 2019
        ]
    lens = scenes.rig[0].colour  # each scene has its own
    camera_json = {
        "fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy,
        "width": lens.width, "height": lens.height, "depth_scale": 1.0,
    }  # fmt: skip
    _dump(folder / "camera.json", camera_json)
    _dump(folder / "test_targets_bop19.json", targets)
    _dump(folder / "lenses.json", lenses)
    coordinates = Coordinates.of(content.motion, UNITS)
    about.write_json(folder / "about.json", coordinates)
    return coordinates


def _write_model(folder: Path, mesh: ObjectMesh, obj_id: int) -> None:
    folder.mkdir(parents=True)
    scaled = trimesh.Trimesh(
        mesh.vertices * 1e3, mesh.faces, vertex_colors=mesh.colours, process=False
    )
    lines = [f"object {mesh.name}", "frame: the object's own", "units: millimetres"]
    (folder / f"obj_{obj_id:06d}.ply").write_bytes(ply(scaled, lines))
    _dump(folder / "models_info.json", {str(obj_id): model_info(mesh)})


def _write_masks(scene: Path, drawn: Silhouettes, camera: Camera) -> dict[str, Any]:
    """Write both masks of the object in an image; return its entry of scene_gt_info.json."""
    for name, mask in (("mask", drawn.whole_object), ("mask_visib", drawn.object_)):
        (scene / name).mkdir(exist_ok=True)
        path = scene / name / f"{drawn.image:06d}_000000.png"
        path.write_bytes(cv2.imencode(".png", mask.image(camera))[1].tobytes())
    whole, visible = drawn.whole_object.area, drawn.object_.area
    valid, file = whole, scene / "depth" / f"{drawn.image:06d}.png"
    if file.is_file() and (depth := cv2.imread(str(file), cv2.IMREAD_UNCHANGED)) is not None:
        valid = int(np.count_nonzero(depth[drawn.whole_object.image(camera) > 0]))
    return {
        "bbox_obj": drawn.whole_object.box(),
        "bbox_visib": drawn.object_.box(),
        "px_count_all": whole,
        "px_count_valid": valid,
        "px_count_visib": visible,
        "visib_fract": visible / whole if whole else 0.0,
    }


def _scene(
    camera: Camera, poses: Mapping[int, np.ndarray], obj_id: int
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return scene_camera.json, lens and pose of each image, and scene_gt.json, the object's poses.

    ``cam_K`` is in pixels, row by row. The world is the master camera's frame, in millimetres.

    Args:
        poses: master_from_object (4, 4) by image number.
    """
    colour_from_master = camera.colour_from_master
    lens = {"cam_K": camera.colour.matrix.ravel().tolist(), "depth_scale": 1.0}
    lens |= _pose(colour_from_master, "w2c")
    objects = {
        str(image): [{**_pose(colour_from_master @ pose, "m2c"), "obj_id": obj_id}]
        for image, pose in poses.items()
    }
    return {str(image): lens for image in poses}, objects


def _pose(pose: np.ndarray, name: str) -> dict[str, Any]:
    return {
        f"cam_R_{name}": pose[:3, :3].ravel().tolist(),
        f"cam_t_{name}": (1e3 * pose[:3, 3]).tolist(),
    }


def model_info(mesh: ObjectMesh) -> dict[str, Any]:
    """Return size, diameter and symmetries of the model, millimetres."""
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
    elif symmetry.sphere:  # BOP has no sphere; rotations about two axes generate all
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


_README = """
bop/                split "test": one scene per camera, in the order of lenses.json; lengths in
    millimetres
  images are numbered by frame set and have poses at the time of their exposure: a camera may have
    slipped by whole sets or expose some milliseconds later; images of no frame are omitted
  scene_gt.json: cam_R_m2c, cam_t_m2c = colour camera from model, row by row
  scene_camera.json: world = {{ motion.frame }}; {{ up_of_master }}
{% if undistorted %}
  images, masks and boxes are undistorted: cam_K alone projects into them
{% else %}
  cam_K is a pinhole; images, masks and boxes are of the images as recorded, which are distorted,
    see lenses.json (OpenCV's rational model); export.undistort resamples them
{% endif %}
  camera.json is the first camera's
{% if images %}
  depth/: of the pixels of rgb/, along the camera's axis, millimetres, 0 = unknown
{% endif %}
  mask/ the whole object, mask_visib/ without what the fitted body hides; no furniture is known
  test_targets_bop19.json: images that show a tenth of the object or more
  scene_about.json of a scene: the frame that each image shows, and why it is flagged
  about.json: the body file, and the facts about each frame, below, in "by_frame"
  models/: the mesh in millimetres, with its symmetries
"""
FORMATS = (
    ExportFormat(
        name="bop",
        content="the object's poses, masks and lenses in BOP's format",
        includes="*/export/bop/**/*.json",
        media_type="application/json",
        merged="bop of all sequences as one dataset with the split test",
        readme=_README,
        write=write,
        needs_object=True,
        reads_images=True,
        draws_bodies=True,
    ),
)
