"""Body and object drawn over the recorded images of a sequence: pictures, and a short animation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.output.site import drawing
from intercap_core.output.viewer.content import Fit

BODY_COLOUR = (0.42, 0.66, 0.92)
OBJECT_COLOUR = (1.0, 0.62, 0.18)
_PICTURES = 24  # of the animation
_ROWS, _THUMBNAIL_ROWS = 340, 144  # largest heights, pixels


@dataclass(frozen=True, eq=False)
class PosedFit(Fit):
    """The joint result of one sequence, with its object."""

    mesh: ObjectMesh | None
    """None without an object."""

    def at(self, t: int) -> list[drawing.ColouredMesh]:
        """Return body and, if there is one, object in a frame, in the master camera's frame."""
        with torch.no_grad():
            posed = self.model.forward(self.parameters.frames(slice(t, t + 1)))
        body = posed.vertices[0].numpy().astype(np.float64)
        faces = self.model.faces.numpy()
        meshes = [drawing.ColouredMesh(body, faces, np.eye(4), colours=BODY_COLOUR)]
        if self.mesh is not None:
            pose = rigid(self.rotation[t], self.translation[t])
            mesh = self.mesh
            meshes.append(
                drawing.ColouredMesh(mesh.vertices, mesh.faces, pose, colours=OBJECT_COLOUR)
            )
        return meshes


def choose_frames(residual: np.ndarray, count: int) -> list[int]:
    """Choose ``count`` evenly spread frames, among them the one with the largest residual (T,).

    NaN counts as no residual. Frames are in order of time.
    """
    total = len(residual)
    if total <= count:
        return list(range(total))
    worst = int(np.argmax(np.nan_to_num(residual, nan=-np.inf)))
    spread = [int((i + 0.5) * total / max(1, count - 1)) for i in range(count - 1)]
    chosen = {worst, *spread}  # the worst frame may be one of the spread frames
    others = [t for t in range(total) if t not in chosen]
    return sorted([*chosen, *others[: count - len(chosen)]])


def choose_cameras(fit: PosedFit, rig: Rig, frames: Sequence[int], count: int) -> list[int]:
    """Choose cameras that see most of the object, best first; of the body, if these are equal.

    Viewing directions are at least 50 degrees apart, as long as there are such cameras.
    """
    seen = np.zeros(len(rig))
    posed = [fit.at(t) for t in frames]
    for c, camera in enumerate(rig):
        lens = camera.colour.scaled(0.15)  # small images suffice to count pixels
        for meshes in posed:
            rendering = render_scene([mesh.seen_by(camera) for mesh in meshes], lens)
            seen[c] += np.count_nonzero(rendering.body == 1)
            seen[c] += 1e-3 * np.count_nonzero(rendering.body == 0)
    axes = rig.master_from_colour[:, :3, 2]
    chosen: list[int] = []
    order = np.argsort(-seen, kind="stable")
    for apart in (50.0, 0.0):  # least angle between viewing directions, degrees
        for c in order:
            far = all(axes[c] @ axes[other] < np.cos(np.radians(apart)) for other in chosen)
            if len(chosen) < count and int(c) not in chosen and (far or apart == 0.0):
                chosen.append(int(c))
    return chosen


def overlays(
    images: Frames, rig: Rig, fit: PosedFit, cameras: Sequence[int], frames: Sequence[int]
) -> dict[str, dict[int, drawing.EncodedImage]]:
    """Draw the fit over images; return them by name of the camera and frame, without missing ones.

    Args:
        images: images by the frame that they show (:meth:`Frames.showing`).
    """
    posed = {t: fit.at(t) for t in frames}
    drawn = {rig[c].name: draw_over(images, rig, c, posed, rows=420) for c in cameras}
    return {
        camera: {t: drawing.encode_jpeg(picture) for t, picture in pictures.items()}
        for camera, pictures in drawn.items()
        if pictures
    }


@dataclass(frozen=True, eq=False)
class Preview:
    """Pictures of a sequence: the result over the images of one camera."""

    animation: drawing.EncodedImage
    """The whole sequence in ``_PICTURES`` evenly spread frames, in real time."""
    still: drawing.EncodedImage
    """A frame of it, for readers who prefer no motion."""
    thumbnail: drawing.EncodedImage
    """The same frame, small, cropped to body and object."""


