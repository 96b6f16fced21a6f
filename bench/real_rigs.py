"""Public recordings of real cameras: `intercap calibrate`, and the reader of RealSense's bags.

    python -m bench.real_rigs pose2sim CLONE
    python -m bench.real_rigs caliscope CLONE
    python -m bench.real_rigs azure_kinect CLONE
    python -m bench.real_rigs realsense CLONE

CLONE is a git clone with its history. Files are extracted into ``results/real_rigs``.

- ``pose2sim``: demonstration of github.com/perfanalytics/pose2sim. Four cameras without depth; a
  person walks on a beam, another person stands in the background. OpenPose's keypoints (BODY_25B)
  are those of release v0.4.0, lenses and reference poses those of Qualisys.
- ``caliscope``: four-camera session in the tests of github.com/mprib/caliscope. Four webcams, a
  ChArUco board printed white on black. Lenses and reference poses are those of its
  ``camera_array.toml``.
- ``azure_kinect``: example of github.com/microsoft/Azure-Kinect-Sensor-SDK. 30 colour images of a
  ChArUco board; the first was taken together with an infrared image.
- ``realsense``: bag of a D435 (2018) in the unit tests of github.com/realsenseai/librealsense, with
  two depth images and a colour image. Images, times, lenses and the depth camera's pose are
  compared with those that ``pyrealsense2`` (release 2.57 or earlier) reads.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import subprocess
import tarfile
import time
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bench.command import exit_on_user_error
from intercap_core.commands.calibrate import calibrate
from intercap_core.entries import SequenceEntry
from intercap_core.formats.calibration.extrinsics import Extrinsics, write_rig_file
from intercap_core.formats.calibration.files import read_calibration
from intercap_core.formats.recordings.layouts import open_layout
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.project import load_project

SEQUENCE = "take"
CALISCOPE_BOARD = "charuco:4x5:0.054:0.0405:4X4_1000"  # charuco.toml
KINECT_BOARD = "charuco:14x9:0.04:0.03:5X5_250"  # PlaneFiles/plane.json


def pose2sim(clone: Path, folder: Path) -> None:
    """Find the poses by the person, and compare them with Qualisys's after a similarity."""
    _extract(clone, "v0.4.0", folder / "theirs", "Pose2Sim/Demo/pose")
    _extract(clone, "HEAD", folder / "theirs", "Pose2Sim/Demo_SinglePerson")
    theirs = folder / "theirs" / "Pose2Sim"
    reference = theirs / "Demo_SinglePerson" / "calibration" / "Calib.qca.txt"
    shutil.copytree(theirs / "Demo_SinglePerson" / "videos", folder / "recordings")
    lenses = {}
    for name, camera in read_calibration(reference).cameras.items():
        shutil.copytree(theirs / f"Demo/pose/cam{name[-1]}_json", folder / "keypoints" / name)
        video = cv2.VideoCapture(str(folder / "recordings" / f"{name}.mp4"))
        # two videos are 8 px narrower than their calibration states
        lenses[name] = _lens_entry(camera.colour) | {
            "image_size": [int(video.get(cv2.CAP_PROP_FRAME_WIDTH)), camera.colour.height]
        }
    _write_project(folder, keypoints=True)
    found = _calibrate(folder, {"cameras": lenses}, board=None)
    _print_differences(found, reference)


def caliscope(clone: Path, folder: Path) -> None:
    """Find the poses by the board, and compare them with caliscope's after a similarity."""
    session = "tests/sessions/4_cam_recording"
    for path in ("calibration/extrinsic", "camera_array.toml"):
        _extract(clone, "HEAD", folder / "theirs", f"{session}/{path}")
    theirs = folder / "theirs" / session
    shutil.copytree(
        theirs / "calibration" / "extrinsic",
        folder / "recordings",
        ignore=shutil.ignore_patterns("*.csv"),
    )
    lenses, posed = {}, {}
    cameras = tomllib.loads((theirs / "camera_array.toml").read_text())["cameras"]
    for number, camera in cameras.items():
        lens = {
            "image_size": camera["size"],
            "camera_matrix": camera["matrix"],
            "distortion_coefficients": camera["distortions"],
        }
        lenses[f"cam_{number}"] = lens
        posed[f"cam_{number}"] = lens | {"R": camera["rotation"], "T": camera["translation"]}
    reference = folder / "reference.json"
    reference.write_text(json.dumps({"master": "cam_1", "cameras": posed}))
    _write_project(folder, keypoints=False)
    found = _calibrate(folder, {"master": "cam_1", "cameras": lenses}, board=CALISCOPE_BOARD)
    _print_differences(found, reference)


