"""Synthetic captures of an object: one with few errors, as artefacts, and one with all errors.

In :class:`ObjectCapture`, a post stands for the person: it hides the object from some cameras and
has its own mask. Detections are the true masks, shuffled among distractors, with wrong labels and
misses.

In :class:`HarshCapture`, a person-like figure takes an object, moves and turns it. A twin of the
object stands in the room and is visible in every view. Detections miss the object the more often
the more it is hidden, have wrong labels and moved borders, and merge person and object; some views
are blocked for many frames. Calibration, depth and mesh err as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.masks import encode
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import invert, rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.geometry.rigid.shots import Drawable, Rendering
from intercap_core.object_track.view import View, ViewGeometry
from tests.helpers.synthetic_capture import (
    COLOUR,
    COLOUR_FROM_DEPTH,
    DEPTH,
    looking_at,
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
        rng.shuffle(found)
        detected = [
            (i, label, float(rng.uniform(0.3, 1)), encode(mask))
            for i, (label, mask) in enumerate(found)
        ]
        return millimetres, person, detected

    def _draw(self, t: int, c: int, lens, camera_from_master):
        """Depth (H, W) and which body (H, W): 0 object, 1 post, 2 floor, -1 nothing."""
        post = trimesh.creation.cylinder(radius=0.14, height=1.7, sections=24)
        floor = trimesh.creation.box((5, 5, 0.02))
        in_room = camera_from_master @ self.master_from_room
        at_post = in_room @ rigid(np.eye(3), np.array([-0.12, 0.0, 0.85]))
        at_floor = in_room @ rigid(np.eye(3), np.array([0, 0, -0.02]))
        exposed = self.pose_at(t + FPS * self.time_offset[c])
        object_pose = camera_from_master @ exposed
        if t in self.hidden:
            object_pose = camera_from_master @ rigid(np.eye(3), np.array([0, 0, 50.0]))
        image = render_scene(
            [
                Drawable(self.mesh.vertices, self.mesh.faces, object_pose),
                Drawable(np.asarray(post.vertices), np.asarray(post.faces), at_post),
                Drawable(*_tiles(floor), at_floor),
            ],
            lens,
        )
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


WRONG = ("bed", "person", "tv", "bottle", "chair", "cup")
OBJECT, FIGURE, TWIN, FLOOR = range(4)


@dataclass
class HarshCapture:
    """``count`` frames of one object; the fields set the errors.

    ``poses`` (T, 4, 4) true master_from_object; ``joints`` (T, 135, 3) of the figure, master frame;
    ``rig`` the cameras as the tracker believes them to be.
    """

    mesh: ObjectMesh
    count: int
    seed: int = 0
    cameras: int = 6
    label: str = "suitcase"
    twin: bool = True
    depth: bool = True
    named: bool = True  # False: blobs of the foreground without a label
    wrong_labels: float = 0.3
    missed: tuple[float, float] = (0.1, 0.6)  # share of the views in the open, and nearly hidden
    merged: float = 0.1
    border_px: float = 5.0
    blocked: int = 2  # views at a time, for ten frames each
    still: float = 0.3  # share of the frames before it is taken
    gone: frozenset[int] = field(default_factory=frozenset)  # frames without object

    def __post_init__(self) -> None:
        rng = np.random.default_rng([self.seed, 1])
        poses = []
        for i in range(self.cameras):
            angle = 2 * np.pi * i / max(self.cameras, 4) + 0.3
            eye = np.array([2.4 * np.cos(angle), 2.4 * np.sin(angle), 1.6])
            poses.append(looking_at(eye, np.array([0, 0, 0.7])))
        self.master_from_room = invert(poses[0])
        self._true, believed = [], []
        for i, pose in enumerate(poses):
            exact = self.master_from_room @ pose
            error = rigid(
                Rotation.from_rotvec(rng.normal(scale=0.001, size=3)).as_matrix(),
                rng.normal(scale=0.002, size=3),
            )
            self._true.append(exact)
            wrong = exact if i == 0 else exact @ error
            believed.append(Camera(f"k{i + 1}", COLOUR, DEPTH_LENS, COLOUR_FROM_DEPTH, wrong))
        self.rig = Rig(tuple(believed))
        self._bias = rng.normal(scale=0.004, size=self.cameras)
        self._shape = trimesh.Trimesh(self.mesh.vertices * 1.005, self.mesh.faces, process=False)
        self._blocked = [
            set(rng.permutation(self.cameras)[: self.blocked].tolist())
            for _ in range(self.count // 10 + 1)
        ]
        self._heading = float(rng.uniform(0, 2 * np.pi))
        self._tilt = rng.normal(size=3)
        self._twin_at = float(rng.uniform(0, 2 * np.pi))
        rooms = [self._room_pose(t) for t in range(self.count)]
        self.poses = np.array([self.master_from_room @ room for room in rooms])
        self.joints = np.array([self._joints(t) for t in range(self.count)])

    # --- the scene -----------------------------------------------------------------------------

    def _room_pose(self, t: int) -> np.ndarray:
        """The object stands, is lifted, turned about all axes and carried."""
        moving = max(0.0, t / self.count - self.still) * self.count / FPS  # seconds
        height = -float(self.mesh.vertices[:, 2].min())
        small = self.mesh.radius < 0.2
        lift = 0.35 * (1 - np.cos(min(2.0 * moving, np.pi))) / 2
        tilt = np.radians(50) * np.sin(1.3 * moving)
        turn = (
            Rotation.from_rotvec(tilt * self._tilt / np.linalg.norm(self._tilt))
            * Rotation.from_euler("z", self._heading + 0.8 * moving)
        ).as_matrix()
        place = np.array(
            [0.3 + 0.3 * np.sin(0.8 * moving), 0.2 * np.sin(1.1 * moving), height + lift]
        )
        return rigid(turn, place + np.array([0, 0, 0.75 if small else 0.0]))

    def _figure(self, t: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Torso, arm and hand (start, end) with radius, in the room."""
        pose = self._room_pose(t)
        size = self.mesh.radius
        away = pose[:2, 3] - (0.28 + 0.6 * size, 0.05)
        torso = (np.array([*away, 0.0]), np.array([*away, 1.7]))
        top = float(np.percentile((self.mesh.vertices @ pose[:3, :3].T)[:, 2], 90))
        hand = pose[:3, 3] + (-0.5 * min(size, 0.1), 0.0, 0.6 * top)
        moving = t / self.count > self.still
        hand = hand if moving else hand + np.array([-0.25, 0.1, 0.1])
        return [torso, (np.array([*away, 1.35]), hand)]

    def _joints(self, t: int) -> np.ndarray:
        torso, arm = self._figure(t)
        points = np.full((135, 3), np.nan)
        points[:25] = torso[0] + np.linspace(0, 1, 25)[:, None] * (torso[1] - torso[0])
        points[4] = points[7] = arm[1]
        points[25:67] = arm[1]
        return points @ self.master_from_room[:3, :3].T + self.master_from_room[:3, 3]

    def _scene(self, t: int, camera_from_room: np.ndarray, floor: bool) -> list[Drawable]:
        away = np.array([-0.9 * np.cos(self._twin_at), -0.9 * np.sin(self._twin_at), 0.0])
        away[2] = -float(self.mesh.vertices[:, 2].min())
        pose = self._room_pose(t)
        shape = np.asarray(self._shape.vertices), np.asarray(self._shape.faces)
        placed = rigid(np.eye(3), np.array([0, 0, 60.0])) if t in self.gone else None
        at = camera_from_room @ pose if placed is None else placed
        scene = [Drawable(*shape, at)]
        parts = []
        for (start, end), radius in zip(self._figure(t), (0.13, 0.045), strict=True):
            part = trimesh.creation.cylinder(radius=radius, segment=(start, end), sections=16)
            parts.append(part)
        parts.append(trimesh.creation.icosphere(2, 0.045).apply_translation(self._figure(t)[1][1]))
        figure = trimesh.util.concatenate(parts)
        scene.append(
            Drawable(np.asarray(figure.vertices), np.asarray(figure.faces), camera_from_room)
        )
        hidden = rigid(np.eye(3), np.array([0, 0, 60.0]))
        turned = rigid(Rotation.from_euler("z", 1.0 + self._twin_at).as_matrix(), away)
        scene.append(Drawable(*shape, camera_from_room @ turned if self.twin else hidden))
        if floor:
            ground = trimesh.creation.box((6, 6, 0.02)).apply_translation((0, 0, -0.01))
            vertices, faces = trimesh.remesh.subdivide_to_size(ground.vertices, ground.faces, 0.4)
            scene.append(Drawable(np.asarray(vertices), np.asarray(faces), camera_from_room))
        return scene

    # --- the images ----------------------------------------------------------------------------

    def views(self, t: int) -> list[View]:
        """What the tracker is given of frame t."""
        return [self._view(t, c) for c in range(self.cameras)]

    def _view(self, t: int, c: int) -> View:
        rng = np.random.default_rng([self.seed, 2, t, c])
        camera_from_room = invert(self._true[c]) @ self.master_from_room
        geometry = ViewGeometry.for_object(self.rig[c], 2 * self.mesh.radius)
        drawn = render_scene(self._scene(t, camera_from_room, False), COLOUR)
        alone = render_scene(self._scene(t, camera_from_room, False)[:1], COLOUR)
        total = int((alone.body == OBJECT).sum())
        visible = int((drawn.body == OBJECT).sum())
        blocked = c in self._blocked[t // 10] and t not in self.gone
        figure = drawn.body == FIGURE
        mask = drawn.body == OBJECT
        if blocked and total:
            figure = figure | mask
            mask = np.zeros_like(mask)
            visible = 0
        share = 1 - visible / total if total else 1.0
        found: list[tuple[str, np.ndarray]] = [("person", self._border(figure, t, c, 1))]
        if visible > 40 and rng.random() > self._miss(share):
            border = self._border(mask, t, c, 2)
            if rng.random() < self.merged:
                border = border | figure
            found.append((self._label(rng), border))
        if self.twin and (drawn.body == TWIN).sum() > 40 and self.named:
            found.append((self._label(rng), self._border(drawn.body == TWIN, t, c, 3)))
        rng.shuffle(found)
        candidates = [
            (i, label if self.named else "", 0.5, encode(self._full(drawn, mask)))
            for i, (label, mask) in enumerate(found)
        ]
        person = encode(self._full(drawn, self._border(figure, t, c, 4)))
        depth = self._depth(t, c, rng, blocked) if self.depth else None
        return View.build(geometry, depth, person, candidates)

    def _miss(self, share: float) -> float:
        low, high = self.missed
        return low + (high - low) * min(share / 0.7, 1.0)

    def _label(self, rng: np.random.Generator) -> str:
        return str(rng.choice(WRONG)) if rng.random() < self.wrong_labels else self.label

    def _depth(self, t: int, c: int, rng: np.random.Generator, blocked: bool) -> np.ndarray:
        from_colour = invert(COLOUR_FROM_DEPTH) @ invert(self._true[c])
        drawn = render_scene(self._scene(t, from_colour @ self.master_from_room, True), DEPTH_LENS)
        z = np.zeros((DEPTH_LENS.height, DEPTH_LENS.width))
        z[drawn.window] = drawn.depth
        body = np.full(z.shape, -1)
        body[drawn.window] = drawn.body
        if blocked:
            z[body == OBJECT] -= 0.35
        edge = cv2.morphologyEx(body.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((2, 2))) > 0
        noisy = z + self._bias[c] + rng.normal(scale=0.003, size=z.shape)
        noisy[(z <= 0) | (edge & (rng.random(z.shape) < 0.6)) | (rng.random(z.shape) < 0.02)] = 0
        return np.clip(np.rint(noisy * 1000), 0, 65535).astype(np.uint16)

    def _border(self, mask: np.ndarray, t: int, c: int, which: int) -> np.ndarray:
        """The mask with a border that is off by up to ``border_px``, for 8 frames alike."""
        rng = np.random.default_rng([self.seed, 3, t // 8, c, which])
        padded = np.pad(mask, 12)
        image = padded.astype(np.uint8)
        inside = cv2.distanceTransform(image, cv2.DIST_L2, 3)
        outside = cv2.distanceTransform(1 - image, cv2.DIST_L2, 3)
        coarse = rng.normal(size=(8, 8)).astype(np.float32)
        noise = cv2.resize(coarse, image.shape[::-1], interpolation=cv2.INTER_CUBIC)
        shift = np.clip(noise, -1, 1) * self.border_px
        # no border is farther off than a third of what is there
        shift = np.clip(shift, -0.5 * float(inside.max()), None)
        return ((inside - outside + shift) > 0)[12:-12, 12:-12]

    @staticmethod
    def _full(drawn: Rendering, mask: np.ndarray) -> np.ndarray:
        full = np.zeros((COLOUR.height, COLOUR.width), bool)
        full[drawn.window] = mask
        return full
