"""A sheet of small pictures: the object as each camera saw it, and as the track has it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.masks import Runs
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render
from intercap_core.output.site.sheets import Crop, Sheet, make_sheet

TRACK_COLOUR, CANDIDATE_COLOUR = (255, 158, 46), (64, 224, 255)  # RGB
_CELL_PX = 148
_REACH = 1.35  # of the object's diameter: what a cell shows


def track_sheet(
    images: Frames,
    rig: Rig,
    mesh: ObjectMesh,
    poses: np.ndarray,
    kept: Callable[[int, int], bytes],
    frames: Sequence[int],
) -> Sheet:
    """Draw the track's outline and that of the kept candidate over crops of the images.

    ``poses`` (T, 4, 4) master_from_object; ``kept(t, c)`` the RLE of the candidate that the track
    kept in camera c, empty = none. ``images`` show each frame's moment.
    """

    def draw(camera: Camera, t: int, c: int, rgb: np.ndarray) -> np.ndarray | None:
        return _cell(camera, rgb, mesh, poses[t], kept(t, c))

    return make_sheet(images, rig, frames, _CELL_PX, draw)


def _cell(
    camera: Camera,
    rgb: np.ndarray,
    mesh: ObjectMesh,
    pose: np.ndarray,
    rle: bytes,
) -> np.ndarray | None:
    """The image around the object, enlarged to a cell, with both outlines; None: not in view."""
    lens = camera.colour
    in_camera = camera.colour_from_master @ pose
    centre = in_camera[:3, :3] @ mesh.centre_of_mass + in_camera[:3, 3]
    if centre[2] < 0.1 or not lens.sees(centre[None])[0]:
        return None
    x, y = lens.project(centre[None])[0]
    size = max(int(_REACH * mesh.diameter * lens.fx / centre[2]), 16)
    crop = Crop(int(x) - size // 2, int(y) - size // 2, size, _CELL_PX)
    cell = crop.of(rgb)
    drawn = render(mesh.vertices, mesh.faces, lens, in_camera, cull_back=mesh.watertight)
    crop.outline(cell, drawn.mask, drawn.x0, drawn.y0, TRACK_COLOUR)
    if rle:
        runs = Runs(rle, lens.height, lens.width)
        left, top, width, height = runs.box
        mask = runs.decode()[top : top + height, left : left + width]
        crop.outline(cell, mask, left, top, CANDIDATE_COLOUR)
    return cell
