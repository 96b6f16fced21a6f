"""A synthetic capture of an object with all errors that a recording may have.

A twin of the object stands in the room and is visible in every view. Detections miss the object
the more often the more it is hidden, have wrong labels and moved borders, and merge person and
object; two views at a time are blocked for ten frames. Calibration, depth and mesh err as well.
"""

from __future__ import annotations

from dataclasses import dataclass

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
from tests.helpers.object_capture import DEPTH_LENS, FPS
from tests.helpers.synthetic_capture import COLOUR, COLOUR_FROM_DEPTH, looking_at

WRONG = ("bed", "person", "tv", "bottle", "chair", "cup")
OBJECT, FIGURE, TWIN = range(3)
CAMERAS = 6
BORDER_PX = 5.0


@dataclass
class HarshCapture:
    """``count`` frames of one object that a figure takes, moves and turns.

    Attributes:
        poses: (T, 4, 4) true master_from_object.
        joints: (T, 135, 3) of the figure, master frame.
        rig: erring cameras, as the tracker gets them.
    """

    mesh: ObjectMesh
    count: int
    label: str
    missed: tuple[float, float] = (0.1, 0.6)  # share of misses in full view, and nearly hidden
    still: float = 0.3  # share of the frames before the object is taken

    def __post_init__(self) -> None:
        rng = np.random.default_rng([0, 1])
        poses = []
        for i in range(CAMERAS):
            angle = 2 * np.pi * i / CAMERAS + 0.3
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
        self._bias = rng.normal(scale=0.004, size=CAMERAS)
        self._shape = trimesh.Trimesh(self.mesh.vertices * 1.005, self.mesh.faces, process=False)
        self._blocked = [
            set(rng.permutation(CAMERAS)[:2].tolist()) for _ in range(self.count // 10 + 1)
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
        scene = [Drawable(*shape, camera_from_room @ pose)]
        parts = []
        for (start, end), radius in zip(self._figure(t), (0.13, 0.045), strict=True):
            part = trimesh.creation.cylinder(radius=radius, segment=(start, end), sections=16)
            parts.append(part)
        parts.append(trimesh.creation.icosphere(2, 0.045).apply_translation(self._figure(t)[1][1]))
        figure = trimesh.util.concatenate(parts)
        scene.append(
            Drawable(np.asarray(figure.vertices), np.asarray(figure.faces), camera_from_room)
        )
        turned = rigid(Rotation.from_euler("z", 1.0 + self._twin_at).as_matrix(), away)
        scene.append(Drawable(*shape, camera_from_room @ turned))
        if floor:
            ground = trimesh.creation.box((6, 6, 0.02)).apply_translation((0, 0, -0.01))
            vertices, faces = trimesh.remesh.subdivide_to_size(ground.vertices, ground.faces, 0.4)
            scene.append(Drawable(np.asarray(vertices), np.asarray(faces), camera_from_room))
        return scene

    # --- the images ----------------------------------------------------------------------------

    def views(self, t: int) -> list[View]:
        """What the tracker is given of frame t."""
        return [self._view(t, c) for c in range(CAMERAS)]

    def _view(self, t: int, c: int) -> View:
        rng = np.random.default_rng([0, 2, t, c])
        camera_from_room = invert(self._true[c]) @ self.master_from_room
        geometry = ViewGeometry.for_object(self.rig[c], 2 * self.mesh.radius)
        drawn = render_scene(self._scene(t, camera_from_room, False), COLOUR)
        alone = render_scene(self._scene(t, camera_from_room, False)[:1], COLOUR)
        total = int((alone.body == OBJECT).sum())
        visible = int((drawn.body == OBJECT).sum())
        blocked = c in self._blocked[t // 10]
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
            if rng.random() < 0.1:  # person and object merged
                border = border | figure
            found.append((self._label(rng), border))
        if (drawn.body == TWIN).sum() > 40:
            found.append((self._label(rng), self._border(drawn.body == TWIN, t, c, 3)))
        rng.shuffle(found)
        candidates = [
            (i, label, encode(self._full(drawn, mask))) for i, (label, mask) in enumerate(found)
        ]
        person = encode(self._full(drawn, self._border(figure, t, c, 4)))
        return View.build(geometry, self._depth(t, c, rng, blocked), person, candidates)

    def _miss(self, share: float) -> float:
        low, high = self.missed
        return low + (high - low) * min(share / 0.7, 1.0)

    def _label(self, rng: np.random.Generator) -> str:
        return str(rng.choice(WRONG)) if rng.random() < 0.3 else self.label

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
        """The mask with a border that is off by up to ``BORDER_PX``, alike in 8 frames."""
        rng = np.random.default_rng([0, 3, t // 8, c, which])
        padded = np.pad(mask, 12)
        image = padded.astype(np.uint8)
        inside = cv2.distanceTransform(image, cv2.DIST_L2, 3)
        outside = cv2.distanceTransform(1 - image, cv2.DIST_L2, 3)
        coarse = rng.normal(size=(8, 8)).astype(np.float32)
        noise = cv2.resize(coarse, image.shape[::-1], interpolation=cv2.INTER_CUBIC)
        shift = np.clip(noise, -1, 1) * BORDER_PX
        # no border is farther off than a third of what is there
        shift = np.clip(shift, -0.5 * float(inside.max()), None)
        return ((inside - outside + shift) > 0)[12:-12, 12:-12]

    @staticmethod
    def _full(drawn: Rendering, mask: np.ndarray) -> np.ndarray:
        full = np.zeros((COLOUR.height, COLOUR.width), bool)
        full[drawn.window] = mask
        return full
