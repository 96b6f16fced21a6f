"""Masks, boxes and keypoints of person and object in every colour image, in COCO's format."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply
from intercap_core.output.export.format import Content, ExportFormat
from intercap_core.output.export.motion import Coordinates, Motion, posed_batches
from intercap_core.output.export.silhouettes import Silhouettes

PERSON, OBJECT = 1, 2
KEYPOINTS = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder",
    "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee",
    "right_knee", "left_ankle", "right_ankle",
)  # fmt: skip
# Indices of these points among the body's 135, whose first 25 are in OpenPose's order
_PLACES = np.array([0, 16, 15, 18, 17, 5, 2, 6, 3, 7, 4, 12, 9, 13, 10, 14, 11])
# Edges between these points as COCO publishes them, numbered from 1
_SKELETON = [
    [16, 14], [14, 12], [17, 15], [15, 13], [12, 13], [6, 12], [7, 13], [6, 7], [6, 8], [7, 9],
    [8, 10], [9, 11], [2, 3], [1, 2], [1, 3], [2, 4], [3, 5], [4, 6], [5, 7],
]  # fmt: skip


def _write(folder: Path, content: Content) -> Coordinates:
    """Write the annotations of all colour images.

    Names of images start with a folder named as the camera, whether or not they are exported.
    """
    scenes, about, names = content.scenes, content.about, content.image_names
    kind = "undistorted images" if scenes.undistorted else "images as recorded"
    units = f"pixels of the {kind}, x right and y down, seconds"
    coordinates = Coordinates.of(scenes.motion, units)
    keypoints = _keypoints(scenes.motion)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for number, camera in enumerate(scenes.rig):
        for drawn in scenes.draw(number):
            if drawn.image not in names[number]:
                continue  # only depth was recorded
            image = {
                "id": len(images) + 1,
                "file_name": f"{camera.name}/{names[number][drawn.image]}",
                "width": camera.colour.width,
                "height": camera.colour.height,
                "camera": camera.name,
                "frame": drawn.t,
                "time_s": float(scenes.times[drawn.t] + scenes.time_offset[number]),
                **about.flags.at(drawn.t),
            }
            images.append(image)
            for entry in _annotations(drawn, camera, keypoints[drawn.t]):
                annotations.append({"id": len(annotations) + 1, "image_id": image["id"], **entry})
    categories: list[dict[str, Any]] = [
        {"id": PERSON, "name": "person", "keypoints": list(KEYPOINTS), "skeleton": _SKELETON}
    ]
    if scenes.mesh is not None:
        categories.append({"id": OBJECT, "name": scenes.mesh.name, "supercategory": "object"})
    written = {
        "info": {
            "description": scenes.motion.sequence,
            "lenses": {camera.name: scenes.lens_of(n) for n, camera in enumerate(scenes.rig)},
            **about.to_json(coordinates),
        },
        "images": images,
        "annotations": annotations,
        "categories": categories,
    }
    text = json.dumps(written, separators=(",", ":"))
    (folder / "annotations.json").write_text(text + "\n", encoding="utf-8")
    return coordinates


def _keypoints(motion: Motion) -> np.ndarray:
    """Return COCO's keypoints (T, 17, 3) of the body, metres."""
    batches = posed_batches(motion.model, motion.parameters)
    return np.concatenate([motion.model.keypoints(posed).numpy()[:, _PLACES] for posed in batches])


def _annotations(
    drawn: Silhouettes, camera: Camera, points: np.ndarray
) -> Iterator[dict[str, Any]]:
    """Yield COCO's entries of person and object in one image, if they have a visible pixel.

    ``points``: (17, 3) keypoints in the master frame, metres.
    """
    for category, mask in ((PERSON, drawn.body), (OBJECT, drawn.object_)):
        if not mask.area:
            continue
        entry: dict[str, Any] = {
            "category_id": category,
            "iscrowd": 0,
            "area": mask.area,
            "bbox": mask.box(),
            "segmentation": {
                "size": [camera.colour.height, camera.colour.width],
                "counts": mask.rle(camera).decode("ascii"),
            },
        }
        if category == PERSON:
            keypoints = _with_visibility(drawn, camera, points)
            entry["keypoints"] = [round(float(v), 2) for v in keypoints.ravel()]
            entry["num_keypoints"] = int((keypoints[:, 2] > 0).sum())
        yield entry


def _with_visibility(drawn: Silhouettes, camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return x, y and COCO's visibility (17, 3) of points (17, 3) in the master frame.

    Visibility is 0 outside of the image, 1 = hidden, 2 = visible. A point lies inside the body, so
    it counts as visible unless the visible surface is more than 0.15 m in front of it.
    """
    lens = camera.colour
    local = apply(camera.colour_from_master, points.astype(np.float64))
    keypoints = np.zeros((len(points), 3))
    for k in np.flatnonzero(lens.sees(local)):
        x, y = lens.project(local[k : k + 1])[0]
        row, column = round(y) - drawn.body.y0, round(x) - drawn.body.x0
        visibility = 1
        height, width = drawn.depth.shape
        if 0 <= row < height and 0 <= column < width:
            depth = float(drawn.depth[row, column])
            if depth == 0 or depth > local[k, 2] - 0.15:  # half the depth of a trunk
                visibility = 2
        keypoints[k] = x, y, visibility
    return keypoints


_README = """
coco/annotations.json  person and object in every image: visible masks, boxes, COCO's 17 keypoints
  images are named <camera>/<frame set>, with the suffix of the recorded file, and are
    {{ "undistorted" if undistorted else "those recorded, distortion included" }}
  info: lenses by camera, the body file, and the facts about each frame, below; "frame" of an
    image is its frame
  keypoints: visibility 2 = visible, 1 = hidden by body or object, 0 = outside of the image
"""
FORMATS = (
    ExportFormat(
        name="coco",
        path="*/export/coco/annotations.json",
        content="masks, boxes and keypoints of person and object",
        includes="*/export/coco/annotations.json",
        media_type="application/json",
        merged="coco of all sequences as one file",
        readme=_README,
        write=_write,
        reads_images=True,
        draws_bodies=True,
    ),
)
