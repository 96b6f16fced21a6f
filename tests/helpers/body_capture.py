"""Synthetic captures of a posed surface: the artefacts that the body's fit reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from intercap_core.body_fit.keypoint_term import pixel_residuals
from intercap_core.body_fit.term_inputs import Views
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.masks import encode
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert, rigid
from intercap_core.geometry.rigid.render import render
from tests.helpers.synthetic_capture import (
    ring_of,
    write_frames,
    write_person,
    write_scene,
)

COLOUR = Intrinsics(640, 360, 306.0, 306.0, 319.5, 179.5)
DEPTH = Intrinsics(320, 288, 252.0, 252.0, 159.5, 143.5)
BASELINE = rigid(np.eye(3), np.array([-0.032, 0.0, 0.0]))
FPS = 15.0
BACKGROUND_MM = 5000


@dataclass(frozen=True)
class Inputs:
    """Paths of the three artefacts."""

    frames: Path
    scene: Path
    person: Path


def ring(count: int, radius: float = 2.3, lens: Intrinsics = COLOUR) -> Rig:
    """Cameras at breast height around the origin of a z-up room; the first one is master."""
    return _ring(count, radius, lens)[0]


def master_from_room(radius: float = 2.3) -> np.ndarray:
    """(4,4): the z-up room of :func:`ring` in the master camera's frame."""
    return invert(_ring(1, radius, COLOUR)[1])


def _ring(count: int, radius: float, lens: Intrinsics) -> tuple[Rig, np.ndarray]:
    return ring_of(
        count,
        radius=radius,
        height=1.4,
        target_height=0.95,
        colour=lens,
        depth=DEPTH,
        colour_from_depth=BASELINE,
    )


def write_capture(
    folder: Path,
    rig: Rig,
    surface: np.ndarray,
    faces: np.ndarray,
    keypoints: np.ndarray,
    *,
    depth: bool = True,
    missing: tuple[int, ...] = (),
    seen_by: tuple[int, ...] | None = None,
    pixel_noise: np.ndarray | float = 0.0,
    depth_noise_mm: float = 0.0,
    time_offset: np.ndarray | None = None,
    seed: int = 0,
) -> Inputs:
    """Write what the cameras see of a surface (T,V,3) and of keypoints (T,135,3), master frame.

    Both may be (T,C,...): what each camera sees when it exposes, ``time_offset`` (C,) s late. In
    ``missing`` frames the person is absent; cameras not in ``seen_by`` detect no person.
    ``pixel_noise``: standard deviation or (T,C,135,2) shifts.
    """
    random = np.random.default_rng(seed)
    count, cameras = len(surface), len(rig)
    paths = Inputs(*(folder / f"{name}.h5" for name in ("frames", "scene", "person")))
    present = ~np.isin(np.arange(count), missing)
    times = np.arange(count) / FPS
    if surface.ndim == 3:
        surface, keypoints = (np.repeat(x[:, None], cameras, 1) for x in (surface, keypoints))
    shown = [[surface[t, c] if present[t] else None for t in range(count)] for c in range(cameras)]
    depths = None
    if depth:
        depths = [_depth_images(camera, seen, faces, depth_noise_mm, random)
                  for camera, seen in zip(rig, shown, strict=True)]  # fmt: skip
    none = np.full((count, cameras), -1)
    write_frames(paths.frames, rig, num_sets=count, depths=depths, colour_index=none)
    write_scene(
        paths.scene, rig, times,
        [np.full((DEPTH.height, DEPTH.width), BACKGROUND_MM, np.uint16)] * cameras,
        time_offset=np.zeros(cameras) if time_offset is None else time_offset,
    )  # fmt: skip

    observed = np.zeros((count, cameras, 135, 3))
    for c, camera in enumerate(rig):
        seen = apply(camera.colour_from_master, keypoints[:, c])
        observed[:, c, :, :2] = camera.colour.project(seen)
    noise = pixel_noise
    if not isinstance(noise, np.ndarray):
        noise = noise * random.standard_normal((count, cameras, 135, 2))
    observed[..., :2] += noise
    observed[present, ..., 2] = 0.9
    observed[~present] = 0
    seeing = range(cameras) if seen_by is None else seen_by
    observed[:, [c for c in range(cameras) if c not in seeing]] = 0
    joints = _triangulate(Rig(tuple(rig[c] for c in seeing)), observed[:, list(seeing)])
    joints[~present] = np.nan
    views = np.where(np.isfinite(joints[..., 0]), cameras, 0)
    masks = [
        _mask(camera, surface[t, c], faces) if present[t] else b""
        for t in range(count)
        for c, camera in enumerate(rig)
    ]
    write_person(
        paths.person, rig, masks, keypoints=observed, joints=joints, joint_views=views,
        person=np.where(present[:, None], 0, -1).repeat(cameras, 1).astype(int),
        inlier=(observed[..., 2] > 0) & (views > 0)[:, None], missing=~present,
    )  # fmt: skip
    return paths


def _triangulate(rig: Rig, observed: np.ndarray) -> np.ndarray:
    """(T,K,3) linear triangulation of observed (T,C,K,3)."""
    rows = []
    for c, camera in enumerate(rig):
        ray = camera.colour.unproject(observed[:, c, :, :2])
        pose = camera.colour_from_master
        for axis in range(2):
            rows.append(ray[..., axis, None] * pose[2] - pose[axis])
    a = np.stack(rows, 2)
    normal = a[..., :3].swapaxes(-1, -2) @ a[..., :3]
    right = a[..., :3].swapaxes(-1, -2) @ a[..., 3:]
    return -np.linalg.solve(normal, right)[..., 0]


def _mask(camera: Camera, vertices: np.ndarray, faces: np.ndarray) -> bytes:
    drawn = render(vertices, faces, camera.colour, camera.colour_from_master)
    return encode(drawn.full_mask(camera.colour))


def _depth_images(
    camera: Camera, surface: Sequence[np.ndarray | None], faces: np.ndarray, noise_mm: float,
    random: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """Depth (T, H, W) of surfaces (V, 3) before a distant wall; None if the person is absent."""
    images = np.full((len(surface), DEPTH.height, DEPTH.width), BACKGROUND_MM, np.uint16)
    for image, vertices in zip(images, surface, strict=True):
        if vertices is not None:
            drawn = render(vertices, faces, DEPTH, camera.depth_from_master)
            z = 1000 * drawn.depth + noise_mm * random.standard_normal(drawn.depth.shape)
            image[drawn.window][drawn.mask] = np.rint(z[drawn.mask]).astype(np.uint16)
    return images


def exact_views(points: Tensor, rig: Rig, sigma: float) -> Views:
    """Projections of keypoints (T,K,3), master frame, in all cameras, with confidence 1."""
    pose, lenses = torch.tensor(rig.colour_from_master), torch.tensor(rig.colour_parameters)
    shape = (len(points), len(rig), points.shape[1])
    views = Views(
        torch.zeros(*shape, 2).double(), torch.ones(shape).double(),
        torch.full(shape, sigma).double(), lenses, pose,
    )  # fmt: skip
    views.observed = pixel_residuals(points, views)
    return views
