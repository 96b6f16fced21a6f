"""Body and object drawn over the recorded images of a sequence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.geometry.rigid.shots import Drawable
from intercap_core.output.site.drawing import ColouredMesh, EncodedImage, draw, encode_jpeg

BODY_COLOUR = (0.42, 0.66, 0.92)
OBJECT_COLOUR = (1.0, 0.62, 0.18)
_OPACITY = 0.62
_HEIGHT_PX = 420  # largest height of an overlay
_MARGIN = 0.10  # around body and object, share of the crop's size
_MIN_ASPECT, _MAX_ASPECT = 0.6, 1.6
_SURVEY_SCALE = 0.15  # of images for choosing cameras
_APART_DEG = 50.0  # least angle between the viewing directions of chosen cameras


@dataclass(frozen=True, eq=False)
class Overlay:
    """A recorded image with the fit drawn over it."""

    camera: str
    frame: int
    image: EncodedImage


class PosedFit:
    """The joint result of one sequence, posed frame by frame in the master frame."""

    def __init__(
        self,
        model: BodyModel,
        parameters: BodyParameters,
        rotation: np.ndarray,
        translation: np.ndarray,
        mesh: ObjectMesh | None,
    ) -> None:
        """``mesh`` is None without an object."""
        self._model = model
        self._parameters = parameters
        self._rotation = rotation
        self._translation = translation
        self._mesh = mesh
        self.faces = model.faces.numpy()

    def body(self, t: int) -> np.ndarray:
        """Return the body's vertices (V, 3) float64."""
        with torch.no_grad():
            posed = self._model.forward(self._parameters.frames(slice(t, t + 1)))
        return posed.vertices[0].numpy().astype(np.float64)

    @property
    def objects(self) -> tuple[ObjectMesh, ...]:
        """The object's mesh, () without an object."""
        return () if self._mesh is None else (self._mesh,)

    def object_pose(self, t: int) -> np.ndarray:
        """Return master_from_object (4, 4)."""
        return rigid(self._rotation[t], self._translation[t])

    def object_vertices(self, t: int) -> np.ndarray:
        """Return the object's vertices (Vo, 3); Vo = 0 without an object."""
        if self._mesh is None:
            return np.zeros((0, 3))
        return self._mesh.vertices @ self._rotation[t].T + self._translation[t]


def choose_frames(residual: np.ndarray, count: int) -> list[int]:
    """Choose ``count`` evenly spread frames, among them the one with the largest residual (T,).

    NaN counts as no residual. Frames are in order of time.
    """
    total = len(residual)
    if total <= count:
        return list(range(total))
    worst = int(np.argmax(np.nan_to_num(residual, nan=-np.inf)))
    spread = [int((i + 0.5) * total / max(1, count - 1)) for i in range(count - 1)]
    chosen = sorted({worst, *spread})
    for t in range(total):  # the worst frame may be one of the spread frames
        if len(chosen) >= count:
            break
        if t not in chosen:
            chosen = sorted([*chosen, t])
    return chosen


def choose_cameras(fit: PosedFit, rig: Rig, frames: Sequence[int], count: int) -> list[int]:
    """Choose cameras that see most of the object, from different sides, best first."""
    seen = np.zeros(len(rig))
    for c, camera in enumerate(rig):
        lens = camera.colour.scaled(_SURVEY_SCALE)
        for t in frames:
            rendering = render_scene(
                [
                    Drawable(fit.body(t), fit.faces, camera.colour_from_master),
                    *(
                        Drawable(
                            mesh.vertices,
                            mesh.faces,
                            camera.colour_from_master @ fit.object_pose(t),
                        )
                        for mesh in fit.objects
                    ),
                ],
                lens,
            )
            seen[c] += np.count_nonzero(rendering.body == 1)
            seen[c] += 1e-3 * np.count_nonzero(rendering.body == 0)
    axes = rig.master_from_colour[:, :3, 2]
    chosen: list[int] = []
    order = np.argsort(-seen, kind="stable")
    for apart in (_APART_DEG, 0.0):
        for c in order:
            far = all(axes[c] @ axes[other] < np.cos(np.radians(apart)) for other in chosen)
            if len(chosen) < count and int(c) not in chosen and (far or apart == 0.0):
                chosen.append(int(c))
    return chosen


def overlays(
    images: Frames,
    rig: Rig,
    fit: PosedFit,
    cameras: Sequence[int],
    frames: Sequence[int],
) -> list[Overlay]:
    """Draw the fit over images, in the order of cameras, then frames; skip missing images.

    Args:
        images: images by the frame that they show (:meth:`Frames.showing`).
    """
    result = []
    bodies = {t: fit.body(t) for t in frames}
    for c in cameras:
        camera = rig[c]
        window = _window(
            camera, [bodies[t] for t in frames], [fit.object_vertices(t) for t in frames]
        )
        if window is None:
            continue
        x0, y0, width, height = window
        scale = min(1.0, _HEIGHT_PX / height)
        lens = camera.colour.cropped(x0, y0, width, height).scaled(scale)
        for t in frames:
            image = images.colour(t, c)
            if image is None:
                continue
            crop = image[y0 : y0 + height, x0 : x0 + width]
            crop = cv2.resize(crop, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
            picture = draw(
                [
                    _coloured(bodies[t], fit.faces, BODY_COLOUR, camera.colour_from_master),
                    *(
                        _coloured(
                            mesh.vertices,
                            mesh.faces,
                            OBJECT_COLOUR,
                            camera.colour_from_master @ fit.object_pose(t),
                        )
                        for mesh in fit.objects
                    ),
                ],
                lens,
            )
            laid = picture.over(crop[..., ::-1] / np.float32(255), _OPACITY)
            result.append(Overlay(camera.name, t, encode_jpeg(laid)))
    return result


def _coloured(
    vertices: np.ndarray,
    faces: np.ndarray,
    colour: tuple[float, ...],
    pose: np.ndarray,
) -> ColouredMesh:
    colours = np.broadcast_to(np.array(colour), (len(vertices), 3))
    return ColouredMesh(vertices, faces, colours, pose)


def _window(
    camera: Camera,
    bodies: Sequence[np.ndarray],
    objects: Sequence[np.ndarray],
) -> tuple[int, int, int, int] | None:
    """Return x, y, width, height of the image part that shows body and object in all frames.

    None if they are not in view.
    """
    lens, pose = camera.colour, camera.colour_from_master
    points = np.concatenate([*bodies, *objects]) @ pose[:3, :3].T + pose[:3, 3]
    points = points[lens.inside_model(points)]
    if len(points) == 0:
        return None
    pixels = lens.project(points)
    low, high = pixels.min(0), pixels.max(0)
    middle, size = (low + high) / 2, (high - low) * (1 + 2 * _MARGIN)
    width = max(size[0], size[1] * _MIN_ASPECT)
    height = max(size[1], size[0] / _MAX_ASPECT)
    x0, y0 = (
        int(max(0, np.floor(m - s / 2))) for m, s in zip(middle, (width, height), strict=True)
    )
    x1 = int(min(lens.width, np.ceil(middle[0] + width / 2)))
    y1 = int(min(lens.height, np.ceil(middle[1] + height / 2)))
    if x1 - x0 < 8 or y1 - y0 < 8:
        return None
    return x0, y0, x1 - x0, y1 - y0
