"""Person and object in every recorded image, as COCO writes them: masks, boxes, keypoints."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.export.about import About
from intercap_core.output.export.motion import Coordinates, Motion
from intercap_core.output.export.silhouettes import Exposures, Shown, images_of

PERSON, OBJECT = 1, 2
KEYPOINTS = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder",
    "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee",
    "right_knee", "left_ankle", "right_ankle",
)  # fmt: skip
# The same points among the 135 of the body, whose first 25 are in OpenPose's order.
_PLACES = np.array([0, 16, 15, 18, 17, 5, 2, 6, 3, 7, 4, 12, 9, 13, 10, 14, 11])
_SKELETON = [
    [16, 14], [14, 12], [17, 15], [15, 13], [12, 13], [6, 12], [7, 13], [6, 7], [6, 8], [7, 9],
    [8, 10], [9, 11], [2, 3], [1, 2], [1, 3], [2, 4], [3, 5], [4, 6], [5, 7],
]  # fmt: skip
UNITS = "pixels of the images as recorded, x right and y down, seconds"
_INSIDE_M = 0.15  # how far below the skin that is seen a point of the body may lie
_UNSEEN, _HIDDEN, _SEEN = 0, 1, 2


def write(
    path: Path,
    motion: Motion,
    rig: Rig,
    mesh: ObjectMesh | None,
    exposures: Exposures,
    about: About,
    bodies: np.ndarray,
    poses: list[dict[int, np.ndarray]],
) -> None:
    """Write ``annotations.json``'s content to ``path``.

    ``motion`` is in the master frame, as are ``bodies`` (T, V, 3) and ``poses`` by camera and
    image. Image files are named <camera>/<number>.jpg, whether they are copied or not.
    """
    keypoints = _keypoints(motion, bodies)
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for number, camera in enumerate(rig):
        shown = images_of(camera, number, motion, bodies, mesh, poses[number], exposures)
        for one in shown:
            image = {
                "id": len(images) + 1,
                "file_name": f"{camera.name}/{one.image:06d}.jpg",
                "width": camera.colour.width,
                "height": camera.colour.height,
                "camera": camera.name,
                "frame": one.t,
                "time_s": float(exposures.times[one.t] + exposures.time_offset[number]),
                "flagged": about.flags[one.t],
            }
            images.append(image)
            for entry in _annotations(one, camera, keypoints[one.t]):
                annotations.append({"id": len(annotations) + 1, "image_id": image["id"], **entry})
    categories: list[dict[str, Any]] = [
        {"id": PERSON, "name": "person", "keypoints": list(KEYPOINTS), "skeleton": _SKELETON}
    ]
    if mesh is not None:
        categories.append({"id": OBJECT, "name": mesh.name, "supercategory": "object"})
    content = {
        "info": {
            "description": motion.sequence,
            **about.told(Coordinates.of(motion, UNITS)),
        },
        "images": images,
        "annotations": annotations,
        "categories": categories,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, separators=(",", ":")) + "\n", encoding="utf-8")


def _keypoints(motion: Motion, bodies: np.ndarray) -> np.ndarray:
    """(T, 17, 3) of the bodies (T, V, 3)."""
    model, found = motion.model, []
    for t in range(len(bodies)):
        parameters = motion.parameters.frames(slice(t, t + 1))
        parameters = type(parameters)(**{k: v.to(model.dtype) for k, v in vars(parameters).items()})
        with torch.no_grad():
            found.append(model.keypoints_of(parameters)[0].numpy()[_PLACES])
    return np.stack(found)


def _annotations(shown: Shown, camera: Camera, points: np.ndarray) -> Iterator[dict[str, Any]]:
    for category, mask in ((PERSON, shown.body), (OBJECT, shown.object_)):
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
            told = _visible(shown, camera, points)
            entry["keypoints"] = [round(float(v), 2) for v in told.ravel()]
            entry["num_keypoints"] = int((told[:, 2] > 0).sum())
        yield entry


def _visible(shown: Shown, camera: Camera, points: np.ndarray) -> np.ndarray:
    """x, y and COCO's visibility (17, 3) of points in space: 2 where what is seen there lies before
    the point by no more than a body is thick, 1 where it is hidden, 0 outside of the image."""
    lens = camera.colour
    local = apply(camera.colour_from_master, points.astype(np.float64))
    found = np.zeros((len(points), 3))
    for k in np.flatnonzero(lens.inside_model(local)):
        x, y = lens.project(local[k : k + 1])[0]
        if not (-0.5 <= x < lens.width - 0.5 and -0.5 <= y < lens.height - 0.5):
            continue
        row, column = round(y) - shown.body.y0, round(x) - shown.body.x0
        state = _HIDDEN
        height, width = shown.depth.shape
        if 0 <= row < height and 0 <= column < width:
            depth = float(shown.depth[row, column])
            if depth == 0 or depth > local[k, 2] - _INSIDE_M:
                state = _SEEN
        found[k] = x, y, state
    return found
