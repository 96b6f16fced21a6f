"""Recording of one Kinect, and the detections on its images.

T frame sets are evenly spaced in time; t is a set. A camera's image of a set may be missing.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import invert
from intercap_core.studio.calibration import ACCELEROMETER_FROM_DEPTH
from intercap_core.studio.capture_folder import CaptureFolder, Device, DeviceFrame
from intercap_core.studio.keypoints import Detector, to_json
from intercap_core.studio.masks import CameraMasks, Labels, MaskSimulator
from intercap_core.studio.mediapipe import detect_keypoints
from intercap_core.studio.motion import PersonState
from intercap_core.studio.passer_by import Passing
from intercap_core.studio.render import (
    BODY,
    OBJECT,
    PASSER_BY,
    Cast,
    MovingSurface,
    Photographer,
    RoomView,
)
from intercap_core.studio.rig import STAGGER_S
from intercap_core.studio.sensors import DepthSensor, LargeErrors, heard
from intercap_core.studio.stage import StageState, StudioStage
from intercap_core.studio.subjects import body_colours

EXPOSURE_S = 1 / 60  # of a colour image in a lit room
# Joints lie inside the body, whose own surface does not occlude them: a surface occludes a joint
# only if it is nearer by more than this, metres.
COVER_M = {"body": 0.13, "hand": 0.03, "face": 0.02}


@dataclass(frozen=True)
class CameraRecord:
    """Contents of one camera's recording, by set."""

    object_pixels: np.ndarray
    """(T,) visible pixels of the object."""
    object_whole: np.ndarray
    """(T,) pixels that the object would cover if nothing occluded it."""
    colour: np.ndarray
    """(T,) bool: there is an image whose device time is the set's."""
    depth: np.ndarray
    """(T,) bool: there is depth that is not empty."""
    depth_bias: float
    """Constant error of its depth, metres; the error at 2.5 m if it grows with distance."""


