"""What the folder of a capture looks like: Azure Kinect files, the releases of InterCap and BEHAVE,
or plain images with a calibration in OpenCV's terms.

Folders below the capture's own: what the table of sequences calls ``recordings`` is the capture's
folder, ``calibration`` is :attr:`CaptureFolder.calibration` in it.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
import yaml
from pycocotools import mask as coco
from scipy.spatial.transform import Rotation

from intercap_core.camera.extrinsics_files import Extrinsics, write_rig_file
from intercap_core.camera.intrinsics import Intrinsics
from intercap_core.camera.rig import Camera, Rig
from intercap_core.config import LayoutName, StudioFault
from intercap_core.studio.alignment import Aligner
from intercap_core.studio.calibration import write_calibration
from intercap_core.studio.mkv import MkvWriter
from intercap_core.studio.rig import STAGGER_S

RELEASE_FPS = 30  # the number in the name of an image of InterCap's counts periods of this rate
WRONG_SIZE = 1.5  # of the images that a wrong calibration is for
SWAPPED = (3, 4)  # cameras 4 and 5 of InterCap's release
BEHAVE_DATE = "Date01"


@dataclass(frozen=True)
class Device:
    """One camera of the rig: ``camera`` as it claims to be, always with depth; ``depth`` says
    whether it records any; ``first_us`` is its first device time."""

    index: int
    camera: Camera
    serial: str
    colour_mode: str
    depth_mode: str
    depth: bool
    fps: int
    first_us: int


@dataclass(frozen=True)
class Shot:
    """What a device delivers of set ``t``: a JPEG, depth (H, W) uint16 mm or None, and inertial
    samples (acceleration, turning rate, device time)."""

    t: int
    time_us: int
    jpeg: bytes
    depth: np.ndarray | None
    inertial: list[tuple[np.ndarray, np.ndarray, int]]


class CameraFiles(ABC):
    """One camera's files, open; use as a context manager."""

    @abstractmethod
    def write(self, shot: Shot) -> None:
        """Add a shot."""

    def close(self) -> None:  # noqa: B027 (folders have nothing to close)
        """Finish the files."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class CaptureFolder(ABC):
    """A capture below ``path`` with ``faults``; ``broken``: fault to the camera that has it."""

    calibration: str
    """File or folder of the calibration."""
    own_faults: frozenset[StudioFault]
    """Faults that recordings of this layout can have, beside those that any can."""

    def __init__(
        self, path: Path, faults: Sequence[StudioFault], broken: dict[str, int], *, depth: bool
    ) -> None:
        self.path, self.faults, self.broken, self.depth = path, faults, broken, depth

    @abstractmethod
    def open(self, device: Device) -> CameraFiles:
        """Begin one camera's files."""

    @abstractmethod
    def write_calibration(self, claimed: Rig, fps: int) -> None:
        """Write the calibration as it is claimed to be."""

    def image_number(self, t: int, order: int, fps: int) -> int:
        """What files of keypoints and candidates call the image of set ``t``, the ``order``-th."""
        return order

    def add_keypoints(self, camera: str, t: int, fps: int, content: str) -> None:  # noqa: B027
        """Lay a file of keypoints beside the images, where the layout has them there."""

    def add_masks(  # noqa: B027
        self, camera: str, t: int, fps: int, candidates: list[dict[str, Any]], label: str
    ) -> None:
        """The same for masks of the person and of the object, COCO label ``label``."""

    def lenses(self, claimed: Rig) -> list[Intrinsics]:
        """The colour lenses as the calibration has them: wrong where a fault says so."""
        found = [camera.colour for camera in claimed]
        if "swapped_lenses" in self.faults:
            a, b = SWAPPED
            found[a], found[b] = found[b], found[a]
        if "wrong_resolution" in self.broken:
            at = self.broken["wrong_resolution"]
            found[at] = found[at].scaled(WRONG_SIZE)
        return found


class KinectFolder(CaptureFolder):
    """``<camera>.mkv`` and a rig file."""

    calibration = "calibration.json"
    own_faults = frozenset({"same_serial", "backwards_clock"})

    def open(self, device: Device) -> CameraFiles:
        """An Azure Kinect recording."""
        return _KinectFile(self.path / f"{device.camera.name}.mkv", device)

    def write_calibration(self, claimed: Rig, fps: int) -> None:
        """The rig file; lenses are in the recordings."""
        poses = dict(zip(claimed.names, claimed.master_from_colour, strict=True))
        write_rig_file(self.path / self.calibration, Extrinsics(claimed.names[0], poses))


