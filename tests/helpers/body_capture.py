"""A person seen by a ring of cameras, written as the artefacts that the body's fit reads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from intercap_core import artefacts
from intercap_core.artefacts import pack_ragged
from intercap_core.body_fit.keypoint_term import pixel_residuals
from intercap_core.body_fit.term_inputs import Views
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.masks import encode
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert, rigid
from intercap_core.geometry.rigid.render import render
from intercap_core.schemas import FRAMES, PERSON, SCENE
from tests.helpers.synthetic_capture import put_frame_sets, ring_of

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
    ``missing`` frames nobody is there; cameras not in ``seen_by`` detect nobody. ``pixel_noise``:
    standard deviation or (T,C,135,2) shifts.
    """
    random = np.random.default_rng(seed)
    count, cameras = len(surface), len(rig)
    paths = Inputs(*(folder / f"{name}.h5" for name in ("frames", "scene", "person")))
    present = ~np.isin(np.arange(count), missing)
    times = np.arange(count) / FPS
    if surface.ndim == 3:
        surface, keypoints = (np.repeat(x[:, None], cameras, 1) for x in (surface, keypoints))
    _write_frames(paths.frames, rig, surface, faces, times, present, depth, depth_noise_mm, random)
    _write_scene(paths.scene, rig, times, np.zeros(cameras) if time_offset is None else time_offset)

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
    offsets, runs = pack_ragged(masks)
    with artefacts.write(
        paths.person, PERSON, sequence="test", images_alone=False, chosen_by="alone", doubts=""
    ) as writer:
        writer.put("camera_names", rig.names)
        writer.put("person", np.where(present[:, None], 0, -1).repeat(cameras, 1).astype(int))
        writer.put("keypoints", observed)
        writer.put("joints", joints)
        writer.put("joint_views", views)
        writer.put("joint_error", np.zeros((count, 135)))
        writer.put("inlier", (observed[..., 2] > 0) & (views > 0)[:, None])
        writer.put("missing", ~present)
        writer.put("others", np.zeros(count, np.int32))
        writer.put("mask_offsets", offsets)
        writer.put("mask_rle", runs)
        writer.put("mask_source", np.ones((count, cameras), int))
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


def _write_frames(path, rig, surface, faces, times, present, depth, noise, random) -> None:
    count, cameras = len(times), len(rig)
    with artefacts.write(path, FRAMES, sequence="test", master="k1", fps=FPS) as writer:
        index = np.repeat(np.arange(count)[:, None], cameras, 1)
        none = np.full_like(index, -1)
        put_frame_sets(writer, rig, times, colour_index=none, depth_index=index if depth else none)
        for c, camera in enumerate(rig):
            group = f"cameras/{camera.name}"
            writer.put(f"{group}/colour", np.zeros(0, np.uint8))
            writer.put(f"{group}/colour_offsets", np.zeros(1, np.int64))
            writer.put(f"{group}/colour_time", np.zeros(0, np.int64))
            rows = writer.stream(f"{group}/depth", (DEPTH.height, DEPTH.width))
            for t in range(count if depth else 0):
                image = np.full((DEPTH.height, DEPTH.width), BACKGROUND_MM, np.uint16)
                if present[t]:
                    drawn = render(surface[t, c], faces, DEPTH, camera.depth_from_master)
                    z = 1000 * drawn.depth + noise * random.standard_normal(drawn.depth.shape)
                    image[drawn.window][drawn.mask] = np.rint(z[drawn.mask]).astype(np.uint16)
                rows.append(image[None])
            writer.put(f"{group}/depth_time", np.zeros(count if depth else 0, np.int64))


def _write_scene(path: Path, rig: Rig, times: np.ndarray, time_offset: np.ndarray) -> None:
    cameras = len(rig)
    with artefacts.write(
        path, SCENE, sequence="test", master="k1", fps=FPS, extrinsics_refined=False,
        extrinsics_converged=False, verdict="",
        ground_found=False, ground_source="none", ground_rms=float("nan"), ground_inliers=0,
    ) as writer:  # fmt: skip
        for key, values in rig.datasets().items():
            writer.put(key, values)
        for key in ("master_from_colour", "master_from_colour_start"):
            writer.put(key, rig.master_from_colour)
        writer.put("present", np.ones(cameras, bool))
        writer.put("times", times)
        writer.put("depth_bias", np.zeros(cameras))
        writer.put("camera_covariance", np.zeros((cameras, 7, cameras, 7)))
        writer.put("pairs", np.zeros((0, 2), np.int32))
        writer.put("note", [""] * cameras)
        for key in SCENE.fields:
            if key.startswith("pair_"):
                writer.put(key, np.zeros(0, int))
        writer.put("time_offset", time_offset)
        writer.put("time_offset_sigma", np.full(cameras, np.nan))
        writer.put("slip", np.zeros((len(times), cameras), np.int32))
        writer.put("image_of", np.arange(len(times))[:, None].repeat(cameras, 1))
        writer.put("ground_point", np.full(3, np.nan))
        writer.put("ground_normal", np.full(3, np.nan))
        writer.put("zup_from_master", np.eye(4))
        for name in rig.names:
            background = np.full((DEPTH.height, DEPTH.width), BACKGROUND_MM, np.uint16)
            writer.put(f"cameras/{name}/background", background)


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
