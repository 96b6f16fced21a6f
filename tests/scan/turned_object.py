"""A virtual recording of an object that turns before a ring of depth cameras, without files."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert, rigid
from intercap_core.geometry.rigid.render import render
from intercap_core.scan.surfaces import MIN_POINTS, ViewSurface

LENS = Intrinsics(240, 200, 300.0, 300.0, 119.5, 99.5)


def ring(count: int = 6) -> Rig:
    """Cameras 1 m from the origin, alternately above and below it, that look at it."""
    cameras = []
    for c in range(count):
        angle = 2 * np.pi * c / count
        eye = np.array([np.cos(angle), np.sin(angle), 0.5 * (-1) ** c])
        z = -eye / np.linalg.norm(eye)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        pose = rigid(np.stack([x, np.cross(z, x), z], 1), eye)
        cameras.append(Camera(f"k{c}", LENS, LENS, np.eye(4), pose))
    return Rig(tuple(cameras))


@dataclass
class Images:
    """Colour images of one colour; stands in for :class:`Frames`."""

    sequence: str = "turned"
    colour_bgr: tuple[int, int, int] = (10, 20, 200)

    def colour(self, t: int, c: int) -> np.ndarray:
        return np.full((LENS.height, LENS.width, 3), self.colour_bgr, np.uint8)


@dataclass
class Turned:
    """Depth of an object with known poses before an empty background 3 m away.

    Stands in for :class:`.surfaces.Recording`. ``meshes`` are vertices and faces, ``poses`` their
    (M, T, 4, 4) poses.
    """

    meshes: list[tuple[np.ndarray, np.ndarray]]
    poses: np.ndarray
    noise_m: float = 0.0
    rig: Rig = field(default_factory=ring)
    labels: frozenset[str] = frozenset({"thing"})
    frames: Images = field(default_factory=Images)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(0)
        self.cameras = list(range(len(self.rig)))
        self._seen: dict[tuple[int, int], tuple[np.ndarray, np.ndarray, np.ndarray]] = {}

    def __len__(self) -> int:
        return self.poses.shape[1]

    def depth(self, t: int, c: int) -> np.ndarray:
        return self._view(t, c)[0]

    def surfaces(self, t: int) -> list[ViewSurface]:
        return [view for c in self.cameras if (view := self._surface(t, c)) is not None]

    def _view(self, t: int, c: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth, mask and normals in the master frame of one image."""
        if (t, c) not in self._seen:
            depth = np.full((LENS.height, LENS.width), 3.0, np.float32)
            mask = np.zeros(depth.shape, bool)
            normals = np.zeros((*depth.shape, 3), np.float32)
            for (vertices, faces), poses in zip(self.meshes, self.poses, strict=True):
                pose = self.rig[c].depth_from_master @ poses[t]
                drawn = render(vertices, faces, LENS, pose)
                rows, columns = drawn.window
                nearer = drawn.mask & (drawn.depth < depth[rows, columns])
                noise = self.rng.normal(0, self.noise_m, drawn.depth.shape)
                depth[rows, columns][nearer] = (drawn.depth + noise)[nearer]
                mask[rows, columns] |= nearer
                a, b, d = (vertices[faces[:, k]] for k in range(3))
                normal = np.cross(b - a, d - a)
                normal /= np.linalg.norm(normal, axis=1, keepdims=True)
                normals[rows, columns][nearer] = (normal @ poses[t][:3, :3].T)[drawn.face[nearer]]
            self._seen[t, c] = depth, mask, normals
        return self._seen[t, c]

    def _surface(self, t: int, c: int) -> ViewSurface | None:
        depth, mask, normals = self._view(t, c)
        pixels = np.flatnonzero(mask)
        if len(pixels) < MIN_POINTS:
            return None
        rays = LENS.rays.reshape(-1, 2)[pixels]
        z = depth.ravel()[pixels]
        local = np.column_stack([rays * z[:, None], z])
        points = apply(self.rig[c].master_from_depth, local).astype(np.float32)
        return ViewSurface(c, pixels, points, normals.reshape(-1, 3)[pixels], pixels)


def turning(count: int, step_deg: float, path: np.ndarray | None = None) -> np.ndarray:
    """Poses (T, 4, 4) that turn about an oblique axis and move along ``path`` (T, 3), metres."""
    axis = np.array([0.6, 0.64, 0.48])
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(
        np.radians(step_deg) * np.arange(count)[:, None] * axis
    ).as_matrix()
    if path is not None:
        poses[:, :3, 3] = path
    return poses


def relative(poses: np.ndarray, first: int, t: int) -> np.ndarray:
    """Motion (4, 4) in the object's frame between two frame sets."""
    return invert(poses[first]) @ poses[t]
