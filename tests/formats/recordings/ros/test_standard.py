"""Topics of ROS nodes in bags of both releases: images, lenses, poses, and faulty bags."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags import rosbag1, rosbag2

from intercap_core.config import FramesSettings
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.encodings import encoded_size
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.layouts import open_layout, recognise_recordings
from intercap_core.formats.recordings.source import CameraRecording, Image
from intercap_core.geometry.camera.transforms import invert
from intercap_core.stages import frames
from tests.helpers.ros_files import (
    COLOUR_FROM_DEPTH,
    COLOUR_K,
    COLOUR_SIZE,
    DEPTH_K,
    DEPTH_SIZE,
    FORMS,
    PERIOD_NS,
    START_NS,
    BagFile,
    Form,
    colour_image,
    depth_image,
    encode_rvl,
    jpeg,
    png,
    pose,
    rig_file,
    write_camera,
)


def row(folder: Path, topics: str | None = None, calibration: Path | None = None) -> SequenceEntry:
    return SequenceEntry(
        sequence="one", subject="p", recordings=folder, layout="ros", topics=topics,
        calibration=calibration or folder,
    )  # fmt: skip


def open_camera(folder: Path, name: str, topics: str | None = None) -> CameraRecording:
    return open_layout(row(folder, topics)).open(name)


def read(folder: Path, name: str, topics: str | None = None) -> dict[str, list[Image]]:
    with open_camera(folder, name, topics) as recording:
        images = list(recording.images())
    return {kind: [i for i in images if i.kind == kind] for kind in ("colour", "depth")}


def decoded(content) -> np.ndarray:
    """(H, W, 3) BGR of an image file."""
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)


def place_of(folder: Path, form: Form, name: str) -> Path:
    return folder / (f"{name}.bag" if form == "bag" else name)


@pytest.mark.parametrize("form", FORMS)
def test_two_cameras_of_one_bag_are_read(tmp_path: Path, form: Form) -> None:
    second = pose(1.1, -1.5, 0.1, 1.2)
    with BagFile(place_of(tmp_path, form, "walk"), form) as bag:
        write_camera(bag, "k1")
        write_camera(bag, "k2", world=second)
    assert recognise_recordings(tmp_path) == ("ros", ["k1", "k2"])
    layout = open_layout(row(tmp_path))
    assert layout.extrinsics.master == "k1"
    assert np.allclose(layout.extrinsics.master_from_colour["k2"], second, atol=1e-12)
    with layout.open("k2") as recording:
        camera, preview = recording.camera, recording.preview()
        images = list(recording.images())
    assert (preview.size, preview.images) == (COLOUR_SIZE, 4)
    assert recording.fps == pytest.approx(30.0, rel=1e-3)
    assert camera.depth is not None and camera.colour_from_depth is not None
    assert np.array_equal(camera.colour.matrix, COLOUR_K)
    assert np.array_equal(camera.depth.matrix, DEPTH_K)
    assert camera.colour.distortion[:5].tolist() == [0.1, -0.05, 0.001, -0.002, 0.01]
    assert np.allclose(camera.colour_from_depth, COLOUR_FROM_DEPTH, atol=1e-12)
    for kind in ("colour", "depth"):
        times = [image.time_us for image in images if image.kind == kind]
        assert times == [(START_NS + t * PERIOD_NS) // 1000 for t in range(4)]
    depth = [image.content for image in images if image.kind == "depth"]
    assert all(np.array_equal(depth[t], depth_image(t)) for t in range(4))
    colour = [decoded(image.content) for image in images if image.kind == "colour"]
    assert all(np.abs(colour[t].astype(int) - colour_image(t)).mean() < 2 for t in range(4))
    assert "stored as JPEG" in " ".join(recording.notes)


ZSTD = rosbag2.CompressionFormat.ZSTD


@pytest.mark.parametrize(
    ("form", "how"),
    [
        ("bag", (rosbag1.Writer.CompressionFormat.LZ4,)),
        ("bag", (rosbag1.Writer.CompressionFormat.BZ2,)),
        ("mcap", (rosbag2.CompressionMode.STORAGE, ZSTD)),
        ("mcap", (rosbag2.CompressionMode.MESSAGE, ZSTD)),
        ("db3", (rosbag2.CompressionMode.MESSAGE, ZSTD)),
        ("db3", (rosbag2.CompressionMode.FILE, ZSTD)),
    ],
    ids=str,
)
def test_compressed_bags_have_the_same_images(
    tmp_path: Path, form: Form, how: tuple[Any, ...]
) -> None:
    images, sizes = [], []
    for name, compression in (("plain", ()), ("compressed", how)):
        folder = tmp_path / name
        folder.mkdir()
        written = BagFile(place_of(folder, form, "walk"), form)
        if compression:
            written.compress(*compression)
        with written as bag:
            write_camera(bag, images=20)
        assert recognise_recordings(folder) == ("ros", ["k1"])
        images.append(read(folder, "k1"))
        sizes.append(sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()))
    plain, compressed = images
    assert sizes[1] < sizes[0]
    for kind, expected in plain.items():
        assert len(expected) == 20
        for image, other in zip(expected, compressed[kind], strict=True):
            assert image.time_us == other.time_us
            assert np.array_equal(np.asarray(image.content), np.asarray(other.content))


def test_files_of_one_camera_each_are_named_by_the_file(tmp_path: Path) -> None:
    for number, name in enumerate(("left", "right")):
        with BagFile(tmp_path / f"{name}.bag", "bag") as bag:
            write_camera(bag, "camera", world=pose(0.5 * number, float(number), 0, 0))
    # Both bags have equal frames, so their transforms say nothing about the two cameras.
    layout = open_layout(row(tmp_path, calibration=rig_file(tmp_path, "left", "right")))
    assert layout.names == ["left", "right"]
    assert np.allclose(layout.extrinsics.master_from_colour["right"], pose(0.1, 2.0, 0, 0))
    with pytest.raises(UserError, match="in one place"):
        open_layout(row(tmp_path))


@pytest.mark.parametrize(
    "text",
    [
        "16UC1; compressedDepth png",
        "16UC1; compressedDepth",
        "16UC1; compressedDepth rvl",
        "16UC1; png compressed ",
    ],
)
def test_compressed_depth_is_lossless(tmp_path: Path, text: str) -> None:
    with BagFile(tmp_path / "walk", "mcap") as bag:
        write_camera(bag, depth=False)
        bag.lens("/k1/depth/camera_info", DEPTH_SIZE, DEPTH_K, "k1_depth")
        for t in range(3):
            packed = encode_rvl(depth_image(t)) if text.endswith("rvl") else png(depth_image(t))
            head = bytes(12) if "compressedDepth" in text else b""
            transport = "compressedDepth" if head else "compressed"
            topic = f"/k1/depth/image_raw/{transport}"
            bag.compressed(topic, START_NS + t * PERIOD_NS, "k1_depth", head + packed, text)
    images = read(tmp_path, "k1")["depth"]
    assert len(images) == 3
    assert all(np.array_equal(images[t].content, depth_image(t)) for t in range(3))


def test_metres_and_quantised_inverse_depth_are_converted(tmp_path: Path) -> None:
    true = depth_image(0)
    metres = np.where(true == 0, np.nan, true * 1e-3).astype(np.float32)
    # compressed_depth_image_transport: value = a / z + b for distances up to 10 m
    a, b = 100.0 * 101.0, 1 - 100.0 * 101.0 / 10.0
    quantised = np.where(true == 0, 0, a / np.nan_to_num(metres, nan=1.0) + b).astype(np.uint16)
    content = struct.pack("<iff", 1, a, b) + png(quantised)
    with BagFile(tmp_path / "walk", "mcap") as bag:
        write_camera(bag, depth=False)
        for stream in ("depth", "depth_registered"):
            bag.lens(f"/k1/{stream}/camera_info", DEPTH_SIZE, DEPTH_K, "k1_depth")
        bag.image("/k1/depth/image_raw", START_NS, "k1_depth", metres, "32FC1", padding=8)
        bag.compressed("/k1/depth_registered/image_raw/compressedDepth", START_NS, "k1_depth",
                       content, "32FC1; compressedDepth png")  # fmt: skip
    exact = read(tmp_path, "k1", "/k1/depth/image_raw")["depth"][0].content
    assert np.array_equal(exact, true)
    topic = "/k1/depth_registered/image_raw/compressedDepth"
    coarse = np.asarray(read(tmp_path, "k1", topic)["depth"][0].content).astype(int)
    assert np.array_equal(coarse == 0, true == 0)
    step = (true * 1e-3) ** 2 / a * 1000 + 1  # of the quantisation, and of a millimetre
    assert (np.abs(coarse - true)[true > 0] <= step[true > 0]).all()


COLOUR_FORMS = {
    "rgb8": lambda image: image[..., ::-1],
    "rgba8": lambda image: cv2.cvtColor(image, cv2.COLOR_BGR2RGBA),
    "bgra8": lambda image: cv2.cvtColor(image, cv2.COLOR_BGR2BGRA),
    "yuv422_yuy2": lambda image: _yuyv(image),
    "yuv422": lambda image: _yuyv(image)[..., ::-1],
}


def _yuyv(image: np.ndarray) -> np.ndarray:
    """(H, W, 2) YUYV with limited range, BT.601."""
    b, g, r = (image[..., c].astype(float) for c in range(3))
    y = 16 + 0.257 * r + 0.504 * g + 0.098 * b
    u = 128 - 0.148 * r - 0.291 * g + 0.439 * b
    v = 128 + 0.439 * r - 0.368 * g - 0.071 * b
    packed = np.stack([y, u], -1)
    packed[:, 1::2, 1] = v[:, ::2]
    return np.rint(packed).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("encoding", COLOUR_FORMS)
def test_raw_colour_becomes_the_same_colours(tmp_path: Path, encoding: str) -> None:
    image = cv2.GaussianBlur(colour_image(0), (0, 0), 2)
    with BagFile(tmp_path / "walk.bag", "bag") as bag:
        write_camera(bag, depth=False, images=0)
        content = COLOUR_FORMS[encoding](image)
        bag.image("/k1/color/image_raw", START_NS, "k1_color", content, encoding, padding=4)
    shown = decoded(read(tmp_path, "k1")["colour"][0].content)
    assert np.abs(shown.astype(int) - image).mean() < 2.5


def test_jpeg_is_copied(tmp_path: Path) -> None:
    content = jpeg(colour_image(0))
    with BagFile(tmp_path / "walk", "db3") as bag:
        write_camera(bag, images=0, depth=False)
        text = "rgb8; jpeg compressed bgr8"
        bag.compressed("/k1/color/image_raw/compressed", START_NS, "k1_color", content, text)
    assert read(tmp_path, "k1")["colour"][0].content == content
    assert encoded_size(content) == COLOUR_SIZE


def test_rectified_images_have_the_projection_matrix(tmp_path: Path) -> None:
    projection = np.hstack([COLOUR_K * [[0.9], [0.9], [1]], np.zeros((3, 1))])
    with BagFile(tmp_path / "walk", "mcap") as bag:
        bag.lens("/k1/color/camera_info", COLOUR_SIZE, COLOUR_K, "k1_color", p=projection)
        bag.transforms(k1_color=("map", np.eye(4)))
        image = colour_image(0)
        bag.image("/k1/color/image_rect_color", START_NS, "k1_color", image, "bgr8")
    with open_camera(tmp_path, "k1") as recording:
        assert np.allclose(recording.camera.colour.matrix, projection[:, :3])
        assert not recording.camera.colour.distortion.any()


def test_depth_aligned_to_colour_shares_its_frame(tmp_path: Path) -> None:
    with BagFile(tmp_path / "walk", "mcap") as bag:
        write_camera(bag, depth=False)
        topic = "/k1/aligned_depth_to_color"
        bag.lens(f"{topic}/camera_info", COLOUR_SIZE, COLOUR_K, "k1_color")
        depth = np.full(COLOUR_SIZE[::-1], 1500, np.uint16)
        bag.image(f"{topic}/image_raw", START_NS, "k1_color", depth, "16UC1")
    with open_camera(tmp_path, "k1") as recording:
        assert recording.camera.aligned


def test_times_come_from_the_headers_and_else_from_the_recording(tmp_path: Path) -> None:
    with BagFile(tmp_path / "k1.bag", "bag") as bag:
        write_camera(bag, images=0, depth=False)
        for t, stamp in enumerate((50, 51, 20, 21)):  # the device's clock is set back
            at = START_NS + t * PERIOD_NS
            image = colour_image(t)
            bag.image("/k1/color/image_raw", at, "k1_color", image, "bgr8", stamp * PERIOD_NS)
    times = [image.time_us for image in read(tmp_path, "k1")["colour"]]
    assert times == [n * PERIOD_NS // 1000 for n in (50, 51, 20, 21)]
    (tmp_path / "k1.bag").unlink()
    with BagFile(tmp_path / "k1.bag", "bag") as bag:
        write_camera(bag, images=0, depth=False)
        for t in range(2):
            at = START_NS + t * PERIOD_NS
            bag.image("/k1/color/image_raw", at, "k1_color", colour_image(t), "bgr8", stamp=0)
    with open_camera(tmp_path, "k1") as recording:
        assert [i.time_us for i in recording.images()] == [
            (START_NS + t * PERIOD_NS) // 1000 for t in range(2)
        ]
        assert "time of recording" in recording.timing


def test_a_topic_that_stops_is_noted(tmp_path: Path) -> None:
    with BagFile(tmp_path / "walk", "mcap") as bag:
        write_camera(bag, images=2)
        for t in range(2, 90):
            at = START_NS + t * PERIOD_NS
            bag.image("/k1/color/image_raw", at, "k1_color", colour_image(t), "bgr8")
    with open_camera(tmp_path, "k1") as recording:
        list(recording.images())
    assert "/k1/depth/image_raw stops 2.9 s before /k1/color/image_raw" in " ".join(recording.notes)


@pytest.mark.parametrize("baseline", [0.0, 0.05])
def test_a_stated_baseline_gives_the_noise_of_stereo(tmp_path: Path, baseline: float) -> None:
    with BagFile(tmp_path / "walk", "mcap") as bag:
        write_camera(bag)
    path, settings = tmp_path / "frames.h5", FramesSettings(stereo_baseline_m=baseline)
    frames.run(sequence=row(tmp_path), output=path, settings=settings)
    with Frames.open(path) as read_back:
        found = read_back.rig[0].depth_noise
    assert found == pytest.approx(0.08 / (DEPTH_K[0, 0] * baseline) if baseline else 0.0)


def test_static_transforms_are_followed_through_the_tree(tmp_path: Path) -> None:
    first, second = pose(0.3, 1, 2, 3), pose(-0.2, 0.5, 0, 0.1)
    with BagFile(tmp_path / "walk", "mcap") as bag:
        write_camera(bag, "k1", world=first)
        write_camera(bag, "k2")
        bag.transforms(k2_color=("k2_mount", second), k2_mount=("map", first))
    found = open_layout(row(tmp_path)).extrinsics.master_from_colour["k2"]
    assert np.allclose(found, invert(first) @ first @ second, atol=1e-9)
