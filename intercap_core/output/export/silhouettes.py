"""What each recorded image shows of body and object, by the fit: masks that hide each other.

Drawn through each camera's own lens, so that they lie on the images as they were recorded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from intercap_core.geometry.camera.masks import encode_window
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply_step, rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render, render_scene
from intercap_core.geometry.rigid.shots import Drawable, Rendering
from intercap_core.geometry.solve.time_series import rigid_velocity
from intercap_core.output.export.motion import Motion

_BATCH = 32


@dataclass(frozen=True, eq=False)
class Exposures:
    """Which images show the motion's T frames, and when: ``image_of`` (T, C) the set whose image
    of each camera shows each frame, -1 = none; ``times`` (T,) s of the frames; ``time_offset``
    (C,) s by which each camera exposes later."""

    image_of: np.ndarray
    times: np.ndarray
    time_offset: np.ndarray


@dataclass(frozen=True, eq=False)
class Mask:
    """Part of an image: pixel [0, 0] of ``pixels`` (h, w) bool is image pixel (x0, y0)."""

    x0: int
    y0: int
    pixels: np.ndarray

    @property
    def area(self) -> int:
        """Pixels that are set."""
        return int(np.count_nonzero(self.pixels))

    def box(self) -> list[int]:
        """x, y, width, height of the set pixels; BOP's -1 where none is set."""
        rows, columns = (np.flatnonzero(self.pixels.any(axis)) for axis in (1, 0))
        if not len(rows):
            return [-1, -1, -1, -1]
        x, y = int(columns[0]) + self.x0, int(rows[0]) + self.y0
        return [x, y, int(columns[-1] - columns[0]) + 1, int(rows[-1] - rows[0]) + 1]

    def rle(self, camera: Camera) -> bytes:
        """COCO's compressed run lengths in the whole image."""
        lens = camera.colour
        return encode_window(self.pixels, self.x0, self.y0, lens.height, lens.width)

    def image(self, camera: Camera) -> np.ndarray:
        """255 where it is set, in the whole image (H, W) uint8."""
        whole = np.zeros((camera.colour.height, camera.colour.width), np.uint8)
        height, width = self.pixels.shape
        whole[self.y0 : self.y0 + height, self.x0 : self.x0 + width][self.pixels] = 255
        return whole


@dataclass(frozen=True, eq=False)
class Shown:
    """One image of a camera: its number, the frame ``t`` that it shows, ``pose`` master_from_object
    (4, 4) when it was exposed; ``body`` and ``object_`` as far as they are seen, ``whole_object``
    behind the body too; ``depth`` (h, w) metres of what is seen, in the window of ``body``."""

    image: int
    t: int
    pose: np.ndarray
    body: Mask
    object_: Mask
    whole_object: Mask
    depth: np.ndarray


def object_poses(motion: Motion, rig: Rig, exposures: Exposures) -> Iterator[dict[int, np.ndarray]]:
    """For each camera, master_from_object (4, 4) of each of its images, by the image's number, when
    it was exposed; NaN in frames without an object's pose."""
    poses = rigid(motion.rotation, motion.translation)
    known = np.isfinite(poses).all(axis=(1, 2))
    twist = np.zeros((len(motion), 6))
    twist[known] = rigid_velocity(poses[known], np.ones(known.sum(), bool), exposures.times[known])
    for number in range(len(rig)):
        seen = apply_step(poses, exposures.time_offset[number] * twist)
        yield {image: seen[t] for image, t in sorted(frames_of(exposures, number).items())}


def frames_of(exposures: Exposures, camera: int) -> dict[int, int]:
    """Which frame each image of a camera shows, by the image's number."""
    shown = enumerate(exposures.image_of[:, camera])
    return {int(image): t for t, image in shown if image >= 0}


def body_vertices(motion: Motion) -> np.ndarray:
    """(T, V, 3) float32, in the motion's frame."""
    parameters = motion.parameters.__class__(
        **{k: v.to(motion.model.dtype) for k, v in vars(motion.parameters).items()}
    )
    found = []
    with torch.no_grad():
        for first in range(0, len(motion), _BATCH):
            posed = motion.model.forward(parameters.frames(slice(first, first + _BATCH)))
            found.append(posed.vertices.numpy())
    return np.concatenate(found)


def images_of(
    camera: Camera,
    number: int,
    motion: Motion,
    bodies: np.ndarray,
    mesh: ObjectMesh | None,
    poses: dict[int, np.ndarray],
    exposures: Exposures,
) -> Iterator[Shown]:
    """What each image of a camera shows; ``motion`` and ``bodies`` are in the master frame.

    The object is where it was when the image was exposed; the body is that of the frame, which is
    some milliseconds earlier or later.
    """
    frame_of = frames_of(exposures, number)
    faces = motion.model.faces.numpy()
    for image, pose in poses.items():
        t = frame_of[image]
        drawn = [Drawable(bodies[t], faces, camera.colour_from_master)]
        nothing = Mask(0, 0, np.zeros((0, 0), bool))
        whole = nothing
        if mesh is not None and np.isfinite(pose).all():
            placed = camera.colour_from_master @ pose
            drawn.append(Drawable(mesh.vertices, mesh.faces, placed, mesh.watertight))
            alone = render(
                mesh.vertices, mesh.faces, camera.colour, placed, cull_back=mesh.watertight
            )
            whole = Mask(alone.x0, alone.y0, alone.mask)
        both = render_scene(drawn, camera.colour)
        object_ = _part(both, 1) if len(drawn) > 1 else nothing
        yield Shown(image, t, pose, _part(both, 0), object_, whole, both.depth)


def _part(rendering: Rendering, number: int) -> Mask:
    return Mask(rendering.x0, rendering.y0, rendering.body == number)
