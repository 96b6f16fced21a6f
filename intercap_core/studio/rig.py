"""Azure Kinects in a ring: true and claimed lenses and poses, times of exposure, failures.

Lens values are typical of the calibrations that devices have; no two devices are the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.formats.calibration.k4a import COLOUR_MODES, DEPTH_MODES, Mode
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import invert, rigid, rotation_exp
from intercap_core.studio.noise import NoiseSource
from intercap_core.studio.skeleton import unit

# Delay of each subordinate, so that the lasers do not interfere (Azure Kinect documentation)
STAGGER_S = 160e-6
MAX_OFFSET_S = 0.008  # of the exposure relative to the device time, at noise 1


@dataclass(frozen=True)
class StudioRig:
    """True and calibrated cameras, in the master's colour frame."""

    true: Rig
    """True lenses and poses."""
    claimed: Rig
    """Calibrated lenses and poses, with errors, as in the recordings and the rig file."""
    master_from_stage: np.ndarray
    """(4, 4), metres."""
    offset_s: np.ndarray
    """(C,) exposure minus device time, seconds, without the stagger and slips."""
    missing: tuple[frozenset[int], ...]
    """Sets that each camera did not record."""
    slip: np.ndarray
    """(T, C) whole frames by which an image is older than its device time says."""
    late_s: np.ndarray
    """(C,) seconds by which images are older than their times say because the cameras were started
    by hand; ``slip`` and ``offset_s`` include it."""


def build_rig(
    rng: np.random.Generator,
    capture: StudioCapture,
    settings: StudioSettings,
    names: Sequence[str] | None = None,
) -> StudioRig:
    """Make a rig around the stage's origin; ``settings.noise`` scales every error.

    With the fault "no_overlap", all cameras but the master look away. ``names``: of the cameras,
    the master first; by default k1, k2, ...
    """
    cameras, noise = settings.cameras, settings.noise
    names = names or [f"k{number}" for number in range(1, cameras + 1)]
    stage_from_camera = _ring(rng, cameras)
    if "no_overlap" in capture.faults:
        for pose in stage_from_camera[1:]:
            pose[:3, :3] = rotation_exp(np.array([0, 0, np.pi])) @ pose[:3, :3]
    true, claimed = [], []
    master_from_stage = invert(stage_from_camera[0])
    for index in range(cameras):
        camera = Camera(
            names[index],
            _colour_lens(rng, settings.colour_mode),
            _depth_lens(rng, settings.depth_mode),
            _colour_from_depth(rng),
            master_from_stage @ stage_from_camera[index],
        )
        true.append(camera)
        assert camera.depth is not None
        pose = camera.master_from_colour.copy()
        if index:  # a turn of 0.5 degrees about the camera's centre and a shift of 10 mm at noise 1
            error = rotation_exp(unit(rng.normal(size=3)) * np.radians(0.5) * noise)
            pose[:3, :3] = error @ pose[:3, :3]
            pose[:3, 3] += unit(rng.normal(size=3)) * 0.010 * noise
        claimed.append(
            replace(
                camera,
                colour=_recalibrated(camera.colour, rng, noise),
                depth=_recalibrated(camera.depth, rng, noise),
                master_from_colour=pose,
            )
        )
    offset = rng.uniform(-MAX_OFFSET_S, MAX_OFFSET_S, cameras) * noise
    offset = np.clip(offset, -2 * MAX_OFFSET_S, 2 * MAX_OFFSET_S)
    offset -= offset[0]  # the sets' times are the master's
    offset = np.clip(offset, -MAX_OFFSET_S * noise, MAX_OFFSET_S * noise)
    missing, slip = _slips(rng, capture.frames, settings)
    return StudioRig(
        Rig(tuple(true)),
        Rig(tuple(claimed)),
        master_from_stage,
        offset,
        missing,
        slip,
        np.zeros(cameras),
    )


def started_apart(
    rig: StudioRig, rng: np.random.Generator, seconds: float, fps: float
) -> StudioRig:
    """The same rig with cameras that were started by hand.

    The images of each camera but the master are older or newer than their times say, by up to
    ``seconds``; at least one nearly by as much.
    """
    late = rng.uniform(-seconds, seconds, len(rig.true))
    if len(late) > 1:
        most = 1 + int(rng.integers(len(late) - 1))
        late[most] = np.copysign(seconds * rng.uniform(0.9, 1.0), late[most])
    late[0] = 0
    sets = np.round(late * fps).astype(np.int32)
    return replace(
        rig, slip=rig.slip + sets, offset_s=rig.offset_s + sets / fps - late, late_s=late
    )


