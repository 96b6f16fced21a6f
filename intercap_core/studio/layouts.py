"""Layouts of a capture's folder: Azure Kinect files, the releases of InterCap and BEHAVE, plain
images. Bags of ROS are in :mod:`.ros`.

In the table of sequences, ``recordings`` is the capture's folder and ``calibration`` is
:attr:`CaptureFolder.calibration` in it.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from pycocotools import mask as coco

from intercap_core.config_types import LayoutName
from intercap_core.formats.calibration.extrinsics import Extrinsics, write_rig_file
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import rotation_log
from intercap_core.inputs.documents import dump_yaml
from intercap_core.studio.calibration import write_calibration
from intercap_core.studio.capture_folder import (
    SOUND_RATE,
    CameraFiles,
    CaptureFolder,
    Device,
    DeviceFrame,
    ImageFiles,
)
from intercap_core.studio.mkv import MkvWriter
from intercap_core.studio.render import Aligner
from intercap_core.studio.rig import STAGGER_S
from intercap_core.studio.ros import RosFolder

BEHAVE_DATE = "Date01"  # folder of the calibration


class KinectFolder(CaptureFolder):
    """``<camera>.mkv`` and a rig file."""

    calibration = "calibration.json"
    own_faults = frozenset({"same_serial", "backwards_clock"})

    def open(self, device: Device) -> CameraFiles:
        """Open an Azure Kinect recording."""
        return _KinectFile(self.path / f"{device.camera.name}.mkv", device)

    def write_calibration(self, claimed: Rig, fps: int) -> None:
        """Write the rig file; the recordings hold the lenses."""
        poses = dict(zip(claimed.names, claimed.master_from_colour, strict=True))
        write_rig_file(self.path / self.calibration, Extrinsics(claimed.names[0], poses))


class _KinectFile(CameraFiles):
    """One MKV recording."""

    def __init__(self, path: Path, device: Device) -> None:
        self._writer = MkvWriter(
            path,
            calibration_json=write_calibration(
                device.camera,
                colour_mode=device.colour_mode,
                depth_mode=device.depth_mode,
                serial=device.serial,
            ),
            colour_mode=device.colour_mode,
            depth_mode=device.depth_mode if device.depth else None,
            fps=device.fps,
            serial=device.serial,
            start_offset_ns=device.first_us * 1000,
            wired_sync_mode="SUBORDINATE" if device.index else "MASTER",
            subordinate_delay_ns=round(STAGGER_S * 1e9) * device.index,
            with_imu=True,
        )
        self._last_us = 0

    def write(self, frame: DeviceFrame) -> None:
        if frame.time_us < self._last_us:
            self._writer.turn_back()
        self._last_us = frame.time_us
        self._writer.write_colour(frame.jpeg, frame.time_us)
        if frame.depth is not None:
            self._writer.write_depth(frame.depth, frame.time_us)
        for sample in frame.inertial:
            self._writer.write_imu(*sample)

    def close(self) -> None:
        self._writer.close()


class ReleaseFolder(CaptureFolder):
    """InterCap's release: ``Frames_Cam<n>/color/%05d.jpg``, aligned depth, ``Color*.json``.

    Image numbers are the only time stamps.
    """

    calibration = "calibration"
    own_faults = frozenset({"swapped_lenses", "wrong_resolution"})

    def open(self, device: Device) -> CameraFiles:
        """Open a folder ``Frames_Cam<n>``."""
        folder = self.path / f"Frames_Cam{device.index + 1}"

        def paths(frame: DeviceFrame) -> tuple[Path, Path]:
            name = f"{_release_number(frame.t, device.fps):05d}"
            return folder / "color" / f"{name}.jpg", folder / "depth" / f"{name}.png"

        return ImageFiles(paths, Aligner(device.camera) if device.depth else None)

    def image_number(self, t: int, order: int, fps: int) -> int:
        """Return the number in the image's name."""
        return _release_number(t, fps)

    def write_calibration(self, claimed: Rig, fps: int) -> None:
        """Write ``Color.json``, ``Color_2.json``, ...: x_camera = R x_world + T."""
        write_intercap_calibration(self.path / self.calibration, claimed, self.lenses(claimed))


