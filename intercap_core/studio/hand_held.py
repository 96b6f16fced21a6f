"""Recording of an object at rest by one Kinect that is carried around it.

The person who carries the camera is not in view. The object stands where the script's object stands
at its start.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.geometry.camera.transforms import (
    apply,
    invert,
    rigid,
    rotation_exp,
    rotation_log,
)
from intercap_core.schemas import HAND_HELD_TRUTH
from intercap_core.studio.capture_folder import CaptureFolder, Device, DeviceFrame
from intercap_core.studio.controls import Wander
from intercap_core.studio.noise import NoiseSource
from intercap_core.studio.recording import Kinect, surfaces_at
from intercap_core.studio.render import OBJECT, RoomView
from intercap_core.studio.sensors import DepthSensor
from intercap_core.studio.skeleton import unit
from intercap_core.studio.stage import StudioStage

TURNS = 1.12  # around the object: the end overlaps the start
NEAREST_M, DISTANCES = 0.65, 1.1  # to the object's middle: this, and its diameter times this
ELEVATION_DEG = (22.0, 52.0)  # of the camera above the object's middle, up and down twice
SHAKE_M, SHAKE_DEG = 0.008, 1.0  # RMS of a hand


class Walk:
    """Pose of the colour camera over time."""

    def __init__(self, noise: NoiseSource, points: np.ndarray, seconds: float) -> None:
        """Plan a walk around points (N, 3), stage frame, that lasts ``seconds``."""
        rng = noise.rng("walk")
        self._low, self._high = points.min(0), points.max(0)
        size = float(np.linalg.norm(self._high - self._low))
        self._radius = NEAREST_M + DISTANCES * size
        self._first, self._way = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0])
        self._seconds = seconds
        self._shift = Wander(3, SHAKE_M, rng)
        self._turn = Wander(3, np.radians(SHAKE_DEG), rng)
        self._approach = Wander(1, 0.05, rng)  # of the distance, share

    def at(self, time_s: float) -> np.ndarray:
        """stage_from_colour (4, 4)."""
        now = np.array([time_s])
        angle = 2 * np.pi * TURNS * time_s / self._seconds
        low, high = np.radians(ELEVATION_DEG)
        elevation = low + (high - low) * (0.5 - 0.5 * np.cos(2 * angle))
        azimuth = self._first + self._way * angle
        radius = self._radius * (1 + self._approach(now)[0, 0])
        towards = np.array([np.cos(azimuth), np.sin(azimuth), 0]) * np.cos(elevation)
        towards[2] = np.sin(elevation)
        eye = (self._low + self._high) / 2 + radius * towards + self._shift(now)[0]
        right = unit(np.cross(-towards, [0, 0, 1.0]))
        rotation = np.stack([right, np.cross(-towards, right), -towards], 1)
        return rigid(rotation @ rotation_exp(self._turn(now)[0]), eye)


class CarriedKinect(Kinect):
    """The rig's first device, carried around the object."""

    def record_walk(self, folder: CaptureFolder) -> np.ndarray:
        """Write the recording; returns the true stage_from_colour (T, 4, 4)."""
        stage, times = self.stage, self.stage.set_times
        moment = stage.at(times[:1])
        shown = [s for s in surfaces_at(stage, moment, 0) if s.kind == OBJECT]
        points = apply(moment.stage_from_object[0], stage.prop.vertices)
        self._walk = Walk(stage.noise, points, stage.duration)
        poses = np.stack([self._walk.at(float(time)) for time in times])
        colour, depth = self._views_from(poses[0])
        photographer, rng = self._photographer(colour)
        sensor = DepthSensor(depth, stage.noise, self.true.name, stage.depth_mode)
        device = Device(
            self.index, self.claimed, self.serial, self.colour_mode, stage.depth_mode, True,
            stage.fps, self.device_time_us(0),
        )  # fmt: skip
        with folder.open(device) as files:
            for t, pose in enumerate(poses):
                colour, depth = self._views_from(pose)
                photographer.look_through(colour)
                sensor.look_through(depth)
                jpeg = photographer.jpeg(photographer.photograph(colour.cast(shown)))
                image = sensor.image(depth.cast(shown))
                inertial = self._inertial(t, rng)
                files.write(DeviceFrame(t, self.device_time_us(t), jpeg, image, inertial))
        return poses

    def _views_from(self, stage_from_colour: np.ndarray) -> tuple[RoomView, RoomView]:
        """Views of the room through the colour and through the depth lens."""
        camera, room = self.true.moved(stage_from_colour), self.stage.room
        assert camera.depth is not None
        return (
            RoomView(camera.colour, stage_from_colour, room, coloured=True),
            RoomView(camera.depth, camera.master_from_depth, room, coloured=False),
        )

    def _motion(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        step = 0.002  # seconds, of finite differences
        before, at, after = (
            self.true.moved(self._walk.at(time_s + k * step)).master_from_depth for k in (-1, 0, 1)
        )
        speed_up = (before[:3, 3] + after[:3, 3] - 2 * at[:3, 3]) / step**2
        rate = rotation_log(before[:3, :3].T @ after[:3, :3]) / (2 * step)
        return at[:3, :3].T @ (speed_up + np.array([0, 0, self.gravity])), rate


def write_walk_truth(
    path: Path, stage: StudioStage, poses: np.ndarray, sequence: str, interaction: str
) -> None:
    """Write the truth of a walk with true poses stage_from_colour (T, 4, 4)."""
    object_from_stage = invert(stage.at(stage.set_times[:1]).stage_from_object[0])
    with artefacts.write(
        path, HAND_HELD_TRUTH, sequence=sequence, interaction=interaction, object=stage.prop.name
    ) as file:
        file.put("times", stage.set_times)
        file.put("object_vertices", stage.prop.vertices)
        file.put("object_faces", stage.prop.faces)
        file.put("object_from_colour", object_from_stage @ poses)
