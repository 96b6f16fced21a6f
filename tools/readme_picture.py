"""The README's picture: image, result and truth of virtual recordings, with the errors.

python tools/readme_picture.py SETTINGS docs/pictures/accuracy.jpg SEQUENCE...

Needs the results up to stage `metrics`. Shows the middle of the contact, in the camera that sees
most, and the errors of this frame.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from intercap_core import artefacts
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.output.site.closeups import Column, read_handling
from intercap_core.output.site.drawing import ColouredMesh, put_text
from intercap_core.output.site.overlays import (
    BODY_COLOUR,
    OBJECT_COLOUR,
    choose_cameras,
    draw_over,
    middle_of_contact,
)
from intercap_core.project import Project, load_project
from intercap_core.schemas import JOINT, SCENE

ROWS, STRIP, GAP = 400, 44, 6  # heights of picture and caption, space between pictures, pixels
QUALITY = 85


def main(settings: Path, output: Path, names: list[str]) -> None:
    """Draw three pictures of each sequence in a row."""
    project = load_project(settings)
    picture = np.hstack([panel for name in names for panel in panels(project, name)])
    cv2.imwrite(str(output), picture[:, :-GAP], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    print(f"{output}: {output.stat().st_size / 1000:.0f} kB")


def panels(project: Project, name: str) -> list[np.ndarray]:
    """Image, result and truth (H, W, 3), blue first, with captions below."""
    paths = project.paths(name)
    measured = SequenceMetrics.read(paths.metrics)
    handling = read_handling(paths, project.models(name), truth=project.sequences[name].truth)
    with artefacts.read(paths.scene, SCENE) as scene, artefacts.read(paths.joint, JOINT) as joint:
        rig = Rig.from_artefact(scene).moved(joint["master_from_colour"])
        image_of = scene["image_of"]
    t = middle_of_contact(measured)
    errors = {key: measured.values[f"truth/joint/{key}"][t] for key in (
        "body_pve", "object_translation", "object_rotation")}  # fmt: skip
    faces = handling.model.faces.numpy()
    fitted, true = (Posed(column, faces) for column in handling.columns[-2:])
    drawn = []
    with Frames.open(paths.frames) as opened:
        images = opened.showing(image_of)
        c = choose_cameras(fitted, rig, [t], 1)[0]
        for column, opacity in ((fitted, 0.0), (fitted, 0.75), (true, 0.75)):
            drawn.append(
                draw_over(images, rig, c, {t: column.at(t)}, rows=ROWS, opacity=opacity)[t]
            )
    captions = (
        (f"virtual recording, camera {rig.names[c]}", f"{name}, frame {t}"),
        (f"result: body {1e3 * errors['body_pve']:.1f} mm off,",
         f"object {1e3 * errors['object_translation']:.1f} mm, "
         f"{errors['object_rotation']:.1f} degrees"),
        ("truth", ""),
    )  # fmt: skip
    return [_captioned(rgb, lines) for rgb, lines in zip(drawn, captions, strict=True)]


@dataclass(frozen=True)
class Posed:
    """The meshes of a result, for :func:`choose_cameras`."""

    column: Column
    faces: np.ndarray

    def at(self, t: int) -> list[ColouredMesh]:
        """Body and object in a frame."""
        pair = self.column.at(t)
        return [
            ColouredMesh(pair.body, self.faces, np.eye(4), colours=BODY_COLOUR),
            ColouredMesh(pair.vertices, pair.mesh.faces, np.eye(4), colours=OBJECT_COLOUR),
        ]


def _captioned(rgb: np.ndarray, lines: tuple[str, str]) -> np.ndarray:
    """Picture (H, W, 3) in bytes, blue first, with a strip of two lines below and a gap."""
    bgr = np.rint(np.clip(rgb[..., ::-1], 0, 1) * 255).astype(np.uint8)
    width = round(bgr.shape[1] * ROWS / bgr.shape[0])
    sheet = np.full((ROWS + STRIP, width + GAP, 3), 255, np.uint8)
    sheet[:ROWS, :width] = cv2.resize(bgr, (width, ROWS), interpolation=cv2.INTER_AREA)
    for row, line in enumerate(lines):
        put_text(sheet[:, :width], line, (2, ROWS + 17 + 19 * row), 0.44, (30, 30, 30))
    return sheet


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:])