def write_intercap_calibration(folder: Path, rig: Rig, lenses: Sequence[Intrinsics]) -> None:
    """Write the files of the lenses and poses of InterCap's release."""
    for index, (camera, lens) in enumerate(zip(rig, lenses, strict=True), start=1):
        pose = camera.colour_from_master
        content = {
            "f": [lens.fx, lens.fy],
            "c": [lens.cx, lens.cy],
            "k": lens.distortion.tolist(),
            "R": rotation_log(pose[:3, :3]).tolist(),
            "T": pose[:3, 3].tolist(),
        }
        _write_json(folder / (f"Color_{index}.json" if index > 1 else "Color.json"), content)


def _release_number(t: int, fps: int) -> int:
    """InterCap's image numbers count periods of 30 Hz."""
    return t * 30 // fps


class BehaveFolder(CaptureFolder):
    """BEHAVE: ``t<seconds>/k<n>.color.jpg`` and ``.depth.png``, aligned; poses and lenses in
    folders of their own. Kinect 1 is the master."""

    calibration = f"calibs/{BEHAVE_DATE}/config"
    own_faults = frozenset({"wrong_resolution"})

    def open(self, device: Device) -> CameraFiles:
        """Open a camera; its images share folders with those of the other cameras."""
        name = device.camera.name

        def paths(frame: DeviceFrame) -> tuple[Path, Path]:
            folder = _behave_frame(self.path, frame.t, device.fps)
            return folder / f"{name}.color.jpg", folder / f"{name}.depth.png"

        return ImageFiles(paths, Aligner(device.camera) if device.depth else None)

    def write_calibration(self, claimed: Rig, fps: int) -> None:
        """Write ``<n>/config.json`` (camera to world) and ``intrinsics/<n>/calibration.json``."""
        write_behave_calibration(self.path / "calibs", claimed, self.lenses(claimed))

    def add_keypoints(self, camera: str, t: int, fps: int, content: str) -> None:
        """Write ``k<n>.color.json``."""
        (_behave_frame(self.path, t, fps) / f"{camera}.color.json").write_text(content)

    def add_masks(
        self, camera: str, t: int, fps: int, candidates: list[dict[str, Any]], label: str
    ) -> None:
        """Write ``k<n>.person_mask.jpg`` and ``k<n>.obj_rend_mask.jpg``: the first candidate of
        each."""
        for category, kind in (("person", "person_mask"), (label, "obj_rend_mask")):
            first = next((c for c in candidates if c["category"] == category), None)
            if first is not None:
                mask = 255 * coco.decode(first["segmentation"])
                path = _behave_frame(self.path, t, fps) / f"{camera}.{kind}.jpg"
                path.write_bytes(cv2.imencode(".jpg", mask)[1].tobytes())


def write_behave_calibration(
    folder: Path, rig: Rig, lenses: Sequence[Intrinsics], date: str = BEHAVE_DATE
) -> None:
    """Write the folder ``calibs`` of BEHAVE for cameras k0, k1, ...; the world is the master."""
    for camera, lens in zip(rig, lenses, strict=True):
        number, pose = camera.name[1:], camera.master_from_colour
        extrinsics = {
            "rotation": pose[:3, :3].ravel().tolist(),
            "translation": pose[:3, 3].tolist(),
        }
        _write_json(folder / date / "config" / number / "config.json", extrinsics)
        numbers = [lens.fx, lens.fy, lens.cx, lens.cy]
        colour = dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=True))
        colour |= {"width": lens.width, "height": lens.height}
        content = {"color": colour | {"opencv": [*numbers, *lens.distortion.tolist()]}}
        _write_json(folder / "intrinsics" / number / "calibration.json", content)


def _behave_frame(folder: Path, t: int, fps: int) -> Path:
    return folder / f"t{t / fps:08.3f}"


