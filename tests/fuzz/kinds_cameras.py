"""Calibrations: Azure Kinect's, rig files, OpenCV's, other tools', released data sets'."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from intercap_core.formats.calibration.extrinsics import Extrinsics, read_extrinsics, write_rig_file
from intercap_core.formats.calibration.files import RecordedCameras, read_calibration
from intercap_core.formats.calibration.k4a import colour_from_accelerometer
from intercap_core.formats.calibration.k4a import read_calibration as read_kinect
from intercap_core.formats.recordings import behave, intercap
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import is_rigid
from intercap_core.studio.calibration import write_calibration
from tests.fuzz.kind import ImplausibleError, Kind, finite, within
from tests.geometry.camera.test_calibration_files import FORMS, RECORDED, VIEWS
from tests.helpers.kinect_files import MODES, make_camera, pose_of
from tests.helpers.release_folders import behave_lens

NEAR = np.stack(np.meshgrid([-0.2, 0.0, 0.2], [-0.2, 0.0, 0.2]), -1).reshape(-1, 2)


def check_lens(lens: Intrinsics) -> None:
    """A lens that some camera may have: it images its surroundings once, at a sensible scale."""
    side = max(lens.width, lens.height)
    within(0.2, 20, fx=lens.fx / side, fy=lens.fy / side)
    within(-1, 2, cx=lens.cx / lens.width, cy=lens.cy / lens.height)
    within(1, 40_000, width=lens.width, height=lens.height)
    half = min(lens.width, lens.height) / 2 / min(lens.fx, lens.fy)
    points = np.column_stack([NEAR / 0.4 * half, np.ones(len(NEAR))])
    pixels = lens.project(points)
    finite(pixels=pixels)
    away = np.linalg.norm(pixels - [lens.cx, lens.cy], axis=1)
    if away.max() > 6 * side or (away[[0, 1, 2, 3, 5, 6, 7, 8]] < 1e-3 * side).any():
        raise ImplausibleError(f"the lens images its edge {away.round(1)} px from its centre")


def check_pose(pose: np.ndarray) -> None:
    """A rigid transform within a hall."""
    if not is_rigid(pose, 1e-2):
        raise ImplausibleError(f"a pose is {pose}")
    within(-100, 100, translation=pose[:3, 3])


def check_extrinsics(extrinsics: Extrinsics) -> None:
    """Each camera at a place of its own."""
    for pose in extrinsics.master_from_colour.values():
        check_pose(pose)
    places = np.array([pose[:3, 3] for pose in extrinsics.master_from_colour.values()])
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    if len(places) > 1 and (apart + np.eye(len(places))).min() < 1e-3:
        raise ImplausibleError("two cameras are in one place")


def _read_kinect(folder: Path) -> None:
    content = (folder / "calibration.json").read_bytes() if _is_file(folder) else b""
    camera = read_kinect(content, **MODES, name="k1", source="calibration.json")
    check_lens(camera.colour)
    assert camera.depth is not None and camera.colour_from_depth is not None
    check_lens(camera.depth)
    check_pose(camera.colour_from_depth)
    within(-2, 2, baseline=camera.colour_from_depth[:3, 3])
    turn = colour_from_accelerometer(content, source="calibration.json")
    if turn is not None:
        within(-1.01, 1.01, turn=turn)


def _is_file(folder: Path) -> bool:
    path = folder / "calibration.json"
    return path.is_file() and path.stat().st_size < 1 << 24  # inside a recording it is bytes


def _make_kinect(folder: Path) -> None:
    (folder / "calibration.json").write_bytes(
        write_calibration(make_camera(0), serial="1", **MODES)
    )


def _make_rig(folder: Path) -> None:
    poses = {f"k{n + 1}": pose_of(n) for n in range(3)}
    write_rig_file(folder / "rig.json", Extrinsics("k1", poses))


def _make_release(folder: Path) -> None:
    for n, name in enumerate(("Color.json", "Color_2.json")):
        pose = np.linalg.inv(pose_of(n))
        lens = make_camera(n).colour
        content = {
            "f": [lens.fx, lens.fy], "c": [lens.cx, lens.cy], "k": [0.1, -0.2, 0.001, 0.002, 0.05],
            "R": cv2.Rodrigues(pose[:3, :3])[0].ravel().tolist(), "T": pose[:3, 3].tolist(),
        }  # fmt: skip
        (folder / name).write_text(json.dumps(content))


def _read_release(folder: Path) -> None:
    check_extrinsics(read_extrinsics(folder))
    for name in ("Color.json", "Color_2.json"):
        check_lens(intercap.read_lens(folder / name, (1280, 720)))


def _make_behave(folder: Path) -> None:
    for n in (0, 1):
        pose = pose_of(n)
        (folder / f"config/{n}").mkdir(parents=True)
        (folder / f"intrinsics/{n}").mkdir(parents=True)
        content = {"rotation": pose[:3, :3].ravel().tolist(), "translation": pose[:3, 3].tolist()}
        (folder / f"config/{n}/config.json").write_text(json.dumps(content))
        (folder / f"intrinsics/{n}/calibration.json").write_text(
            json.dumps({"color": behave_lens(make_camera(n).colour)})
        )


def _read_behave(folder: Path) -> None:
    check_extrinsics(behave.read_poses(folder / "config"))
    for n in (0, 1):
        lens = behave.read_lens(folder / "config", n)
        behave.check_lens(lens, f"intrinsics/{n}/calibration.json")
        check_lens(lens)


def _opencv() -> dict[str, object]:
    cameras = {}
    for name, view in VIEWS.items():
        cameras[name] = {
            "image_size": list(view.size),
            "camera_matrix": view.matrix.tolist(),
            "distortion_coefficients": view.distortion[:5].tolist(),
            "R": view.camera_from_world[:3, :3].tolist(),
            "T": view.camera_from_world[:3, 3].tolist(),
            "time_offset": 0.25,
            "depth": "aligned",
        }
    first = next(iter(cameras.values()))
    first["depth"] = {
        "image_size": [640, 576],
        "camera_matrix": [[500.0, 0, 320.0], [0, 500.0, 288.0], [0, 0, 1]],
        "distortion_coefficients": [0.1, 0.01, 0.0, 0.0],
        "colour_from_depth": np.eye(4).tolist(),
    }
    return {"master": "left", "fps": 30.0, "cameras": cameras}


def _make_opencv_json(folder: Path) -> None:
    (folder / "rig.json").write_text(json.dumps(_opencv()))


def _make_opencv_yaml(folder: Path) -> None:
    import yaml

    text = yaml.safe_dump(_opencv(), sort_keys=False, default_flow_style=None)
    (folder / "rig.yaml").write_text(text)


def _make_storage(folder: Path) -> None:
    for name, view in VIEWS.items():
        storage = cv2.FileStorage(str(folder / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", view.size[0])
        storage.write("image_height", view.size[1])
        storage.write("camera_matrix", view.matrix)
        storage.write("distortion_coefficients", view.distortion[:5])
        storage.write("R", view.camera_from_world[:3, :3])
        storage.write("T", view.camera_from_world[:3, 3])
        storage.release()


def _calibration(name: str, recorded: RecordedCameras, scale: float | None) -> object:
    def read(folder: Path) -> None:
        found = read_calibration(folder / name, recorded, scale=scale)
        check_extrinsics(found.extrinsics)
        for camera in found.cameras.values():
            check_lens(camera.colour)
            within(-1e9, 1e9, time_offset=camera.time_offset)
            within(0.01, 1e5, fps=camera.fps or 30)
            if camera.depth is not None and camera.colour_from_depth is not None:
                check_lens(camera.depth)
                check_pose(camera.colour_from_depth)

    return read


def _other(form: str, kind: str, files: list[str], path: str = "") -> Kind:
    make, scale = FORMS[form]
    return Kind(form, kind, make, files, _calibration(path or files[0], RECORDED, scale),
                named=("files",))  # fmt: skip


_DATA_SET = "recordings of a data set"
KINDS = (
    Kind("kinect-calibration", "json", _make_kinect, ["calibration.json"], _read_kinect),
    Kind(
        "rig", "json", _make_rig, ["rig.json"],
        lambda folder: check_extrinsics(read_extrinsics(folder / "rig.json")),
    ),
    Kind("intercap-calibration", "json", _make_release, ["Color.json", "Color_2.json"],
         _read_release, named=("files",)),
    Kind("behave-calibration", "json", _make_behave,
         ["config/1/config.json", "config/0/config.json", "intrinsics/1/calibration.json"],
         _read_behave, named=("config",)),
    Kind("opencv-json", "json", _make_opencv_json, ["rig.json"],
         _calibration("rig.json", RECORDED, None)),
    Kind("opencv-yaml", "yaml", _make_opencv_yaml, ["rig.yaml"],
         _calibration("rig.yaml", RECORDED, None)),
    Kind("opencv-storage", "yaml", _make_storage, ["left.yml", "front.yml"],
         _calibration(".", RECORDED, None), named=("files",)),
    _other("pose2sim", "toml", ["Calib_scene.toml"]),
    _other("anipose", "toml", ["calibration.toml"]),
    _other("easymocap-sizes", "yaml", ["intri.yml", "extri.yml"], "."),
    _other("colmap-text", "text", ["cameras.txt", "images.txt"], "."),
    _other("colmap-binary", "bytes", ["cameras.bin", "images.bin"], "."),
    _other("nerfstudio", "json", ["transforms.json"]),
)  # fmt: skip
