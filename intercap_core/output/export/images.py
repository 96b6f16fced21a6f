"""Images in an export: as recorded, or resampled to a pinhole, and depth of the same pixels."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from intercap_core.disk import link
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.rigid.render import render
from intercap_core.output.export.bop import scene_folder
from intercap_core.output.export.format import Content
from intercap_core.output.export.silhouettes import Scenes

_PNG = b"\x89PNG"  # first bytes of a file


def undistorted(rig: Rig) -> Rig:
    """Return the rig with a pinhole as each colour lens: same size and matrix, no distortion."""
    return Rig(
        tuple(
            replace(camera, colour=replace(camera.colour, distortion=np.zeros(8))) for camera in rig
        )
    )


def name_images(frames: Frames, scenes: Scenes) -> list[dict[int, str]]:
    """Return for each camera the file names of its recorded colour images by image number."""
    return [
        {
            image: f"{image:06d}.{'png' if packet.startswith(_PNG) else 'jpg'}"
            for image in sorted(scenes.frames_of(c))
            if (packet := frames.colour_jpeg(image, c)) is not None
        }
        for c in range(len(scenes.rig))
    ]


def write(folder: Path, content: Content, formats: Collection[str]) -> None:
    """Write the colour images of bop and coco, and the depth images of bop, into an export.

    Colour images of a lens that is exported as recorded are copied byte by byte. The others are
    resampled, and are black outside the recorded image and the calibrated radius.

    Args:
        folder: folder of the export.
        formats: exported formats.
    """
    frames, scenes = content.frames, content.scenes
    assert frames is not None
    for c, (camera, exported) in enumerate(zip(content.recorded, scenes.rig, strict=True)):
        scene = scene_folder(folder / "bop", c)
        places = {"bop": scene / "rgb", "coco": folder / "coco" / camera.name}
        wanted = [place for name, place in places.items() if name in formats]
        if not wanted:
            return
        for place in wanted:
            place.mkdir(parents=True)
        resampling = Resampling(camera, exported.colour)
        for image, name in content.image_names[c].items():
            file, *others = (place / name for place in wanted)
            if resampling.changes:
                pixels = resampling.colour(frames.colour(image, c))
                packet = cv2.imencode(file.suffix, pixels)[1].tobytes()
            else:
                packet = frames.colour_jpeg(image, c) or b""
            file.write_bytes(packet)
            for other in others:
                link(file, other)
        if "bop" not in formats or camera.depth is None:
            continue
        (scene / "depth").mkdir()
        for image in scenes.frames_of(c):
            depth = frames.depth(image, c)
            if depth is not None:
                packet = cv2.imencode(".png", resampling.depth(depth))[1].tobytes()
                (scene / "depth" / f"{image:06d}.png").write_bytes(packet)


class Resampling:
    """Resampling of a camera's recorded images to the pixels of another colour lens.

    ``changes``: False if the lens is that of the recorded images.
    """

    def __init__(self, camera: Camera, lens: Intrinsics) -> None:
        self.changes = not np.array_equal(camera.colour.parameters, lens.parameters)
        self._camera, self._lens = camera, lens
        rays = np.dstack([lens.rays, np.ones((lens.height, lens.width), np.float32)])
        # rays outside the calibrated radius are NaN; -2 is outside the image
        self._columns, self._rows = np.nan_to_num(camera.colour.project(rays), nan=-2).transpose(
            2, 0, 1
        )
        self._corners = np.zeros((0, 0, 2))  # rays of the corners of the depth pixels
        if camera.depth is not None and not camera.aligned:
            grid = np.indices((camera.depth.height + 1, camera.depth.width + 1)) - 0.5
            self._corners = camera.depth.unproject(grid[::-1].transpose(1, 2, 0))[..., :2]

    def colour(self, image: Any) -> np.ndarray:
        """Resample an image (H, W, 3) uint8 by bilinear interpolation."""
        return cv2.remap(image, self._columns, self._rows, cv2.INTER_LINEAR)

    def depth(self, image: np.ndarray) -> np.ndarray:
        """Return depth (H, W) uint16, millimetres along the axis of the colour lens, 0 = unknown.

        Depth on the pixel grid of the recorded colour image is resampled by nearest neighbours.
        Otherwise each depth pixel is drawn as a square at its depth, and the nearest one is kept.

        Args:
            image: recorded depth (h, w) uint16, millimetres, 0 = unknown.
        """
        if self._camera.aligned:
            return cv2.remap(image, self._columns, self._rows, cv2.INTER_NEAREST)
        rows, columns = np.nonzero(image)
        around = [(0, 0), (0, 1), (1, 1), (1, 0)]
        xy = np.stack([self._corners[rows + y, columns + x] for y, x in around], 1)  # (N, 4, 2)
        z = np.broadcast_to(1e-3 * image[rows, columns, None, None], (len(rows), 4, 1))
        known = np.isfinite(xy).all(axis=(1, 2))
        squares = np.concatenate([xy * z, z], -1)[known]
        corners = np.arange(4 * len(squares)).reshape(-1, 4)
        faces = corners[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
        between = self._camera.colour_from_depth
        assert between is not None
        drawn = render(squares.reshape(-1, 3), faces, self._lens, between, cull_back=False)
        result = np.zeros((self._lens.height, self._lens.width), np.uint16)
        result[drawn.window] = np.rint(1e3 * drawn.depth)
        return result