def azure_kinect(clone: Path, folder: Path) -> None:
    """Find the lens of the colour camera and the pose of the infrared one by the board."""
    _extract(clone, "HEAD", folder / "theirs", "examples/calibration_registration")
    theirs = folder / "theirs" / "examples" / "calibration_registration" / "example_files"
    colour, infrared = (folder / "recordings" / name for name in ("colour", "infrared"))
    colour.mkdir(parents=True)
    infrared.mkdir()
    for number in range(30):
        shutil.copy(theirs / f"calibration/color-{number}.jpg", colour / f"{number:03d}.jpg")
    shutil.copy(theirs / "registration" / "ir-0.png", infrared / "000.png")
    lens = _read_lens(theirs / "registration" / "calib_ir.yml")
    _write_project(folder, keypoints=False)
    found = read_calibration(
        _calibrate(folder, {"fps": 1, "cameras": {"infrared": lens}}, board=KINECT_BOARD)
    )
    estimated = found.cameras["colour"].colour.matrix
    known = np.array(_read_lens(theirs / "calibration" / "calib.yml")["camera_matrix"])
    for name, at in (("fx", (0, 0)), ("fy", (1, 1)), ("cx", (0, 2)), ("cy", (1, 2))):
        print(f"{name}: {estimated[at]:.1f} px, theirs {known[at]:.1f}")
    pose = found.extrinsics.master_from_colour["infrared"]
    turn = np.degrees(Rotation.from_matrix(pose[:3, :3]).magnitude())
    print(f"infrared: {1e3 * np.round(pose[:3, 3], 5)} mm from the colour lens, {turn:.2f} degrees")


def realsense(clone: Path, folder: Path) -> None:
    """Read the bag, and print the largest differences from RealSense's own reader."""
    import pyrealsense2 as rs

    name = "unit-tests/resources/single_depth_color_640x480.bag"
    _extract(clone, "HEAD", folder, name)
    (folder / "recordings").mkdir()
    bag = Path(shutil.move(folder / name, folder / "recordings" / "k1.bag"))
    rig = folder / "rig.json"
    write_rig_file(rig, Extrinsics("k1", {"k1": np.eye(4)}))
    row = SequenceEntry(
        sequence=SEQUENCE, subject="p", recordings=bag.parent, layout="ros", calibration=rig
    )
    with open_layout(row).open("k1") as recording:
        camera, images, serial = recording.camera, list(recording.images()), recording.serial
    device = rs.context().load_device(str(bag))
    assert serial == device.get_info(rs.camera_info.serial_number)
    device.as_playback().set_real_time(False)
    frames, profiles = [], {}
    for sensor in device.query_sensors():
        (profile,) = sensor.get_stream_profiles()
        profiles[profile.stream_type()] = profile.as_video_stream_profile()
        queue = rs.frame_queue(16)
        sensor.open(profile)
        sensor.start(queue)
        time.sleep(1)  # the library reads in a thread of its own
        while frame := queue.poll_for_frame():
            frames.append((profile.stream_type(), frame.timestamp, np.array(frame.get_data())))
        sensor.stop()
        sensor.close()
    points = np.random.default_rng(0).uniform((-0.4, -0.3, 0.9), (0.4, 0.3, 3.0), (100, 3))
    print(f"serial number {serial}, noise of depth {camera.depth_noise:.5f} z^2 m")
    for kind, stream, lens in (
        ("colour", rs.stream.color, camera.colour), ("depth", rs.stream.depth, camera.depth),
    ):  # fmt: skip
        own = [image for image in images if image.kind == kind]
        theirs = [(at, data) for which, at, data in frames if which == stream]
        assert lens is not None
        true = profiles[stream].get_intrinsics()
        pixels = [rs.rs2_project_point_to_pixel(true, point) for point in points.tolist()]
        print(
            f"{kind}: {len(own)} images, theirs {len(theirs)}; projection "
            f"{np.abs(lens.project(points) - pixels).max():.2g} px"
        )
        for image, (at_ms, data) in zip(own, theirs, strict=False):
            content = image.content
            if isinstance(content, bytes):
                shown = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
                content = shown[..., ::-1]
            apart = np.abs(content.astype(float) - data)
            print(f"  {image.time_us - 1e3 * at_ms:.1f} us, {apart.mean():.3g} in the mean")
    pose = profiles[rs.stream.depth].get_extrinsics_to(profiles[rs.stream.color])
    assert camera.colour_from_depth is not None
    rotation = np.array(pose.rotation).reshape(3, 3).T  # by columns
    apart = camera.colour_from_depth - rigid(rotation, np.array(pose.translation))
    print(f"pose of the depth camera: {np.abs(apart).max():.2g}")