class _KinectFile(CameraFiles):
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

    def write(self, shot: Shot) -> None:
        if shot.time_us < self._last_us:
            self._writer.turn_back()
        self._last_us = shot.time_us
        self._writer.write_colour(shot.jpeg, shot.time_us)
        if shot.depth is not None:
            self._writer.write_depth(shot.depth, shot.time_us)
        for sample in shot.inertial:
            self._writer.write_imu(*sample)

    def close(self) -> None:
        self._writer.close()


class _ImageFiles(CameraFiles):
    """Colour and depth as single files; ``aligner`` where depth lies on the colour grid."""

    def __init__(self, aligner: Aligner | None) -> None:
        self._aligner = aligner

    def _paths(self, shot: Shot) -> tuple[Path, Path]:
        raise NotImplementedError

    def write(self, shot: Shot) -> None:
        colour, depth = self._paths(shot)
        colour.parent.mkdir(parents=True, exist_ok=True)
        colour.write_bytes(shot.jpeg)
        if shot.depth is None:
            return
        image = shot.depth if self._aligner is None else self._aligner.align(shot.depth)
        depth.parent.mkdir(parents=True, exist_ok=True)
        packed = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
        depth.write_bytes(packed.tobytes())


class ReleaseFolder(CaptureFolder):
    """InterCap's release: ``Frames_Cam<n>/color/%05d.jpg``, aligned depth beside it, and a folder
    of ``Color*.json``. There are no times but the numbers of the images."""

    calibration = "calibration"
    own_faults = frozenset({"swapped_lenses", "wrong_resolution"})

    def open(self, device: Device) -> CameraFiles:
        """One ``Frames_Cam<n>``."""
        aligner = Aligner(device.camera) if device.depth else None
        return _ReleaseFiles(self.path / f"Frames_Cam{device.index + 1}", aligner, device.fps)

    def image_number(self, t: int, order: int, fps: int) -> int:
        """The number in the image's name."""
        return _release_number(t, fps)

    def write_calibration(self, claimed: Rig, fps: int) -> None:
        """``Color.json``, ``Color_2.json``, ...: x_camera = R x_world + T."""
        folder = self.path / self.calibration
        folder.mkdir()
        for index, (camera, lens) in enumerate(zip(claimed, self.lenses(claimed), strict=True)):
            pose = camera.colour_from_master
            content = {
                "f": [lens.fx, lens.fy],
                "c": [lens.cx, lens.cy],
                "k": lens.distortion.tolist(),
                "R": Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist(),
                "T": pose[:3, 3].tolist(),
            }
            name = "Color.json" if index == 0 else f"Color_{index + 1}.json"
            (folder / name).write_text(json.dumps(content, indent=1) + "\n")


def _release_number(t: int, fps: int) -> int:
    return t * RELEASE_FPS // fps


class _ReleaseFiles(_ImageFiles):
    def __init__(self, folder: Path, aligner: Aligner | None, fps: int) -> None:
        super().__init__(aligner)
        self._folder, self._fps = folder, fps

    def _paths(self, shot: Shot) -> tuple[Path, Path]:
        name = f"{_release_number(shot.t, self._fps):05d}"
        return self._folder / "color" / f"{name}.jpg", self._folder / "depth" / f"{name}.png"