class Kinect:
    """One device of the rig over one capture."""

    start_us = 1_000_000  # device time of the first set
    gravity = 9.81  # m/s^2
    imu_per_frame = 8  # inertial samples of each set
    accelerometer_noise = 0.03  # standard deviation, m/s^2
    gyroscope_noise = 0.004  # standard deviation, rad/s
    clock_jump_sets = 10  # sets by which a clock with fault backwards_clock jumps back

    def __init__(self, stage: StudioStage, index: int, colour_mode: str) -> None:
        self.stage, self.index, self.colour_mode = stage, index, colour_mode
        self.true: Camera = stage.rig.true[index]
        self.claimed: Camera = stage.rig.claimed[index]
        self.broken = {kind for kind, at in stage.failures.broken.items() if at == index}
        number = 1 if "same_serial" in self.broken else index + 1
        self.serial = f"{100_000 + stage.noise.seed % 100_000:06d}{number:06d}"
        end = stage.frames // 2 if "dead_half" in self.broken else stage.frames
        self.every = stage.every[index]
        lost = stage.rig.missing[index]
        self.sets = [t for t in range(0, end, self.every) if t not in lost]
        self.has_depth = stage.has_depth and "no_depth" not in self.broken

    @property
    def exposures(self) -> np.ndarray:
        """True times (T,) of the images of all sets, seconds since the first set."""
        late = self.stage.rig.slip[:, self.index] / self.stage.fps
        offset = self.stage.rig.offset_s[self.index] + STAGGER_S * self.index
        return self.stage.set_times + offset - late

    def fallen_back(self, t: int) -> bool:
        """Whether the device's clock has jumped back before set ``t``."""
        return "backwards_clock" in self.broken and t >= self.stage.frames // 2

    def device_time_us(self, t: int) -> int:
        """Device time of the image of set ``t``, microseconds."""
        stagger = round(STAGGER_S * 1e6) * self.index
        jitter = round(self.stage.failures.jitter_s[t, self.index] * 1e6)
        if self.fallen_back(t):
            t -= min(self.clock_jump_sets, self.stage.frames // 2)
        return self.start_us + round(t * 1e6 / self.stage.fps) + stagger + jitter

    def record(
        self, folder: CaptureFolder, detector: Detector, segmenter: MaskSimulator
    ) -> CameraRecord:
        """Write the recording, keypoints/<camera>/ and candidates/<camera>.json.

        If MediaPipe detects the keypoints, those of ``detector`` go to keypoints_measured/<camera>.
        """
        stage, name = self.stage, self.true.name
        moment = stage.at(self.exposures)
        colour_view, depth_view = self._views()
        large = None
        if stage.depth_errors == "large":
            large = LargeErrors.draw(stage.noise, len(stage.rig.true))[self.index]
        sensor = DepthSensor(
            depth_view, stage.noise, name, stage.depth_mode, large, stage.depth_errors == "stereo"
        )
        photographer, rng = self._photographer(colour_view)
        distractor = stage.room.distractor
        clutter = colour_view.material == distractor if distractor >= 0 else None
        size = (self.true.colour.width, self.true.colour.height)
        masks = CameraMasks(segmenter, name, clutter, size)
        colours = body_colours(stage.subject, stage.noise.rng("looks"))

        passing = stage.passer_by.at(self.exposures) if stage.passer_by else None
        points = stage.keypoints(moment)
        hidden = np.zeros(points.shape[:2], bool)
        others = stage.keypoints(passing) if passing else points[:0]
        others_hidden = np.ones(others.shape[:2], bool)
        seen, whole = np.zeros(stage.frames, int), np.zeros(stage.frames, int)
        blur = _blur_px(colour_view, self.exposures, moment.stage_from_object[:, :3, 3])
        empty = stage.failures.depth_empty[:, self.index]
        has_depth = ~stage.failures.depth_away[:, self.index]
        candidates = []
        device = Device(
            self.index, self.claimed, self.serial, self.colour_mode, stage.depth_mode,
            self.has_depth, stage.fps // self.every, min(self.device_time_us(t) for t in self.sets),
            self._sound() if folder.capture.sound else None,
        )  # fmt: skip
        real = folder.capture.keypoints == "mediapipe"
        with TemporaryDirectory() as images, folder.open(device) as files:
            for order, t in enumerate(self.sets):
                surfaces = surfaces_at(stage, moment, t, colours, passing)
                cast = colour_view.cast(surfaces)
                inertial = self._inertial(t, rng)
                jpeg = photographer.jpeg(photographer.photograph(cast))
                depth = sensor.image(depth_view.cast(surfaces))
                if empty[t]:
                    depth[:] = 0
                recorded_depth = depth if has_depth[t] else None
                files.write(DeviceFrame(t, self.device_time_us(t), jpeg, recorded_depth, inertial))
                hidden[t] = _hidden(cast, colour_view, points[t])
                if passing and passing.present[t]:
                    others_hidden[t] = _hidden(cast, colour_view, others[t])
                seen[t] = int((cast.identity == OBJECT).sum())
                for prop in [surface for surface in surfaces if surface.kind == OBJECT]:
                    same = order and np.array_equal(
                        prop.stage_from_mesh, moment.stage_from_object[self.sets[order - 1]]
                    )
                    whole[t] = whole[self.sets[order - 1]] if same else colour_view.count(prop)
                truth = Labels(
                    cast.identity, cast.x0, cast.y0, size, seen[t] / max(whole[t], 1), blur[t]
                )
                results = masks.candidates(t, truth)
                folder.add_masks(name, t, stage.fps, results, segmenter.label)
                image = folder.image_number(t, order, stage.fps)
                if real:
                    (Path(images) / f"{image:012d}.jpg").write_bytes(jpeg)
                candidates += [{"image_id": image, **result} for result in results]
            if real:
                detect_keypoints(Path(images), folder.path / "keypoints" / f"{name}.json")
        path = folder.path / "candidates" / f"{name}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(candidates, separators=(",", ":")) + "\n")
        shown = self._detected(detector, moment, points, hidden)
        people = detector.people(self.true, shown)
        if passing:
            walker = self._detected(detector, passing, others, others_hidden, "passer-by")
            people = detector.with_passer_by(self.true, people, walker, others_hidden)
        self._write_keypoints(folder, people, "keypoints_measured" if real else "keypoints")
        colour = np.zeros(stage.frames, bool)
        colour[[t for t in self.sets if not self.fallen_back(t)]] = True
        return CameraRecord(seen, whole, colour, colour & has_depth & ~empty, sensor.bias)

    @cached_property
    def _depth_pose(self) -> np.ndarray:
        """stage_from_depth (4, 4)."""
        return invert(self.stage.rig.master_from_stage) @ self.true.master_from_depth

    def _views(self) -> tuple[RoomView, RoomView]:
        """Views of the room through the colour and through the depth lens."""
        assert self.true.depth is not None
        return (
            self._colour_view(coloured=True),
            RoomView(self.true.depth, self._depth_pose, self.stage.room, coloured=False),
        )

    def _photographer(self, view: RoomView) -> tuple[Photographer, np.random.Generator]:
        """The colour camera with a white balance of its own, and its random numbers."""
        rng = self.stage.noise.rng("photo", self.true.name)
        gain = rng.uniform(0.92, 1.06) * rng.uniform(0.97, 1.03, 3)
        return Photographer(view, gain, rng), rng

    def _colour_view(self, *, coloured: bool) -> RoomView:
        pose = invert(self.stage.rig.master_from_stage) @ self.true.master_from_colour
        return RoomView(self.true.colour, pose, self.stage.room, coloured=coloured)

    def occluded_keypoints(self, moment: StageState) -> np.ndarray:
        """Mask (T, 135) of the subject's keypoints that body, object or room occlude in each image.

        A second person is ignored.
        """
        view, points = self._colour_view(coloured=False), self.stage.keypoints(moment)
        hidden = np.zeros(points.shape[:2], bool)
        for t in self.sets:
            cast = view.cast(surfaces_at(self.stage, moment, t))
            hidden[t] = _hidden(cast, view, points[t])
        return hidden

    def _sound(self) -> np.ndarray:
        """Sound from the first image to the last."""
        first, last = min(self.sets), max(self.sets)
        late = self.stage.rig.late_s[self.index]
        length = (last + 1 - first) / self.stage.fps
        return heard(self.stage, self.index, self.stage.set_times[first] - late, length)

    def _inertial(
        self, t: int, rng: np.random.Generator
    ) -> list[tuple[np.ndarray, np.ndarray, int]]:
        """Acceleration (m/s^2), turning rate (rad/s) and device time (us) of the samples of a
        set."""
        first, period = self.device_time_us(t), 1_000_000 // self.stage.fps
        samples = []
        for k in range(self.imu_per_frame):
            time_us = first + k * period // self.imu_per_frame
            felt, rate = self._motion((time_us - self.start_us) * 1e-6)
            samples.append(
                (
                    ACCELEROMETER_FROM_DEPTH @ felt + rng.normal(0, self.accelerometer_noise, 3),
                    ACCELEROMETER_FROM_DEPTH @ rate + rng.normal(0, self.gyroscope_noise, 3),
                    time_us,
                )
            )
        return samples

    def _motion(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Acceleration (3,), m/s^2, with the reaction to gravity, and turning rate (3,), rad/s, in
        the depth camera's frame. The device of a rig does not move."""
        return self._depth_pose[:3, :3].T @ (0, 0, self.gravity), np.zeros(3)

    def _detected(
        self,
        detector: Detector,
        moment: PersonState,
        points: np.ndarray,
        hidden: np.ndarray,
        *who: str,
    ) -> np.ndarray:
        """Keypoints (T, 135, 3) in the image of a person with true points (T, 135, 3)."""
        master = self.stage.rig.master_from_stage[:3, :3]
        axes = master @ moment.pelvis
        holding = np.zeros((len(points), 2), bool)
        if isinstance(moment, StageState):
            holding = hands_at_object(self.stage, moment, points)
        return detector.detect(self.true, self.stage.to_master(points), axes, hidden, holding, *who)

    def _write_keypoints(
        self, folder: CaptureFolder, people: list[list[np.ndarray]], name: str
    ) -> None:
        target = folder.path / name / self.true.name
        target.mkdir(parents=True)
        for order, t in enumerate(self.sets):
            image, content = folder.image_number(t, order, self.stage.fps), to_json(people[t])
            (target / f"{image:012d}_keypoints.json").write_text(content)
            if name == "keypoints":
                folder.add_keypoints(self.true.name, t, self.stage.fps, content)


def hands_at_object(stage: StudioStage, moment: StageState, points: np.ndarray) -> np.ndarray:
    """Mask (T, 2) of frames in which a point of the left, the right hand is near the object.

    ``points``: (T, 135, 3) keypoints, stage frame. They lie inside the fingers.
    """
    near_m = 0.015  # half a finger's thickness and some air
    hands = points[:, 25:67]
    near = np.zeros((len(points), 42), bool)
    for t, pose in enumerate(moment.stage_from_object if stage.prop else ()):
        local = (hands[t] - pose[:3, 3]) @ pose[:3, :3]
        near[t] = stage.prop.surface.signed_distance(local) < near_m
    return np.asarray(near.reshape(-1, 2, 21).any(2))


def surfaces_at(
    stage: StudioStage,
    moment: StageState,
    t: int,
    colours: np.ndarray | None = None,
    passing: Passing | None = None,
) -> list[MovingSurface]:
    """Clothed body (black without ``colours``), object and second person at ``t``, if present."""
    prop, subject = stage.prop, stage.subject
    colours = np.zeros((len(subject.rest), 3)) if colours is None else colours
    faces = subject.faces.astype(np.int32)

    def person(kind: int, clothed: np.ndarray, colours: np.ndarray) -> MovingSurface:
        normals = subject.normals(clothed[None])[0]
        return MovingSurface(kind, clothed, faces, normals, colours, np.eye(4))

    surfaces = [person(BODY, moment.clothed[t], colours)]
    if prop:
        pose = moment.stage_from_object[t]
        surfaces.append(
            MovingSurface(OBJECT, prop.vertices, prop.faces, stage.prop_normals, prop.colours, pose)
        )
    if stage.passer_by and passing and passing.present[t]:
        surfaces.append(person(PASSER_BY, passing.clothed[t], stage.passer_by.colours))
    return surfaces


def _blur_px(view: RoomView, times: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Motion (T,) of points (T, 3) in the image during the exposure, px."""
    at = points @ view.camera_from_stage[:3, :3].T + view.camera_from_stage[:3, 3]
    shift = np.linalg.norm(np.gradient(view.lens.project(at), axis=0), axis=1)
    # a camera that slips may show a moment twice
    return shift / np.maximum(np.abs(np.gradient(times)), EXPOSURE_S) * EXPOSURE_S


def _hidden(cast: Cast, view: RoomView, points: np.ndarray) -> np.ndarray:
    """Mask (135,) of keypoints (135, 3), stage frame, that another surface occludes.

    A moving surface occludes a keypoint if it is nearer along the ray by more than ``COVER_M``. The
    room occludes it if the room's depth is smaller by more than 3 cm. Points 25 to 66 are the
    hands, 67 to 134 the face, and 0 and 15 to 18 are nose, eyes and ears.
    """
    cover = np.full(135, COVER_M["body"])
    cover[25:67], cover[67:] = COVER_M["hand"], COVER_M["face"]
    cover[[0, 15, 16, 17, 18]] = COVER_M["face"] * 2
    at = points @ view.camera_from_stage[:3, :3].T + view.camera_from_stage[:3, 3]
    u, v = np.round(view.lens.project(at)).astype(int).T
    inside = (u >= 0) & (v >= 0) & (u < view.lens.width) & (v < view.lens.height) & (at[:, 2] > 0)
    room, moving = np.full((2, 135), np.inf)
    room[inside] = view.depth[v[inside], u[inside]]
    height, width = cast.identity.shape
    u, v = u - cast.x0, v - cast.y0
    inside &= (u >= 0) & (v >= 0) & (u < width) & (v < height)
    depth = np.full(cast.identity.size, np.inf, np.float32)
    depth[cast.pixels] = cast.depth
    moving[inside] = depth[v[inside] * width + u[inside]]
    distance = np.linalg.norm(points - view.eye, axis=1)
    nearness = moving / np.maximum(at[:, 2], 1e-6)
    return (nearness * distance < distance - cover) | (room < at[:, 2] - 0.03)
