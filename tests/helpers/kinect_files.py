"""Small Azure Kinect recordings whose images encode their camera and time."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np

from intercap_core import artefacts
from intercap_core.config import FramesSettings
from intercap_core.entries import SequenceEntry
from intercap_core.formats.calibration.extrinsics import Extrinsics, write_rig_file
from intercap_core.formats.calibration.k4a import COLOUR_MODES, DEPTH_MODES
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.schemas import FRAMES
from intercap_core.stages import frames as stage
from intercap_core.studio.calibration import write_calibration
from intercap_core.studio.mkv import MkvWriter

PERIOD_US = 66_666
MODES = dict(colour_mode="720P", depth_mode="NFOV_2X2BINNED")
DEPTH_DELAY_US = 500


def pose_of(index: int) -> np.ndarray:
    turn = cv2.Rodrigues(np.array([0.0, -1.0 * index, 0.0]))[0]
    return rigid(turn, np.array([0.5 * index, 0.0, 0.1 * index]))


def make_camera(index: int) -> Camera:
    colour = Intrinsics(*COLOUR_MODES["720P"].size, 610.0 + index, 611.0, 640.0, 360.0)
    depth = Intrinsics(*DEPTH_MODES["NFOV_2X2BINNED"].size, 252.0, 252.0, 160.0 + index, 150.0)
    between = rigid(cv2.Rodrigues(np.array([0.1, 0, 0]))[0], np.array([-0.032, 0, 0]))
    return Camera(f"k{index + 1}", colour, depth, between, pose_of(index))


def depth_at(camera: int, tick: int) -> np.ndarray:
    return np.full((288, 320), 1000 + 100 * camera + tick, np.uint16)


@cache
def jpeg_at(camera: int, tick: int) -> bytes:
    image = np.full((720, 1280, 3), (10 * camera, tick, 128), np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def record(
    folder: Path,
    camera: int,
    ticks,
    *,
    clock_us: int = 3_000_000,
    depth: bool = True,
    serial: str = "",
    times_us=None,
    image_of=depth_at,
    jpeg_of=jpeg_at,
) -> None:
    """Record ``ticks``; ``times_us`` maps a tick to device time if that is not a whole period."""
    device = make_camera(camera)
    times_us = times_us or (lambda tick: clock_us + tick * PERIOD_US)
    with MkvWriter(
        folder / f"{device.name}.mkv",
        calibration_json=write_calibration(device, serial=serial or str(camera), **MODES),
        colour_mode=MODES["colour_mode"],
        depth_mode=MODES["depth_mode"] if depth else None,
        fps=15,
        serial=serial or str(camera),
        start_offset_ns=clock_us * 1000,
        depth_delay_ns=DEPTH_DELAY_US * 1000,
        wired_sync_mode="SUBORDINATE" if camera else "MASTER",
        subordinate_delay_ns=160_000 * camera,
        with_imu=True,
    ) as writer:
        for tick in ticks:
            time_us = times_us(tick) + 160 * camera
            writer.write_colour(jpeg_of(camera, tick), time_us)
            writer.write_imu([0, 0, -9.8], [0, 0, 0], time_us)
            if depth:
                writer.write_depth(image_of(camera, tick), time_us + DEPTH_DELAY_US)


def row(
    recordings: Path, calibration: Path, *, layout: str = "k4a", **columns: object
) -> SequenceEntry:
    """Row of a sequence of subject "a" and object "b"."""
    return SequenceEntry(
        sequence="s1", subject="a", object="b", layout=layout, recordings=recordings,
        calibration=calibration, **columns,
    )  # fmt: skip


def entry_of(folder: Path, cameras: int) -> SequenceEntry:
    """Row of the sequence recorded in ``folder``, with a rig file next to it."""
    rig = folder.parent / "rig.json"
    write_rig_file(rig, Extrinsics("k1", {f"k{i + 1}": pose_of(i) for i in range(cameras)}))
    return row(folder, rig)


def run(capture: SequenceEntry, drop=()) -> Path:
    """Run the frames stage; returns the artefact."""
    output = capture.calibration.parent / "out" / "frames.h5"
    stage.run(sequence=capture, output=output, settings=FramesSettings(), frames_to_drop=drop)
    return output


def notes_of(path: Path) -> dict[str, str]:
    """Notes of the artefact by camera."""
    with artefacts.read(path, FRAMES) as frames:
        return dict(zip(frames.text("camera_names"), frames.text("note"), strict=True))
