"""Synthetic captures of a person: a posed surface for the body's fit, and one who carries a box.

:func:`write_capture` renders a surface and writes the artefacts that the body's fit reads.
:class:`Carrying` is a person of round bones who carries a box past a stool, as depth cameras
measure it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import open3d as o3d
import torch
import trimesh
from torch import Tensor

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.body_fit.keypoint_term import pixel_residuals
from intercap_core.body_fit.term_inputs import Views
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.synchronise import images_of_moments
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.masks import encode
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert, rigid
from intercap_core.geometry.rigid.render import render
from intercap_core.scene.background import camera_background
from tests.helpers.synthetic_capture import (
    FURNITURE,
    ring_of,
    room_depth,
    to_millimetres,
    write_frames,
    write_person,
    write_scene,
)
from tests.helpers.synthetic_capture import ring as room_ring
from tests.helpers.synthetic_people import stick_person

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
    """Depth (T, H, W) of surfaces (V, 3) before a distant wall, None where nobody is there."""
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


BOX_M = np.array([0.22, 0.16, 0.30])
STOOL = np.array([[-0.65, 0.30, 0.0], [-0.30, 0.65, 0.42]])
PERSON, BOX, SCENERY = 1, 2, 3
# Another build than the segmentation expects, and no fingers.
_BODY = (
    ("neck", "mid_hip", 0.15), ("left_hip", "right_hip", 0.13), ("neck", "nose", 0.10),
    ("left_shoulder", "right_shoulder", 0.09), ("nose", "neck", 0.10),
    ("left_ear", "right_ear", 0.03),
)  # fmt: skip
_LIMBS = (
    ("shoulder", "elbow", 0.06), ("elbow", "wrist", 0.045), ("hip", "knee", 0.09),
    ("knee", "ankle", 0.06), ("ankle", "big_toe", 0.045), ("wrist", "wrist", 0.05),
)  # fmt: skip


@dataclass(frozen=True)
class Carrying:
    """Each set's box position (T, 3), z up, its middle; the person walks 6 cm a set.

    The box rests on the floor beside the path for ``rests`` sets, then it is at the right hand.
    """

    sets: int = 14
    rests: int = 4
    views: int = 4

    @cached_property
    def rig(self) -> Rig:
        return room_ring(self.views)[0]

    @cached_property
    def zup_from_master(self) -> np.ndarray:
        return room_ring(self.views)[1]

    @cached_property
    def people(self) -> np.ndarray:
        """(T, 135, 3), z up."""
        path = np.array([-0.4, 0, 0]) + np.arange(self.sets)[:, None] * np.array([0.06, 0, 0])
        return stick_person() + path[:, None]

    @cached_property
    def joints(self) -> np.ndarray:
        """(T, 135, 3), master frame."""
        points = apply(invert(self.zup_from_master), self.people.reshape(-1, 3))
        return points.reshape(self.people.shape)

    def box(self, t: int) -> np.ndarray:
        """Middle (3,) of the box."""
        if t < self.rests:
            return np.array([0.1, -0.75, BOX_M[2] / 2 + 0.001])
        hand = self.people[t, KEYPOINT_NAMES.index("right_wrist")]
        return hand + np.array([0.10, -0.02, -0.20])

    def _scene(self, t: int) -> o3d.t.geometry.RaycastingScene:
        at = dict(zip(KEYPOINT_NAMES, self.people[t], strict=False))
        rows = list(_BODY)
        for side in ("left", "right"):
            rows += [(f"{side}_{a}", f"{side}_{b}", r) for a, b, r in _LIMBS]
        body = trimesh.util.concatenate([_capsule(at[a], at[b], r) for a, b, r in rows])
        box = trimesh.creation.box(BOX_M)
        box.apply_translation(self.box(t))
        stool = trimesh.creation.box(bounds=STOOL)
        scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        rest = trimesh.util.concatenate([trimesh.creation.box(bounds=b) for b in FURNITURE])
        for mesh in (body, box, stool, rest):
            vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
            scene.add_triangles(
                o3d.core.Tensor(vertices.astype(np.float32)),
                o3d.core.Tensor(faces.astype(np.uint32)),
            )
        return scene

    def _cast(
        self, t: int, origin: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distance in units of ``directions`` (N, 3), z up, inf = nothing; what was hit (N,)."""
        rays = np.concatenate([np.broadcast_to(origin, directions.shape), directions], 1)
        hit = self._scene(t).cast_rays(o3d.core.Tensor(np.nan_to_num(rays).astype(np.float32)))
        what = hit["geometry_ids"].numpy().astype(np.int64)
        return hit["t_hit"].numpy(), np.where(what < 3, what + 1, 0)

    @cached_property
    def depths(self) -> list[np.ndarray]:
        """(T, H, W) uint16 mm of each camera."""
        rng = np.random.default_rng(3)
        result = []
        for camera in self.rig:
            assert camera.depth is not None
            room = room_depth(camera, self.zup_from_master, FURNITURE)
            pose = self.zup_from_master @ camera.master_from_depth
            rays = np.dstack([camera.depth.rays, np.ones(room.shape)]).reshape(-1, 3)
            images = []
            for t in range(self.sets):
                z, _ = self._cast(t, pose[:3, 3], rays @ pose[:3, :3].T)
                nearest = np.minimum(np.where(room > 0, room, np.inf), z.reshape(room.shape))
                nearest[~np.isfinite(nearest)] = 0
                images.append(to_millimetres(nearest, rng))
            result.append(np.stack(images))
        return result

    def true_masks(self, t: int, camera: Camera, step: int) -> np.ndarray:
        """What every ``step``-th colour pixel shows (h, w): PERSON, BOX, SCENERY or 0."""
        lens = camera.colour
        pixels = np.stack(
            np.meshgrid(np.arange(0, lens.width, step), np.arange(0, lens.height, step)), -1
        )
        pose = self.zup_from_master @ camera.master_from_colour
        rays = lens.unproject(pixels.reshape(-1, 2)) @ pose[:3, :3].T
        return self._cast(t, pose[:3, 3], rays)[1].reshape(pixels.shape[:2])

    def write(self, folder: Path, floor: bool = True) -> tuple[Path, Path]:
        """Frames and scene artefacts; without a ``floor`` neither it nor the vertical is known."""
        frames = write_frames(
            folder / "frames.h5", self.rig, num_sets=self.sets, depths=self.depths
        )
        return frames, self._write_scene(frames, folder / "scene.h5", floor)

    def _write_scene(self, frames: Path, path: Path, floor: bool) -> Path:
        with Frames.open(frames) as images:
            found = [camera_background(images, c, self.joints) for c in range(self.views)]
        assert all(background is not None for background in found)
        slip = np.zeros((self.sets, self.views), int)
        return write_scene(
            path, self.rig, np.arange(self.sets) / 15, [background.depth for background in found],
            zup_from_master=self.zup_from_master if floor else None, slip=slip,
            image_of=images_of_moments(slip, np.ones(slip.shape, bool)),
        )  # fmt: skip


def _capsule(a: np.ndarray, b: np.ndarray, radius: float) -> trimesh.Trimesh:
    length = float(np.linalg.norm(b - a))
    mesh = trimesh.creation.capsule(height=length, radius=radius, count=[8, 8])
    mesh.apply_translation(-mesh.bounds.mean(0))
    if length > 0:
        mesh.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], (b - a) / length))
    mesh.apply_translation((a + b) / 2)
    return mesh
