"""Synthetic captures of an object in front of a post, with few errors, as artefacts.

The post stands for the person: it hides the object from some cameras and has its own mask.
Detections are the true masks, shuffled among distractors, with wrong labels and misses.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.masks import encode
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import invert, rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.geometry.rigid.shots import Drawable
from tests.helpers.synthetic_capture import (
    COLOUR,
    COLOUR_FROM_DEPTH,
    DEPTH,
    ring_of,
    write_frames,
    write_person,
    write_scene,
)
from tests.helpers.synthetic_people import write_detections

FPS = 15.0
STAGES = ("frames", "scene", "detections", "person")
COLOUR_HALF = COLOUR.scaled(0.5)
DEPTH_LENS = DEPTH.scaled(5 / 3)  # half of NFOV's 640 x 576
Detected = list[tuple[int, str, float, bytes]]


def ring(count: int, radius: float = 2.2) -> tuple[Rig, np.ndarray]:
    """Cameras around the origin of a z-up room, and master_from_room (4, 4)."""
    rig, room_from_master = ring_of(
        count,
        radius=radius,
        height=1.5,
        target_height=0.6,
        first_angle=0.3,
        colour=COLOUR_HALF,
        depth=DEPTH_LENS,
        colour_from_depth=COLOUR_FROM_DEPTH,
    )
    return rig, invert(room_from_master)


@dataclass
class ObjectCapture:
    """Images of ``count`` frames; ``poses`` (T, 4, 4) are the true master_from_object."""

    mesh: ObjectMesh
    rig: Rig
    master_from_room: np.ndarray
    poses: np.ndarray
    label: str
    depth_noise_m: float = 0.002
    missed: set[tuple[int, int]] = field(default_factory=set)  # (t, c) without the object
    hidden: set[int] = field(default_factory=set)  # frames in which the object is not there at all
    twin: np.ndarray | None = None  # master_from_object (4, 4) of a copy that stands in the room
    speed: float = 0.03  # metres a frame
    turn_deg: float = 3.0  # a frame
    time_offset: np.ndarray = field(default_factory=lambda: np.zeros(16))  # of each camera, seconds

    @classmethod
    def make(
        cls,
        mesh: ObjectMesh,
        frames: int,
        *,
        cameras: int = 4,
        label: str = "suitcase",
        speed: float = 0.03,
        turn_deg: float = 3.0,
    ) -> ObjectCapture:
        """The object glides and turns in front of the post, ``speed`` metres a frame."""
        rig, master_from_room = ring(cameras)
        capture = cls(
            mesh, rig, master_from_room, np.zeros((frames, 4, 4)), label,
            speed=speed, turn_deg=turn_deg,
        )  # fmt: skip
        capture.poses[:] = [capture.pose_at(t) for t in range(frames)]
        return capture

    @property
    def times(self) -> np.ndarray:
        return np.arange(len(self.poses)) / FPS

    def pose_at(self, t: float) -> np.ndarray:
        """master_from_object (4, 4), ``t`` in frames."""
        turn = Rotation.from_euler("zx", [40 + self.turn_deg * t, 8], degrees=True).as_matrix()
        place = np.array([0.25, -0.2 + self.speed * t, 0.5])
        return self.master_from_room @ rigid(turn, place)

    def image(self, t: int, c: int) -> tuple[np.ndarray, bytes, Detected]:
        """Depth (H, W) uint16 mm, the person's RLE and candidates of one image."""
        rng = np.random.default_rng([t, c])
        camera = self.rig[c]
        depth, _ = self._draw(t, c, DEPTH_LENS, camera.depth_from_master)
        noisy = depth + rng.normal(scale=self.depth_noise_m, size=depth.shape)
        millimetres = np.where(depth > 0, np.rint(noisy * 1000), 0).astype(np.uint16)
        _, body = self._draw(t, c, COLOUR_HALF, camera.colour_from_master)
        person = encode(body == 1)
        distractor = np.zeros(body.shape, bool)
        distractor[20:60, 700:800] = True
        found = [("person", body == 1), (self.label, distractor)]
        if (t, c) not in self.missed and (body == 0).sum() > 40:
            # every third label is wrong; the score says nothing
            found.append((self.label if (t + c) % 3 else "bed", body == 0))
        if (body == 3).sum() > 40:
            found.append((self.label, body == 3))
        rng.shuffle(found)
        detected = [
            (i, label, float(rng.uniform(0.3, 1)), encode(mask))
            for i, (label, mask) in enumerate(found)
        ]
        return millimetres, person, detected

    def _draw(self, t: int, c: int, lens, camera_from_master):
        """Depth (H, W) and which body (H, W): 0 object, 1 post, 2 floor, 3 twin, -1 nothing."""
        post = trimesh.creation.cylinder(radius=0.14, height=1.7, sections=24)
        floor = trimesh.creation.box((5, 5, 0.02))
        in_room = camera_from_master @ self.master_from_room
        at_post = in_room @ rigid(np.eye(3), np.array([-0.12, 0.0, 0.85]))
        at_floor = in_room @ rigid(np.eye(3), np.array([0, 0, -0.02]))
        exposed = self.pose_at(t + FPS * self.time_offset[c])
        object_pose = camera_from_master @ exposed
        if t in self.hidden:
            object_pose = camera_from_master @ rigid(np.eye(3), np.array([0, 0, 50.0]))
        scene = [
            Drawable(self.mesh.vertices, self.mesh.faces, object_pose),
            Drawable(np.asarray(post.vertices), np.asarray(post.faces), at_post),
            Drawable(*_tiles(floor), at_floor),
        ]
        if self.twin is not None:
            own = self.mesh.vertices, self.mesh.faces
            scene.append(Drawable(*own, camera_from_master @ self.twin))
        image = render_scene(scene, lens)
        depth = np.zeros((lens.height, lens.width), np.float32)
        body = np.full((lens.height, lens.width), -1, np.int16)
        depth[image.window], body[image.window] = image.depth, image.body
        return depth, body

    def write(self, folder: Path) -> dict[str, Path]:
        """The artefacts that the stage reads: frames, scene, detections, person."""
        count, cameras = len(self.poses), len(self.rig)
        images = [[self.image(t, c) for c in range(cameras)] for t in range(count)]
        paths = {stage: folder / f"{stage}.h5" for stage in STAGES}
        shape = (count, cameras, 135)
        write_frames(
            paths["frames"], self.rig, num_sets=count,
            depths=[np.stack([images[t][c][0] for t in range(count)]) for c in range(cameras)],
            colour_index=np.full(shape[:2], -1),
        )  # fmt: skip
        write_scene(
            paths["scene"], self.rig, self.times,
            [np.zeros((DEPTH_LENS.height, DEPTH_LENS.width), np.uint16)] * cameras,
            zup_from_master=invert(self.master_from_room), time_offset=self.time_offset[:cameras],
        )  # fmt: skip
        write_detections(
            paths["detections"], self.rig, [[[]] * cameras] * count,
            {(t, c): [(label, rle) for _, label, _, rle in images[t][c][2]]
             for t in range(count) for c in range(cameras)},
        )  # fmt: skip
        write_person(
            paths["person"], self.rig,
            [images[t][c][1] for t in range(count) for c in range(cameras)],
            joints=np.full((count, 135, 3), np.nan), joint_error=np.full((count, 135), np.nan),
        )  # fmt: skip
        return paths


def _tiles(mesh: trimesh.Trimesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces with short edges: a face that reaches behind a camera is not drawn."""
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, 0.5)
    return np.asarray(vertices), np.asarray(faces)