def _extract(clone: Path, revision: str, folder: Path, path: str) -> None:
    command = ["git", "-C", str(clone), "archive", revision, path]
    content = subprocess.run(command, check=True, capture_output=True).stdout
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        archive.extractall(folder, filter="data")


def _lens_entry(lens: Intrinsics) -> dict[str, Any]:
    return {
        "image_size": [lens.width, lens.height],
        "camera_matrix": lens.matrix.tolist(),
        "distortion_coefficients": lens.distortion.tolist(),
    }


def _read_lens(path: Path) -> dict[str, Any]:
    """A lens of the Azure Kinect's example as an entry of a calibration in OpenCV's terms."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    fields = {"image_size": "img_size", "camera_matrix": "K", "distortion_coefficients": "dist"}
    found = {field: file.getNode(name).mat() for field, name in fields.items()}
    return {
        field: (value if field == "camera_matrix" else value.ravel()).tolist()
        for field, value in found.items()
    }


def _write_project(folder: Path, *, keypoints: bool) -> None:
    """Write settings and tables of a project with one plain recording."""
    (folder / "config.yaml").write_text("dataset: real\nresults: results\n")
    (folder / "objects.yaml").write_text("{}\n")
    (folder / "subjects.tsv").write_text("subject\tgender\theight\nperson\tneutral\t\n")
    row = {
        "sequence": SEQUENCE, "subject": "person", "object": "", "layout": "plain",
        "recordings": "recordings", "calibration": "rig.json",
        "keypoints": "keypoints" if keypoints else "",
    }  # fmt: skip
    (folder / "sequences.tsv").write_text("\t".join(row) + "\n" + "\t".join(row.values()) + "\n")


def _calibrate(folder: Path, lenses: dict[str, Any], *, board: str | None) -> Path:
    path = folder / "lenses.json"
    path.write_text(json.dumps(lenses, indent=1))
    found, _ = calibrate(
        load_project(folder / "config.yaml"), SEQUENCE, output=None, lenses=path, board=board,
        recordings=[], distance=None, master=None, replace=False,
    )  # fmt: skip
    return found


def _print_differences(found: Path, reference: Path) -> None:
    """Print rotations and centres against a reference, after the best similarity of both rigs."""
    ours, theirs = (
        read_calibration(path).extrinsics.master_from_colour for path in (found, reference)
    )
    names = [name for name in theirs if name in ours]
    mine, true = (np.stack([of[name] for name in names]) for of in (ours, theirs))
    turn = Rotation.from_matrix(true[:, :3, :3] @ np.swapaxes(mine[:, :3, :3], 1, 2)).mean()
    turned = turn.apply(mine[:, :3, 3])
    turned, centres = turned - turned.mean(0), true[:, :3, 3] - true[:, :3, 3].mean(0)
    scale = float((turned * centres).sum() / (turned**2).sum())
    rotation = true[:, :3, :3] @ np.swapaxes(turn.as_matrix() @ mine[:, :3, :3], 1, 2)
    degrees = np.degrees(Rotation.from_matrix(rotation).magnitude())
    apart = 1e3 * np.linalg.norm(scale * turned - centres, axis=1)
    for name, angle, distance in zip(names, degrees, apart, strict=True):
        print(f"{name}: {angle:.2f} degrees, {distance:.1f} mm")
    print(f"scale of the reference over ours: {scale:.3f}")


DATA = {
    "pose2sim": pose2sim,
    "caliscope": caliscope,
    "azure_kinect": azure_kinect,
    "realsense": realsense,
}


def main() -> None:
    """Read the command line, extract, calibrate, compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", choices=DATA)
    parser.add_argument("clone", type=Path, help="clone of the repository that holds the data")
    options = parser.parse_args()
    folder = Path("results", "real_rigs", options.data).resolve()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    with exit_on_user_error():
        DATA[options.data](options.clone, folder)


if __name__ == "__main__":
    main()
