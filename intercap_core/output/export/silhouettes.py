"""Silhouettes of body and object in the images of a rig, with mutual occlusion.

They are rendered through the lens of each image: with distortion for images as recorded, and by a
pinhole for undistorted images.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from intercap_core.disk import DiskList
from intercap_core.geometry.camera.masks import encode_window
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply_step, rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render, render_scene
from intercap_core.geometry.rigid.shots import Drawable, Rendering
from intercap_core.geometry.solve.time_series import rigid_velocity
from intercap_core.output.export.motion import Motion, posed_batches


@dataclass(frozen=True, eq=False)
class Mask:
    """Mask of an image, stored as the window that contains all set pixels."""

    x0: int
    """Column of the window's left edge in the image."""
    y0: int
    """Row of the window's upper edge in the image."""
    pixels: np.ndarray
    """(h, w) bool; pixel [0, 0] is image pixel (x0, y0)."""

    @property
    def area(self) -> int:
        """Number of set pixels."""
        return int(np.count_nonzero(self.pixels))

    def box(self) -> list[int]:
        """Return x, y, width, height of the set pixels; all -1 (BOP's convention) if none is."""
        if not self.pixels.any():
            return [-1, -1, -1, -1]
        x, y, width, height = cv2.boundingRect(self.pixels.astype(np.uint8))
        return [x + self.x0, y + self.y0, width, height]

    def rle(self, camera: Camera) -> bytes:
        """Encode as COCO's compressed run lengths of the whole image."""
        lens = camera.colour
        return encode_window(self.pixels, self.x0, self.y0, lens.height, lens.width)

    def image(self, camera: Camera) -> np.ndarray:
        """Return the whole image (H, W) uint8, 255 where the mask is set."""
        image = np.zeros((camera.colour.height, camera.colour.width), np.uint8)
        height, width = self.pixels.shape
        image[self.y0 : self.y0 + height, self.x0 : self.x0 + width][self.pixels] = 255
        return image


@dataclass(frozen=True, eq=False)
class Silhouettes:
    """Body and object in one image of a camera."""

    image: int
    """Number of the image (its frame set)."""
    t: int
    """Frame that the image shows."""
    pose: np.ndarray
    """(4, 4) master_from_object at the time of exposure."""
    body: Mask
    """Visible part of the body."""
    object_: Mask
    """Visible part of the object."""
    whole_object: Mask
    """The object without occlusion by the body."""
    depth: np.ndarray
    """(h, w) depth of the visible surface, metres, in the window of ``body``; 0 = background."""


@dataclass(frozen=True, eq=False)
class Scenes:
    """A motion in the master camera's frame with the images that show its T frames."""

    motion: Motion
    """The motion, in the master camera's frame."""
    rig: Rig
    """The cameras, with the lenses of the exported images."""
    mesh: ObjectMesh | None
    """None without an object."""
    image_of: np.ndarray
    """(T, C) number of each camera's image that shows each frame, -1 = none."""
    times: np.ndarray
    """(T,) seconds."""
    time_offset: np.ndarray
    """(C,) seconds by which each camera exposes later."""
    bodies: Sequence[np.ndarray]
    """Vertices (V, 3) of the body in each frame, master frame; empty if no format needs them."""

    @cached_property
    def poses(self) -> list[dict[int, np.ndarray]]:
        """For each camera, master_from_object (4, 4) by image number at the time of exposure.

        NaN if the object has no pose.
        """
        poses = rigid(self.motion.rotation, self.motion.translation)
        known = np.isfinite(poses).all(axis=(1, 2))
        twist = np.zeros((len(self.motion), 6))
        twist[known] = rigid_velocity(poses[known], np.ones(known.sum(), bool), self.times[known])
        result = []
        for number in range(len(self.rig)):
            exposed = apply_step(poses, self.time_offset[number] * twist)
            result.append({i: exposed[t] for i, t in sorted(self.frames_of(number).items())})
        return result

    def lens_of(self, number: int) -> dict[str, Any]:
        """Return size, pinhole matrix (9,) row by row and distortion (8,) of a camera for JSON."""
        lens = self.rig[number].colour
        return {
            "width": lens.width,
            "height": lens.height,
            "cam_K": lens.matrix.ravel().tolist(),
            "distortion_k1_k2_p1_p2_k3_k4_k5_k6": lens.distortion.tolist(),
        }

    @property
    def undistorted(self) -> bool:
        """Whether the lenses of all images are pinholes."""
        return not any(camera.colour.distortion.any() for camera in self.rig)

    def frames_of(self, number: int) -> dict[int, int]:
        """Map the image numbers of a camera to the frames that they show."""
        images = enumerate(self.image_of[:, number])
        return {int(image): t for t, image in images if image >= 0}

    def draw(self, number: int) -> Iterator[Silhouettes]:
        """Draw all images of a camera.

        The object has its pose at the time of exposure. The body has its pose in the frame, some
        milliseconds earlier or later.
        """
        camera, mesh, frame_of = self.rig[number], self.mesh, self.frames_of(number)
        faces = self.motion.model.faces.numpy()
        for image, pose in self.poses[number].items():
            t = frame_of[image]
            drawn = [Drawable(self.bodies[t], faces, camera.colour_from_master)]
            empty = Mask(0, 0, np.zeros((0, 0), bool))
            whole = empty
            if mesh is not None and np.isfinite(pose).all():
                placed = camera.colour_from_master @ pose
                drawn.append(Drawable(mesh.vertices, mesh.faces, placed, mesh.watertight))
                alone = render(
                    mesh.vertices, mesh.faces, camera.colour, placed, cull_back=mesh.watertight
                )
                whole = Mask(alone.x0, alone.y0, alone.mask)
            both = render_scene(drawn, camera.colour)
            object_ = _visible_part(both, 1) if len(drawn) > 1 else empty
            yield Silhouettes(image, t, pose, _visible_part(both, 0), object_, whole, both.depth)


def body_vertices(motion: Motion, folder: Path) -> DiskList[np.ndarray]:
    """Compute the body's vertices (V, 3) float32 of each frame in the motion's frame.

    They are kept in a temporary file in ``folder``: 18,000 frames have 2.3 GB.
    """
    bodies: DiskList[np.ndarray] = DiskList(folder)
    for posed in posed_batches(motion.model, motion.parameters):
        for vertices in posed.vertices.numpy():
            bodies.append(vertices)
    return bodies


def _visible_part(rendering: Rendering, number: int) -> Mask:
    """Pixels in which the drawable ``number`` (0 = body, 1 = object) is the nearest surface."""
    return Mask(rendering.x0, rendering.y0, rendering.body == number)