class BehaveFolder(CaptureFolder):
    """BEHAVE: ``t<seconds>/k<n>.color.jpg`` and ``.depth.png``, aligned; poses and lenses in
    folders of their own. Kinect 1 is the master."""

    calibration = f"calibs/{BEHAVE_DATE}/config"
    own_faults = frozenset({"wrong_resolution"})

    def open(self, device: Device) -> CameraFiles:
        """Images among those of the other cameras."""
        aligner = Aligner(device.camera) if device.depth else None
        return _BehaveFiles(self.path, device.camera.name, aligner, device.fps)

    def write_calibration(self, claimed: Rig, fps: int) -> None:
        """``<n>/config.json`` (camera to world) and ``intrinsics/<n>/calibration.json``."""
        for camera, lens in zip(claimed, self.lenses(claimed), strict=True):
            number, pose = camera.name[1:], camera.master_from_colour
            rotation, shift = pose[:3, :3].ravel().tolist(), pose[:3, 3].tolist()
            _write_json(
                self.path / self.calibration / number / "config.json",
                {"rotation": rotation, "translation": shift},
            )
            numbers = [lens.fx, lens.fy, lens.cx, lens.cy]
            colour = dict(zip(("fx", "fy", "cx", "cy"), numbers, strict=True))
            colour |= {"width": lens.width, "height": lens.height}
            content = {"color": colour | {"opencv": [*numbers, *lens.distortion.tolist()]}}
            _write_json(self.path / "calibs" / "intrinsics" / number / "calibration.json", content)

    def add_keypoints(self, camera: str, t: int, fps: int, content: str) -> None:
        """``k<n>.color.json``."""
        (_behave_frame(self.path, t, fps) / f"{camera}.color.json").write_text(content)

    def add_masks(
        self, camera: str, t: int, fps: int, candidates: list[dict[str, Any]], label: str
    ) -> None:
        """``k<n>.person_mask.jpg`` and ``k<n>.obj_rend_mask.jpg``: the first candidate of each."""
        for wanted, kind in (("person", "person_mask"), (label, "obj_rend_mask")):
            found = next((c for c in candidates if c["category"] == wanted), None)
            if found is not None:
                mask = 255 * coco.decode(found["segmentation"])
                path = _behave_frame(self.path, t, fps) / f"{camera}.{kind}.jpg"
                path.write_bytes(cv2.imencode(".jpg", mask)[1].tobytes())


def _behave_frame(folder: Path, t: int, fps: int) -> Path:
    return folder / f"t{t / fps:08.3f}"


class _BehaveFiles(_ImageFiles):
    def __init__(self, folder: Path, name: str, aligner: Aligner | None, fps: int) -> None:
        super().__init__(aligner)
        self._folder, self._name, self._fps = folder, name, fps

    def _paths(self, shot: Shot) -> tuple[Path, Path]:
        folder = _behave_frame(self._folder, shot.t, self._fps)
        return folder / f"{self._name}.color.jpg", folder / f"{self._name}.depth.png"


class PlainFolder(CaptureFolder):
    """``<camera>/`` with numbered JPEG files and timestamps, depth in its own lens below, and a
    calibration in OpenCV's terms."""

    calibration = "calibration.yaml"
    own_faults = frozenset({"backwards_clock", "wrong_resolution"})

    def open(self, device: Device) -> CameraFiles:
        """The camera's own folder."""
        return _PlainFiles(self.path / device.camera.name)

    def write_calibration(self, claimed: Rig, fps: int) -> None:
        """One file for all cameras: x_camera = R x_world + T."""
        cameras = {}
        for camera, lens in zip(claimed, self.lenses(claimed), strict=True):
            pose = camera.colour_from_master
            entry = {**_opencv(lens), "R": pose[:3, :3].tolist(), "T": pose[:3, 3].tolist()}
            if self.depth:
                assert camera.depth is not None and camera.colour_from_depth is not None
                between = {"colour_from_depth": camera.colour_from_depth.tolist()}
                entry["depth"] = {**_opencv(camera.depth), **between}
            cameras[camera.name] = entry
        content = {"master": claimed.names[0], "fps": fps, "cameras": cameras}
        (self.path / self.calibration).write_text(yaml.safe_dump(content, sort_keys=False))


class _PlainFiles(_ImageFiles):
    def __init__(self, folder: Path) -> None:
        super().__init__(None)
        self._folder = folder
        self._times: list[str] = []

    def _paths(self, shot: Shot) -> tuple[Path, Path]:
        name = f"{shot.t:06d}"
        return self._folder / f"{name}.jpg", self._folder / "depth" / f"{name}.png"

    def write(self, shot: Shot) -> None:
        super().write(shot)
        self._times.append(f"{shot.t:06d}, {shot.time_us / 1e6:.6f}\n")

    def close(self) -> None:
        (self._folder / "timestamps.csv").write_text("".join(self._times))


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
    "intercap": ReleaseFolder,
    "behave": BehaveFolder,
    "plain": PlainFolder,
}


def camera_names(layout: LayoutName, count: int) -> list[str]:
    """Names of the cameras, the master first: k1, k2, ... but k1, k0, k2, ... in BEHAVE."""
    if layout == "behave":
        return ["k1", "k0", *(f"k{number}" for number in range(2, count))][:count]
    return [f"k{number}" for number in range(1, count + 1)]