def _ring(rng: np.random.Generator, cameras: int) -> list[np.ndarray]:
    """stage_from_colour (4, 4) of each camera: x right, y down, z towards the middle.

    The cameras are on a ring, evenly spaced and alternately low and high, with random deviations.
    """
    poses = []
    first = rng.uniform(0, 2 * np.pi)
    for index in range(cameras):
        azimuth = first + 2 * np.pi * index / cameras + np.radians(rng.uniform(-5, 5))
        radius = 2.55 + rng.uniform(-0.2, 0.2)
        height = (1.05, 2.05)[index % 2] + rng.uniform(-0.08, 0.08)
        eye = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
        aim = np.array([0, 0, 0.85]) + rng.normal(0, 0.05, 3)
        forward = unit(aim - eye)
        right = unit(np.cross(forward, [0, 0, 1.0]))
        rotation = np.stack([right, np.cross(forward, right), forward], 1)
        roll = rotation_exp(np.array([0, 0, np.radians(rng.uniform(-1.5, 1.5))]))
        poses.append(rigid(rotation @ roll, eye))
    return poses


def _colour_lens(rng: np.random.Generator, mode: str) -> Intrinsics:
    """Draw a colour lens; its values are those of images 1,920 px wide, scaled to the mode."""
    width, height = COLOUR_MODES[mode].size
    scale = width / 1920
    focal = (913 + rng.normal(0, 4)) * scale
    # k1, k2, p1, p2, k3, k4, k5, k6
    distortion = np.array([0.42, -2.55, 3e-4, -2e-4, 1.50, 0.30, -2.37, 1.42])
    distortion[:2] += rng.normal(0, (0.03, 0.05))
    distortion[2:4] += rng.normal(0, 2e-4, 2)
    # k4 and k5 follow k1 and k2: they nearly cancel, so that lenses differ far less than numbers
    distortion[5:7] += distortion[:2] - (0.42, -2.55)
    distortion[5] += rng.normal(0, 0.004)
    return Intrinsics(
        width, height, focal, focal * (1 + rng.normal(0, 3e-4)),
        (width - 1) / 2 + rng.normal(0, 5) * scale, (height - 1) / 2 + rng.normal(7, 5) * scale,
        distortion,
    )  # fmt: skip


def _depth_lens(rng: np.random.Generator, mode: str) -> Intrinsics:
    """Draw a depth lens; its values are those of the mode NFOV_UNBINNED."""
    narrow = DEPTH_MODES["NFOV_UNBINNED"]
    width, height = narrow.size
    focal = 504.5 + rng.normal(0, 1.0)
    distortion = np.array([0.55, -0.02, -7e-5, 2e-5, -0.0027, 0.89, 0.086, -0.0139])
    shift = rng.normal(0, 0.05)
    distortion[0] += shift
    distortion[5] += shift + rng.normal(0, 0.002)
    distortion[2:4] += rng.normal(0, 5e-5, 2)
    lens = Intrinsics(
        width, height, focal, focal * (1 + rng.normal(0, 2e-4)),
        (width - 1) / 2 + rng.normal(8, 3), (height - 1) / 2 + rng.normal(14, 3),
        distortion, 1.74,
    )  # fmt: skip
    return lens if mode == "NFOV_UNBINNED" else _in_mode(lens, narrow, DEPTH_MODES[mode])


def _in_mode(lens: Intrinsics, mode: Mode, other: Mode) -> Intrinsics:
    """The same lens and sensor in another mode."""
    scale = other.binned[0] / mode.binned[0]
    cx, cy = (np.array([lens.cx, lens.cy]) + mode.crop + 0.5) * scale - other.crop - 0.5
    width, height = other.size
    return replace(
        lens, width=width, height=height, fx=lens.fx * scale, fy=lens.fy * scale, cx=cx, cy=cy
    )


def _colour_from_depth(rng: np.random.Generator) -> np.ndarray:
    """As in real devices' calibrations, the depth camera looks down by 5.6 degrees."""
    tilt = np.array([np.radians(-5.6), 0, 0]) + np.radians(rng.normal(0, 0.25, 3))
    return rigid(rotation_exp(tilt), np.array([-0.0320, -0.0021, 0.0039]) + rng.normal(0, 2e-4, 3))