def middle_of_contact(measured: SequenceMetrics) -> int:
    """Return the middle of the contact frames, or of the sequence if nothing is in contact."""
    frames = list(range(len(measured)))
    if measured.has_object and measured.values["contact_frame"].any():
        frames = np.flatnonzero(measured.values["contact_frame"]).tolist()
    return frames[len(frames) // 2]


def make_preview(
    images: Frames, rig: Rig, c: int, fit: PosedFit, measured: SequenceMetrics
) -> Preview | None:
    """Draw the preview; None if camera ``c`` has no image that shows the fit.

    The still shows :func:`middle_of_contact`.

    Args:
        images: images by the frame that they show (:meth:`Frames.showing`).
    """
    total, middle = len(measured), middle_of_contact(measured)
    spread = np.linspace(0, total - 1, min(_PICTURES, total)).round().astype(int)
    frames = sorted({middle, *spread.tolist()})
    pictures = draw_over(images, rig, c, {t: fit.at(t) for t in frames}, rows=_ROWS)
    if not pictures:
        return None
    nearest = min(pictures, key=lambda t: abs(t - middle))
    small = draw_over(images, rig, c, {nearest: fit.at(nearest)}, rows=_THUMBNAIL_ROWS)
    caption = f"Result over the images of camera {rig.names[c]}"
    return Preview(
        drawing.encode_animation(list(pictures.values()), total / measured.fps, caption),
        drawing.encode_jpeg(pictures[nearest]),
        drawing.encode_jpeg(small[nearest]),
    )


def draw_over(
    images: Frames,
    rig: Rig,
    c: int,
    posed: Mapping[int, Sequence[drawing.ColouredMesh]],
    *,
    rows: int,
    opacity: float = 0.62,
) -> dict[int, np.ndarray]:
    """Draw meshes over the images of camera ``c``, cropped to the part that shows all of them.

    Args:
        images: images by the frame that they show (:meth:`Frames.showing`).
        posed: meshes by frame.
        rows: largest height of a picture, pixels.
        opacity: of the meshes, 0 to 1.

    Returns:
        RGB pictures (H, W, 3) in 0..1 by frame, all of one size; missing images are left out.
    """
    camera = rig[c]
    window = _window(camera, [mesh for meshes in posed.values() for mesh in meshes])
    if window is None:
        return {}
    x0, y0, width, height = window
    lens = camera.colour.cropped(x0, y0, width, height).scaled(min(1.0, rows / height))
    pictures = {}
    for t, meshes in posed.items():
        image = images.colour(t, c)
        if image is None:
            continue
        crop = image[y0 : y0 + height, x0 : x0 + width]
        crop = cv2.resize(crop, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
        picture = drawing.draw([mesh.seen_by(camera) for mesh in meshes], lens)
        pictures[t] = picture.over(crop[..., ::-1] / np.float32(255), opacity)
    return pictures


def _window(
    camera: Camera, meshes: Sequence[drawing.ColouredMesh]
) -> tuple[int, int, int, int] | None:
    """Return x, y, width, height of the part of the image that shows all meshes with a margin.

    None if they are not in view.
    """
    lens, seen = camera.colour, [mesh.seen_by(camera) for mesh in meshes]
    points = np.concatenate([apply(mesh.camera_from_mesh, mesh.vertices) for mesh in seen])
    points = points[lens.inside_model(points)]
    if len(points) == 0:
        return None
    pixels = lens.project(points)
    low, high = pixels.min(0), pixels.max(0)
    middle, size = (low + high) / 2, (high - low) * 1.2
    half = np.array([max(size[0], size[1] * 0.6), max(size[1], size[0] / 1.6)]) / 2
    x0, y0 = np.maximum(0, np.floor(middle - half)).astype(int).tolist()
    x1, y1 = np.minimum([lens.width, lens.height], np.ceil(middle + half)).astype(int).tolist()
    if x1 - x0 < 8 or y1 - y0 < 8:
        return None
    return x0, y0, x1 - x0, y1 - y0
