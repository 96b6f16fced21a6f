"""Settings and tables of a project with one plain recording whose camera poses are unknown."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Rig
from intercap_core.project import Project, load_project
from tests.helpers.synthetic_capture import COLOUR_FROM_DEPTH, DEPTH, ring_of
from tests.helpers.synthetic_people import seen_by, walker

SIZE = (640, 480)
LENS = Intrinsics(
    *SIZE, 430.0, 431.0, 321.0, 237.0, np.array([0.06, -0.12, 1e-4, -2e-4, 0.04, 0, 0, 0])
)
FPS = 15


def small_ring(cameras: int = 3, radius: float = 2.6) -> tuple[Rig, np.ndarray]:
    """Colour cameras of 640 x 480 around a room, and zup_from_master (4, 4)."""
    rig, zup_from_master = ring_of(
        cameras, radius=radius, height=1.6, target_height=0.9, colour=LENS, depth=DEPTH,
        colour_from_depth=COLOUR_FROM_DEPTH,
    )  # fmt: skip
    colour = tuple(replace(camera, depth=None, colour_from_depth=None) for camera in rig)
    return Rig(colour), zup_from_master


def lenses_of(rig: Rig) -> dict[str, Any]:
    """Content of a calibration file with lenses and without poses."""
    cameras = {
        camera.name: {
            "image_size": SIZE,
            "camera_matrix": camera.colour.matrix.tolist(),
            "distortion_coefficients": camera.colour.distortion.tolist(),
        }
        for camera in rig
    }
    return {"fps": FPS, "cameras": cameras}


@dataclass(frozen=True)
class PlainProject:
    """A project on disk."""

    folder: Path

    def load(self) -> Project:
        return load_project(self.folder / "config.yaml")

    @property
    def recordings(self) -> Path:
        return self.folder / "recordings"

    @property
    def calibration(self) -> Path:
        return self.folder / "rig.json"

    def write(
        self,
        *,
        layout: str = "plain",
        settings: Mapping[str, Any] | None = None,
        height: float | None = None,
        keypoints: bool = True,
    ) -> PlainProject:
        """Write settings and tables."""
        config = {"dataset": "test", "results": str(self.folder / "results"), **(settings or {})}
        (self.folder / "config.yaml").write_text(json.dumps(config))
        (self.folder / "objects.yaml").write_text("{}\n")
        (self.folder / "subjects.tsv").write_text(
            f"subject\tgender\theight\np\tneutral\t{height or ''}\n"
        )
        named = self.folder / "keypoints" if keypoints else ""
        (self.folder / "sequences.tsv").write_text(
            "sequence\tsubject\tobject\tlayout\trecordings\tcalibration\tkeypoints\n"
            f"walk\tp\t\t{layout}\t{self.recordings}\t{self.calibration}\t{named}\n"
        )
        return self


def write_walk(
    folder: Path, rig: Rig, zup_from_master: np.ndarray, *, sets: int = 60,
    people: np.ndarray | None = None, noise_px: float = 1.0,
) -> PlainProject:  # fmt: skip
    """A recording of grey images with keypoints (T, C, 135, 3) of a walking person."""
    if people is None:
        people = seen_by(walker(np.arange(sets) / FPS), rig, zup_from_master)
    rng = np.random.default_rng(8)
    for c, camera in enumerate(rig):
        images, files = (folder / name / camera.name for name in ("recordings", "keypoints"))
        images.mkdir(parents=True)
        files.mkdir(parents=True)
        image = np.full((SIZE[1], SIZE[0], 3), 60 + 30 * c, np.uint8)
        grey = cv2.imencode(".jpg", image)[1].tobytes()
        for t in range(sets):
            body = people[t, c, :25].copy()
            body[:, :2] += rng.normal(0, noise_px, (25, 2))
            inside = ((body[:, :2] > 0) & (body[:, :2] < SIZE)).all(1)
            body[~inside] = 0.0
            person = [{"pose_keypoints_2d": body.round(3).ravel().tolist()}] if inside.any() else []
            (images / f"{t:06d}.jpg").write_bytes(grey)
            (files / f"{t:06d}_keypoints.json").write_text(json.dumps({"people": person}))
    (folder / "lenses.json").write_text(json.dumps(lenses_of(rig)))
    return PlainProject(folder).write()