def _recalibrated(lens: Intrinsics, rng: np.random.Generator, noise: float) -> Intrinsics:
    """The lens with the errors of the device's own calibration."""
    focal = 1 + rng.normal(0, 3e-4) * noise
    centre = rng.normal(0, 0.25, 2) * noise * lens.width / 1920  # px at 1080p
    return replace(
        lens, fx=lens.fx * focal, fy=lens.fy * focal, cx=lens.cx + centre[0], cy=lens.cy + centre[1]
    )


def _slips(
    rng: np.random.Generator, frames: int, settings: StudioSettings
) -> tuple[tuple[frozenset[int], ...], np.ndarray]:
    """Sets without an image for each camera, and slips (T, C).

    Two subordinate cameras lose one to four frames, or, if ``settings.slips`` is "silent", their
    images are older by as many frames for a while. In addition, one camera starts late and one
    ends early.
    """
    cameras = settings.cameras
    missing: list[set[int]] = [set() for _ in range(cameras)]
    slip = np.zeros((frames, cameras), np.int32)
    others = np.arange(1, cameras)
    if len(others) == 0 or frames < 8 or settings.noise == 0:
        return tuple(frozenset(m) for m in missing), slip
    for camera in rng.permutation(others)[:2]:
        length = int(rng.integers(1, 5))
        first = max(2, length)  # so that no image is older than the recording
        start = int(rng.integers(first, max(first + 1, frames - length - 2)))
        if settings.slips == "silent":
            end = start + int(rng.integers(5, 20))
            stays = rng.random() < 0.3  # to the end of the recording
            slip[start : frames if stays else end, camera] = length
        else:
            missing[camera].update(range(start, min(frames, start + length)))
    late, early = rng.permutation(others)[[0, -1]]
    missing[late].update(range(int(rng.integers(0, 3))))
    missing[early].update(range(frames - int(rng.integers(0, 3)), frames))
    return tuple(frozenset(m) for m in missing), slip


ONE_CAMERA_EACH = (
    "dead_half", "no_depth", "zero_depth", "same_serial", "backwards_clock", "wrong_resolution"
)  # fmt: skip


@dataclass(frozen=True)
class Failures:
    """Failures of every camera of a capture."""

    jitter_s: np.ndarray
    """(T, C) deviation of device times from even spacing, seconds."""
    depth_empty: np.ndarray
    """(T, C) bool: the depth image is zero everywhere."""
    depth_away: np.ndarray
    """(T, C) bool: there is no depth image."""
    broken: dict[str, int] = field(default_factory=dict)
    """Camera index of each fault of :data:`ONE_CAMERA_EACH`."""

    @classmethod
    def draw(cls, noise: NoiseSource, capture: StudioCapture, cameras: int) -> Failures:
        """Draw the failures; the master's clock defines the times of the sets."""
        frames = capture.frames
        jitter = np.zeros((frames, cameras))
        empty, away = np.zeros((2, frames, cameras), bool)
        rng = noise.rng("clocks")
        steps = np.clip(rng.normal(size=(frames, cameras)), -3, 3)
        jitter[:, 1:] = steps[:, 1:] * 100e-6 * noise.scale
        rng = noise.rng("depth gaps")
        if noise.scale > 0 and cameras > 1 and frames >= 8:
            camera = int(rng.integers(1, cameras))
            for _ in range(int(rng.integers(1, 4))):
                start = int(rng.integers(0, frames - 1))
                length = int(rng.integers(1, 4))
                which = empty if rng.random() < 0.5 else away
                which[start : start + length, camera] = True
        away |= not capture.depth
        broken = _assigned(noise, cameras, capture.faults)
        if "no_depth" in broken:
            away[:, broken["no_depth"]] = True
        if "zero_depth" in broken:
            empty[:, broken["zero_depth"]] = True
        return cls(jitter, empty, away, broken)


def _assigned(noise: NoiseSource, cameras: int, faults: Sequence[str]) -> dict[str, int]:
    """A subordinate camera for each fault; different cameras while there are enough."""
    order = 1 + noise.rng("faults").permutation(max(cameras - 1, 1))
    named = [fault for fault in ONE_CAMERA_EACH if fault in faults]
    return {fault: int(order[i % len(order)]) for i, fault in enumerate(named)}
