"""`intercap calibrate` on public recordings, compared with the calibrations of their authors.

    python -m bench.real_rigs pose2sim CLONE
    python -m bench.real_rigs azure_kinect CLONE

CLONE is a git clone with its history. Files are extracted into ``results/real_rigs``.

- ``pose2sim``: demonstration of github.com/perfanalytics/pose2sim. Four cameras without depth; a
  person walks on a beam, another person stands in the background. OpenPose's keypoints (BODY_25B)
  are those of release v0.4.0, lenses and reference poses those of Qualisys.
- ``azure_kinect``: example of github.com/microsoft/Azure-Kinect-Sensor-SDK. 30 colour images of a
  ChArUco board; the first was taken together with an infrared image.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import subprocess
import tarfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from bench.command import exit_on_user_error
from intercap_core.commands.calibrate import calibrate
from intercap_core.formats.calibration.files import read_calibration
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.project import load_project

SEQUENCE = "take"
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


DATA = {"pose2sim": pose2sim, "azure_kinect": azure_kinect}


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
