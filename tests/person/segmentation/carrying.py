"""A person of round bones who carries a box past a stool, as depth cameras measure it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.synchronise import images_of_moments
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.geometry.rigid.shots import Drawable
from intercap_core.object_track.reduced_mask import reduced_lens
from intercap_core.scene.background import camera_background
from tests.helpers.synthetic_capture import (
    FURNITURE,
    ring,
    room_depth,
    to_millimetres,
    write_frames,
    write_scene,
)
from tests.helpers.synthetic_people import stick_person

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

    The box rests on the floor next to the path for ``rests`` sets, then it is at the right hand.
    """

    sets: int = 14
    rests: int = 4
    views: int = 4

    @cached_property
    def rig(self) -> Rig:
        return ring(self.views)[0]

    @cached_property
    def zup_from_master(self) -> np.ndarray:
        return ring(self.views)[1]

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

    def _draw(
        self, t: int, lens: Intrinsics, zup_from_camera: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Depth (H, W), metres, 0 = nothing, and what it shows (H, W): PERSON, BOX, SCENERY, 0."""
        at = dict(zip(KEYPOINT_NAMES, self.people[t], strict=False))
        rows = list(_BODY)
        for side in ("left", "right"):
            rows += [(f"{side}_{a}", f"{side}_{b}", r) for a, b, r in _LIMBS]
        body = trimesh.util.concatenate([_capsule(at[a], at[b], r) for a, b, r in rows])
        box = trimesh.creation.box(BOX_M).apply_translation(self.box(t))
        stool = trimesh.creation.box(bounds=STOOL)
        rest = trimesh.util.concatenate([trimesh.creation.box(bounds=b) for b in FURNITURE])
        scene = [
            Drawable(np.asarray(mesh.vertices), np.asarray(mesh.faces), invert(zup_from_camera))
            for mesh in (body, box, stool, rest)
        ]
        drawn = render_scene(scene, lens)
        depth, what = np.zeros((2, lens.height, lens.width))
        depth[drawn.window], what[drawn.window] = drawn.depth, (drawn.body + 1) % 4
        return depth, what

    @cached_property
    def depths(self) -> list[np.ndarray]:
        """(T, H, W) uint16 mm of each camera."""
        rng = np.random.default_rng(3)
        result = []
        for camera in self.rig:
            assert camera.depth is not None
            room = room_depth(camera, self.zup_from_master, FURNITURE)
            images = []
            for t in range(self.sets):
                z, _ = self._draw(t, camera.depth, self.zup_from_master @ camera.master_from_depth)
                nearer = (z > 0) & ((room == 0) | (z < room))
                images.append(to_millimetres(np.where(nearer, z, room), rng))
            result.append(np.stack(images))
        return result

    def true_masks(self, t: int, camera: Camera, step: int) -> np.ndarray:
        """What every ``step``-th colour pixel shows (h, w): PERSON, BOX, SCENERY or 0."""
        lens = reduced_lens(camera.colour, step)
        return self._draw(t, lens, self.zup_from_master @ camera.master_from_colour)[1]

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
