"""Calibrations, recordings and outputs of detectors."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from intercap_core.config import DetectionsSettings
from intercap_core.formats.calibration.extrinsics import Extrinsics, read_extrinsics, write_rig_file
from intercap_core.formats.calibration.files import RecordedCameras, read_calibration
from intercap_core.formats.calibration.k4a import colour_from_accelerometer
from intercap_core.formats.calibration.k4a import parse_camera as read_kinect
from intercap_core.formats.detections import candidate_files, keypoint_files
from intercap_core.formats.detections.class_names import COCO_NAMES, read_label_map
from intercap_core.formats.detections.image_numbers import CameraImages
from intercap_core.formats.detections.keypoints.coco import WHOLE_BODY
from intercap_core.formats.detections.onnx_pose import PoseModel
from intercap_core.formats.detections.onnx_segmentation import Segmenter
from intercap_core.formats.recordings import behave, intercap
from intercap_core.formats.recordings.image_files import (
    DamagedImage,
    encoded_size,
    read_colour,
    read_depth,
)
from intercap_core.formats.recordings.k4a import KinectRecording
from intercap_core.formats.recordings.source import CameraRecording
from intercap_core.formats.recordings.timestamps import pair_images, read_timestamps
from intercap_core.formats.recordings.video import VideoRecording
from intercap_core.geometry.camera import masks
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.studio.calibration import write_calibration
from tests.cases.test_detections import person_of
from tests.formats.calibration.test_opencv_calibration import example, write_node
from tests.formats.calibration.test_other_tools import FORMS, RECORDED, VIEWS
from tests.fuzz.plausible import IMAGE_SIZE, Kind, Notes, within
from tests.helpers import tiny_onnx, tiny_pose
from tests.helpers.kinect_files import MODES, make_camera, pose_of, record
from tests.helpers.release_folders import write_behave, write_intercap
from tests.helpers.videos import write_video

SIZE = (64, 48)
RIG = Rig((make_camera(0), make_camera(1)))
IMAGES = CameraImages("k1", IMAGE_SIZE, np.arange(4), np.arange(4), frozenset(range(4)), (*"abcd",))
PICTURE = np.zeros((*IMAGE_SIZE[::-1], 3), np.uint8)
PICTURE[60:120, 80:140], PICTURE[130:200, 200:260] = (0, 0, 255), (255, 0, 0)


def _text(name: str, text: str | bytes) -> Callable[[Path], object]:
    content = text.encode() if isinstance(text, str) else text
    return lambda folder: (folder / name).write_bytes(content)


def _read_kinect(folder: Path) -> Any:
    path = folder / "calibration.json"  # inside a recording it is an attachment, not a file
    content = path.read_bytes() if path.is_file() and path.stat().st_size < 1 << 24 else b""
    camera = read_kinect(content, **MODES, name="k1", source=path.name)
    turn = colour_from_accelerometer(content, source=path.name)
    within(-1.01, 1.01, [] if turn is None else turn)
    return camera.colour, camera.depth, camera.colour_from_depth


def _make_rig(folder: Path) -> None:
    write_rig_file(
        folder / "rig.json", Extrinsics("k1", {f"k{n + 1}": pose_of(n) for n in range(3)})
    )


def _read_intercap(folder: Path) -> Any:
    folder = folder / "Data/calibration_first"
    paths = [folder / "Color.json", folder / "Color_2.json"]
    return read_extrinsics(folder), [intercap.read_lens(path, (1280, 720)) for path in paths]


def _read_behave(folder: Path) -> Any:
    config = folder / "calibs/Date03/config"
    lenses = [behave.read_lens(config, n) for n in (0, 1)]
    for n, lens in enumerate(lenses):
        behave.check_lens(lens, f"intrinsics/{n}/calibration.json")
    return behave.read_poses(config), lenses


def _make_storage(folder: Path) -> None:
    for name, view in VIEWS.items():
        storage = cv2.FileStorage(str(folder / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        values = {
            "image_width": view.size[0],
            "image_height": view.size[1],
            "camera_matrix": view.matrix.tolist(),
            "distortion_coefficients": view.distortion[:5].tolist(),
            "R": view.camera_from_world[:3, :3].tolist(),
            "T": view.camera_from_world[:3, 3].tolist(),
        }
        for key, value in values.items():
            write_node(storage, key, value)
        storage.release()


def _calibration(
    name: str, form: str, make: Callable[[Path], object], files: list[str], path: str,
    recorded: RecordedCameras = RECORDED, scale: float | None = None,
) -> Kind:  # fmt: skip
    def read(folder: Path) -> Any:
        return read_calibration(folder / path, recorded, scale=scale)

    return Kind(name, form, make, files, read, ("files",))


def _read_recording(recording: CameraRecording) -> Any:
    """Walk through a recording as the frames stage does."""
    with recording:
        camera, images = recording.camera, list(recording.images())
        within(0.01, 1e5, recording.fps)
        within(0, 1, recording.preview().share)
        colour = [image.content for image in images if image.kind == "colour"]
        damaged = sum(encoded_size(content) is None for content in colour)
        notes = [note for note in recording.notes if "stored as JPEG" not in note]
        notes += ["damaged images"] * damaged + ["empty"] * (not images)
        sound = recording.sound()
        if sound is not None:
            within(0, 8000 * 700, len(sound.samples))
        return (
            (camera.colour, camera.colour_from_depth, recording.depth_delay_us, recording.serial),
            [image.time_us for image in images],
            Notes(f"{recording.source.name}: {note}" for note in notes),
        )


def _video(name: str, codec: str, sound: str) -> Kind:
    def read(folder: Path) -> Any:
        camera = Camera("left", Intrinsics(*SIZE, 50.0, 50.0, 32.0, 24.0), None, None, np.eye(4))
        path = folder / name
        return _read_recording(VideoRecording(path, camera, [], fps=None, offset_s=0.0, times=None))

    def make(folder: Path) -> None:
        shades = [np.full((*SIZE[::-1], 3), 20 * number, np.uint8) for number in range(6)]
        noise = np.random.default_rng(0).normal(0, 0.1, 9_600)
        write_video(folder / name, shades, codec, sound=noise, sound_codec=sound)

    return Kind(f"video-{name[2:]}", "bytes", make, [name], read)


def _make_images(folder: Path) -> None:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (48, 64, 3), np.uint8), (9, 9), 3)
    depth = rng.integers(500, 4000, (48, 64), np.uint16)
    for name, content in (("a.jpg", image), ("a.png", image), ("depth.png", depth)):
        cv2.imwrite(str(folder / name), content)


def _read_images(folder: Path) -> Any:
    notes = Notes()
    for name in ("a.jpg", "a.png", "depth.png"):
        try:
            if name == "depth.png":
                within(0, 2**16, read_depth(folder / name, SIZE))
            else:
                within(0, 2**32, encoded_size(read_colour(folder / name)[0]))
        except DamagedImage as error:
            notes.append(f"{name} {error}")
    return notes


def _read_times(folder: Path) -> Any:
    source = folder / "timestamps.csv"
    times = read_timestamps(source)
    colour = [Path(f"frame_{n:04d}.jpg") for n in range(20)]
    shots = pair_images(colour, [], fps=30, offset_s=0, times=times, source=source).pairs
    return times, [shot.time_us for shot in shots]


def _read_candidates(folder: Path) -> Any:
    options: dict[str, Any] = {"layout": "plain", "min_score": 0.05, "names": COCO_NAMES}
    found = candidate_files.read_camera(folder, IMAGES, **options)
    look = candidate_files.preview_candidates(folder, IMAGES, names=COCO_NAMES)
    notes = [note for note in (*found.notes, *look.notes) if "scaled" not in note]
    return list(found.by_image.values()), list(look.labels), Notes(f"camera k1: {n}" for n in notes)


def _read_keypoints(folder: Path) -> Any:
    found = keypoint_files.read_camera(folder, IMAGES, full_confidence=1.0)
    for people in found.by_image.values():
        within(0, 1, people[..., 2])
        within(-1, max(IMAGE_SIZE), people[..., :2])
    look = keypoint_files.preview_keypoints(folder, IMAGES, full_confidence=1.0)
    return Notes(f"camera k1: {note}" for note in (*found.notes, *look.notes))


def _person(count: int) -> np.ndarray:
    """Keypoints (count, 3) over the image."""
    place = np.linspace(0, 1, count)[:, None]
    return np.hstack([60 + 200 * place, 40 + 150 * place**2, np.full_like(place, 0.8)]).round(2)


def _make_openpose(folder: Path) -> None:
    lists = {"hand_left": 21, "hand_right": 21, "face": 70}
    person = {f"{k}_keypoints_2d": _person(n).ravel().tolist() for k, n in lists.items()}
    person["pose_keypoints_2d"] = person_of("body_25")
    (folder / "k1").mkdir()
    for n in range(4):
        content = json.dumps({"version": 1.3, "people": [person, person]})
        (folder / f"k1/{n:06d}_keypoints.json").write_text(content)


BODY = _person(len(WHOLE_BODY))
WHOLE_BODIES = [
    {"image_id": n, "category_id": 1, "score": 0.9, "keypoints": BODY.ravel().tolist()}
    for n in range(4)
]
MMPOSE = {
    "instance_info": [
        {"frame_id": n + 1, "instances": [
            {"keypoints": BODY[:, :2].tolist(), "keypoint_scores": BODY[:, 2].tolist()}]}
        for n in range(4)
    ]
}  # fmt: skip
MASK = np.zeros(IMAGE_SIZE[::-1], np.uint8)
cv2.ellipse(MASK, (150, 110), (60, 35), 20, 0, 360, 1, -1)
RLE = masks.encode(MASK)
LENGTHS = np.diff(masks.Runs(RLE, *MASK.shape).ends, prepend=0).tolist()
OUTLINE = [10, 12, 60, 10, 60.5, 70, 12, 66]
COCO_RESULTS = [
    {"image_id": n, "category_id": 47, "score": 0.9 - 0.1 * n, "bbox": [90, 75, 120, 72],
     "segmentation": form}
    for n, form in enumerate((
        {"size": [240, 320], "counts": RLE.decode()}, {"size": [240, 320], "counts": LENGTHS},
        [OUTLINE], {"size": [240, 320], "counts": RLE.decode()},
    ))
]  # fmt: skip
COCO_DATA_SET = {
    "images": [{"id": n, "file_name": f"{'abcd'[n]}.jpg", "width": 160, "height": 120}
               for n in range(4)],
    "categories": [{"id": 1, "name": "cup"}, {"id": 2, "name": "person"}],
    "annotations": [{"id": n, "image_id": n, "category_id": 1 + n % 2, "confidence": 0.7,
                     "segmentation": [OUTLINE] if n else {"x": OUTLINE[::2], "y": OUTLINE[1::2]}}
                    for n in range(4)],
}  # fmt: skip


def _make_masks(folder: Path) -> None:
    (folder / "k1").mkdir()
    for name in "abcd":
        cv2.imwrite(str(folder / f"k1/{name}__cup.png"), 255 * MASK)


def _labels(name: str, form: str, text: str) -> Kind:
    def read(folder: Path) -> Any:
        return read_label_map(folder / name)

    return Kind(name, form, _text(name, text), [name], read)


def _segment(folder: Path) -> Any:
    model = Segmenter.load(DetectionsSettings(segmentation_model=folder / "model.onnx"))
    return [instances for _, instances in model.segment([(0, PICTURE)])]


def _find_people(folder: Path) -> Any:
    model = PoseModel.load(DetectionsSettings(keypoint_model=folder / "model.onnx"))
    assert model.find(PICTURE, []).shape[1:] == (135, 3)


def _json(name: str, content: object, read: Callable[[Path], Any], file: str = "k1.json") -> Kind:
    return Kind(name, "json", _text(file, json.dumps(content)), [file], read, ("camera k1",))


_NOTHING: dict[str, Any] = {"colour": lambda t, c: None, "depth": lambda t, c: None}
_KINECT = write_calibration(make_camera(0), serial="1", **MODES)
KINDS = (
    Kind("kinect-calibration", "json", _text("calibration.json", _KINECT), ["calibration.json"],
         _read_kinect),
    Kind("rig", "json", _make_rig, ["rig.json"],
         lambda folder: read_extrinsics(folder / "rig.json")),
    Kind("intercap-calibration", "json",
         lambda folder: write_intercap(folder, RIG, numbers=(), **_NOTHING),
         ["Data/calibration_first/Color.json", "Data/calibration_first/Color_2.json"],
         _read_intercap),
    Kind("behave-calibration", "json",
         lambda folder: write_behave(folder, RIG, times=["0003.000"], **_NOTHING),
         ["calibs/Date03/config/0/config.json", "calibs/intrinsics/1/calibration.json"],
         _read_behave, ("config",)),
    _calibration("opencv-json", "json", _text("rig.json", json.dumps(yaml.safe_load(example()))),
                 ["rig.json"], "rig.json", RecordedCameras()),
    _calibration("opencv-yaml", "yaml", _text("rig.yaml", example()), ["rig.yaml"], "rig.yaml",
                 RecordedCameras()),
    _calibration("opencv-storage", "yaml", _make_storage, ["left.yml", "front.yml"], "."),
    *(
        _calibration(name, form, FORMS[name][0], files, path, scale=FORMS[name][1])
        for name, form, files, path in (
            ("pose2sim", "toml", ["Calib_scene.toml"], "Calib_scene.toml"),
            ("anipose", "toml", ["calibration.toml"], "calibration.toml"),
            ("easymocap-sizes", "yaml", ["intri.yml", "extri.yml"], "."),
            ("colmap-text", "text", ["cameras.txt", "images.txt"], "."),
            ("colmap-binary", "bytes", ["cameras.bin", "images.bin"], "."),
            ("nerfstudio", "json", ["transforms.json"], "transforms.json"),
        )
    ),
    Kind("kinect-recording", "bytes", lambda folder: record(folder, 0, range(2)), ["k1.mkv"],
         lambda folder: _read_recording(KinectRecording(folder / "k1.mkv", "k1", pose_of(0)))),
    _video("a.mp4", "mpeg4", "aac"),
    _video("a.mkv", "mjpeg", "flac"),
    _video("a.mov", "mjpeg", "pcm_s16le"),
    Kind("images", "bytes", _make_images, ["a.jpg", "a.png", "depth.png"], _read_images),
    Kind("timestamps", "text",
         _text("timestamps.csv", "name,seconds\n" + "".join(
             f"frame_{n:04d}.jpg,{3.5 + n / 30:.6f}\n" for n in range(20))),
         ["timestamps.csv"], _read_times),
    Kind("openpose", "json", _make_openpose,
         ["k1/000000_keypoints.json", "k1/000002_keypoints.json"], _read_keypoints, ("camera k1",)),
    _json("wholebody", WHOLE_BODIES, _read_keypoints),
    _json("mmpose", MMPOSE, _read_keypoints, "results_k1.json"),
    _json("coco-results", COCO_RESULTS, _read_candidates),
    _json("coco-data-set", COCO_DATA_SET, _read_candidates),
    Kind("mask-images", "bytes", _make_masks, ["k1/a__cup.png", "k1/c__cup.png"],
         _read_candidates, ("camera k1", "no mask for")),
    _labels("labels.json", "json", json.dumps(
        {"categories": [{"id": n, "name": COCO_NAMES[n]} for n in (1, 2, 47)]})),
    _labels("labels.yaml", "yaml", "names:\n  0: person\n  1: cup\n  2: chair\n"),
    _labels("labels.txt", "text", "person\ncup\nchair\n"),
    Kind("onnx-yolo", "bytes",
         lambda folder: tiny_onnx.yolo(folder / "model.onnx", (320, 256), {"task": "segment"}),
         ["model.onnx"], _segment),
    Kind("onnx-rcnn", "bytes",
         lambda folder: tiny_onnx.mask_rcnn(folder / "model.onnx", "torchvision"),
         ["model.onnx"], _segment),
    Kind("onnx-pose", "bytes", lambda folder: tiny_pose.simcc(folder / "model.onnx"),
         ["model.onnx"], _find_people),
)  # fmt: skip