class PlainFolder(CaptureFolder):
    """``<camera>/`` with numbered JPEG files, or a video, and time stamps; OpenCV calibration.

    Depth stays in the depth camera's own lens.
    """

    calibration = "calibration.yaml"
    own_faults = frozenset({"backwards_clock", "wrong_resolution"})

    def open(self, device: Device) -> CameraFiles:
        """Open the camera's folder or video."""
        if self.capture.video:
            return _PlainVideo(self.path / device.camera.name, device)
        return _PlainFiles(self.path / device.camera.name)

    def write_calibration(self, claimed: Rig, fps: int) -> None:
        """Write one file for all cameras: x_camera = R x_world + T."""
        cameras = {}
        for camera, lens in zip(claimed, self.lenses(claimed), strict=True):
            pose = camera.colour_from_master
            entry: dict[str, object] = {
                **_opencv(lens),
                "R": pose[:3, :3].tolist(),
                "T": pose[:3, 3].tolist(),
            }
            if self.capture.depth:
                assert camera.depth is not None and camera.colour_from_depth is not None
                between = {"colour_from_depth": camera.colour_from_depth.tolist()}
                entry["depth"] = {**_opencv(camera.depth), **between}
            if camera.name in self.capture.every:
                entry["fps"] = fps // self.capture.every[camera.name]
            cameras[camera.name] = entry
        content = {"master": claimed.names[0], "fps": fps, "cameras": cameras}
        (self.path / self.calibration).write_text(dump_yaml(content))


class _PlainFiles(ImageFiles):
    """Numbered image files and their timestamps.csv."""

    def __init__(self, folder: Path) -> None:
        super().__init__(
            lambda frame: (folder / f"{frame.t:06d}.jpg", folder / "depth" / f"{frame.t:06d}.png")
        )
        self._path, self._times = folder / "timestamps.csv", list[str]()

    def write(self, frame: DeviceFrame) -> None:
        super().write(frame)
        self._times.append(f"{frame.t:06d}, {frame.time_us / 1e6:.6f}\n")

    def close(self) -> None:
        self._path.write_text("".join(self._times))


class _PlainVideo(ImageFiles):
    """``<camera>.mp4`` of JPEG packets; depth files are numbered as the video's images."""

    def __init__(self, folder: Path, device: Device) -> None:
        super().__init__(lambda frame: (None, folder / "depth" / f"{len(self._times):06d}.png"))
        self._path, self._times = folder.with_name(f"{folder.name}_timestamps.csv"), list[str]()
        self._first_us, lens = device.first_us, device.camera.colour
        self._container = av.open(str(folder.with_suffix(".mp4")), "w")
        self._stream = self._container.add_stream("mjpeg", rate=device.fps)
        self._stream.width, self._stream.height = lens.width, lens.height
        self._stream.pix_fmt = "yuvj420p"
        if device.sound is not None:
            self._write_sound(device.sound)

    def write(self, frame: DeviceFrame) -> None:
        super().write(frame)
        packet = av.Packet(frame.jpeg)
        packet.stream, packet.time_base = self._stream, Fraction(1, 1_000_000)
        packet.pts = packet.dts = frame.time_us - self._first_us
        self._container.mux(packet)
        self._times.append(f"{frame.time_us / 1e6:.6f}\n")

    def _write_sound(self, samples: np.ndarray) -> None:
        """Write AAC sound, as phones do."""
        stream = self._container.add_stream("aac", rate=SOUND_RATE, layout="mono")
        frame = av.AudioFrame.from_ndarray(samples[None], format="fltp", layout="mono")
        frame.sample_rate, frame.pts, frame.time_base = SOUND_RATE, 0, Fraction(1, SOUND_RATE)
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            self._container.mux(packet)

    def close(self) -> None:
        self._container.close()
        self._path.write_text("".join(self._times))


def _opencv(lens: Intrinsics) -> dict[str, object]:
    return {
        "image_size": [lens.width, lens.height],
        "camera_matrix": lens.matrix.tolist(),
        "distortion_coefficients": lens.distortion.tolist(),
    }


def _write_json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n")


FOLDERS: dict[LayoutName, type[CaptureFolder]] = {
    "k4a": KinectFolder,
    "ros": RosFolder,
    "intercap": ReleaseFolder,
    "behave": BehaveFolder,
    "plain": PlainFolder,
}


def camera_names(layout: LayoutName, count: int) -> list[str]:
    """Return the names of the cameras, the master first: k1, k2, ...; in BEHAVE k1, k0, k2, ..."""
    if layout == "behave":
        return ["k1", "k0", *(f"k{number}" for number in range(2, count))][:count]
    return [f"k{number}" for number in range(1, count + 1)]
