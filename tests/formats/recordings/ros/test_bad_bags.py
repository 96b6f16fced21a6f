"""Bags with faults: what is missing, ambiguous, damaged or of an unknown form."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode

from intercap_core.commands.check_recordings import check_row
from intercap_core.config import DetectionsSettings, FramesSettings
from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.layouts import (
    input_files,
    open_layout,
    recognise_recordings,
)
from intercap_core.stages import frames
from tests.formats.recordings.ros.test_standard import place_of, row
from tests.helpers.kinect_files import notes_of
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
    pose,
    rig_file,
    write_camera,
)


def write(folder: Path, change) -> Path:
    """A bag of one camera without lenses or images; ``change`` adds to it."""
    with BagFile(folder / "walk", "mcap") as bag:
        bag.transforms(k1_color=("map", np.eye(4)), k1_depth=("k1_color", COLOUR_FROM_DEPTH))
        change(bag)
    return folder


def colour_of(bag: BagFile, encoding: str = "bgr8") -> None:
    bag.image("/k1/color/image_raw", START_NS, "k1_color", colour_image(0), encoding)


def lens_of(bag: BagFile, **fields) -> None:
    bag.lens("/k1/color/camera_info", COLOUR_SIZE, COLOUR_K, "k1_color", **fields)


def two_depth_streams(bag: BagFile) -> None:
    write_camera(bag)
    bag.lens("/k1/aligned_depth_to_color/camera_info", DEPTH_SIZE, DEPTH_K, "k1_color")
    topic = "/k1/aligned_depth_to_color/image_raw"
    bag.image(topic, START_NS, "k1_color", depth_image(0), "16UC1")


def depth_elsewhere(bag: BagFile) -> None:
    lens_of(bag)
    colour_of(bag)
    bag.lens("/k1/depth/camera_info", DEPTH_SIZE, DEPTH_K, "elsewhere")
    bag.image("/k1/depth/image_raw", START_NS, "elsewhere", depth_image(0), "16UC1")


FAULTY = {
    "no CameraInfo": (
        colour_of,
        "no message on /k1/color/camera_info.*or state the colour lens in column calibration",
    ),
    "two depth streams": (two_depth_streams, "holds 2 streams of depth.*column topics"),
    "unknown encoding": (
        lambda bag: (lens_of(bag), colour_of(bag, "bayer_rggb8")),
        "topic /k1/color/image_raw has images of encoding 'bayer_rggb8', expected",
    ),
    "unknown compression": (
        lambda bag: (lens_of(bag), bag.compressed(
            "/k1/color/image_raw/compressed", START_NS, "k1_color", b"1234", "rgb8; avif")),
        "has images of format 'rgb8; avif', expected",
    ),
    "fisheye": (
        lambda bag: (lens_of(bag, model="equidistant", d=(0.1, 0, 0, 0)), colour_of(bag)),
        "distortion model is 'equidistant', expected plumb_bob",
    ),
    "no calibration": (
        lambda bag: (bag.lens("/k1/color/camera_info", COLOUR_SIZE, np.zeros((3, 3)), "k1_color",
                              d=()), colour_of(bag)),
        "states no lens in /k1/color/camera_info.*or state the colour lens in column calibration",
    ),
    "depth without pose": (depth_elsewhere, "no static transform connects them"),
    "no colour": (
        lambda bag: bag.image("/k1/depth/image_raw", START_NS, "k1_depth", depth_image(0), "16UC1"),
        "has no colour images of camera /k1",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTY)
def test_a_faulty_camera_is_named(tmp_path: Path, fault: str) -> None:
    change, message = FAULTY[fault]
    write(tmp_path, change)
    layout = open_layout(row(tmp_path, calibration=rig_file(tmp_path, "k1")))
    assert layout.names == ["k1"]
    with pytest.raises(UserError, match=message):
        layout.open("k1")


@pytest.mark.parametrize("calibration", ["static transforms", "rig file"])
def test_a_camera_that_cannot_be_read_is_left_out_with_the_reason(
    tmp_path: Path, calibration: str
) -> None:
    recordings, output = tmp_path / "recordings", tmp_path / "frames.h5"
    recordings.mkdir()
    for name, encoding in (("k1", "bayer_rggb8"), ("k2", "bgr8"), ("k3", "bgr8")):
        with BagFile(recordings / f"{name}.bag", "bag") as bag:
            write_camera(bag, name, world=pose(0.1, float(name[1]), 0, 0), depth=False,
                         encoding=encoding)  # fmt: skip
    (recordings / "k3.bag").write_bytes(b"no bag at all" * 10)
    rig = rig_file(tmp_path, "k1", "k2", "k3") if calibration == "rig file" else None
    entry = row(recordings, calibration=rig)
    frames.run(sequence=entry, output=output, settings=FramesSettings())
    notes = notes_of(output)
    assert "k1.bag: topic /k1/color/image_raw has images of encoding 'bayer_rggb8'" in notes["k1"]
    assert "record another topic of the camera, or convert the bag" in notes["k1"]
    assert "k3.bag: cannot be read as a ROS bag" in notes["k3"]
    assert str(tmp_path) not in "".join(notes.values())
    with Frames.open(output) as result:
        seen = dict(zip(result.rig.names, result.colour_available.sum(axis=0), strict=True))
    assert seen == {"k1": 0, "k2": 4, "k3": 0}
    settings = SimpleNamespace(detections=DetectionsSettings(), frames=FramesSettings())
    faults = check_row(SimpleNamespace(config=settings, object_of=lambda _: None), entry).faults
    assert [name for name in ("k1", "k2", "k3") if f"{name}.bag" in " ".join(faults)] == [
        "k1",
        "k3",
    ]


@pytest.mark.parametrize(
    "topic", ["/k1/depth/image_rect_raw ", "/k1/color/camera_info", "k1/color/image_raw"]
)
def test_an_unknown_topic_in_the_column_is_named(tmp_path: Path, topic: str) -> None:
    with BagFile(tmp_path / "walk", "mcap") as bag:
        write_camera(bag)
    known = "/k1/color/image_raw, /k1/depth/image_raw"
    with pytest.raises(UserError, match=f"column topics names '{topic.strip()}', .* are {known};"):
        open_layout(row(tmp_path, f"/k1/color/image_raw {topic}"))


def test_cameras_without_common_frame_are_named(tmp_path: Path) -> None:
    with BagFile(tmp_path / "walk", "mcap") as bag:
        write_camera(bag, "k1")
        write_camera(bag, "k2", world=pose(0.1, 1.0, 0, 0))
        bag.transforms(k2_color=("elsewhere", np.eye(4)))
    with pytest.raises(UserError, match="connects frame 'k2_color' of camera k2"):
        open_layout(row(tmp_path))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("share", [0.02, 0.6, 0.97])
def test_a_cut_file_is_named_with_its_repair(tmp_path: Path, form: Form, share: float) -> None:
    path = place_of(tmp_path, form, "walk")
    with BagFile(path, form) as bag:
        write_camera(bag, images=20)
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    rig = rig_file(tmp_path, "walk", "k1")  # a bag that cannot be opened names the camera
    with pytest.raises(UserError, match=r"cannot be read as a ROS bag \(.*repair it"):
        layout = open_layout(row(tmp_path, calibration=rig))
        for camera in layout.names:
            with layout.open(camera) as recording:
                list(recording.images())


def test_an_interrupted_recording_is_named_with_its_repair(tmp_path: Path) -> None:
    """Recorders that are killed leave a bag folder without metadata, and ``.bag.active``."""
    for name in ("cut", "split", "whole"):
        with BagFile(tmp_path / name, "mcap") as bag:
            write_camera(bag)
        (tmp_path / name / "metadata.yaml").unlink()
        (tmp_path / name / f"{name}.mcap").rename(tmp_path / name / f"{name}_0.mcap")
    with BagFile(tmp_path / "active.bag.active", "bag") as bag:
        write_camera(bag)
    for file, change in (
        ("cut/cut_0.mcap", lambda c: c[:-99]),
        ("active.bag.active", without_index),
    ):
        (tmp_path / file).write_bytes(change((tmp_path / file).read_bytes()))
    (tmp_path / "split/split_1.mcap").touch()
    names = ["active", "cut", "split", "whole"]
    assert recognise_recordings(tmp_path) == ("ros", names)
    layout = open_layout(row(tmp_path, calibration=rig_file(tmp_path, *names)))
    for name, words in (
        ("active", r"active\.bag\.active: .*rosbag reindex FILE, then"),
        ("cut", r"/cut: .*ros2 bag reindex FOLDER"),
        ("split", r"/split: .*ros2 bag reindex FOLDER"),
    ):
        with pytest.raises(UserError, match=words):
            layout.open(name)
    with layout.open("whole") as recording:
        assert len(list(recording.images())) == 8
    watched = {path.name for path in input_files(row(tmp_path))}
    assert {"active.bag.active", "cut_0.mcap"} <= watched
    (tmp_path / "cut/metadata.yaml").touch()
    assert tmp_path / "cut/metadata.yaml" in input_files(row(tmp_path))


def test_other_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "k1.bag").write_bytes(b"")
    (tmp_path / "k2.bag").write_bytes(b"no bag at all" * 10)
    with pytest.raises(UserError, match=r"k1.bag: cannot be read .*seems to be empty"):
        open_layout(row(tmp_path))
    for path in tmp_path.iterdir():
        path.unlink()
    with BagFile(tmp_path / "k1.bag", "bag") as bag:
        bag.transforms(k1_color=("map", np.eye(4)))
    with pytest.raises(UserError, match=r"no bag has a topic of type sensor_msgs/.*/tf_static"):
        open_layout(row(tmp_path))


def test_the_missing_extra_is_named(tmp_path: Path, monkeypatch) -> None:
    with BagFile(tmp_path / "k1.bag", "bag") as bag:
        write_camera(bag)
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(UserError, match=r"k1.bag: .*'intercap-core\[ros\]'"):
        open_layout(row(tmp_path))
    with pytest.raises(UserError, match=r"intercap-core\[ros\]"):
        recognise_recordings(tmp_path)


def without_index(content: bytes) -> bytes:
    """A .bag as `rosbag record` leaves it when it is killed: the index is at position 0."""
    at = content.index(b"index_pos=") + len(b"index_pos=")
    return content[:at] + bytes(8) + content[at + 8 :]


@pytest.mark.parametrize(
    ("form", "change", "words"),
    [
        ("bag", without_index, "Bag is not indexed.*rosbag reindex"),
        ("bag", lambda c: c.replace(b"=none", b"=abcd"), "'abcd'.*rosbag decompress"),
        ("mcap", lambda c: c.replace(b"zstd", b"abcd"), "compression 'abcd'.*ros2 bag convert"),
    ],
)
def test_bags_without_index_or_of_unknown_compression_are_named(
    tmp_path: Path, form: Form, change: Callable[[bytes], bytes], words: str
) -> None:
    path = place_of(tmp_path, form, "walk")
    written = BagFile(path, form)
    if form == "mcap":
        written.compress(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with written as bag:
        write_camera(bag)
    file = path if path.is_file() else next(path.glob("*.mcap"))
    file.write_bytes(change(file.read_bytes()))
    with pytest.raises(UserError, match=rf"walk\S*: cannot be read as a ROS bag \(.*{words}"):
        layout = open_layout(row(tmp_path, calibration=rig_file(tmp_path, "walk", "k1")))
        layout.open(layout.names[0])


def test_a_clock_that_jumps_back_is_noted(tmp_path: Path) -> None:
    """The other camera goes on; the note names the camera and the jump."""
    with BagFile(tmp_path / "walk", "mcap") as bag:
        write_camera(bag, "k1", images=20, depth=False)
        write_camera(bag, "k2", images=0, world=pose(0.1, 1.0, 0, 0), depth=False)
        for t in range(20):
            at = START_NS + t * PERIOD_NS
            stamp = at - (5 * 10**9 if t >= 14 else 0)
            bag.image("/k2/color/image_raw", at, "k2_color", colour_image(t), "bgr8", stamp)
    path = tmp_path / "frames.h5"
    frames.run(sequence=row(tmp_path), output=path, settings=FramesSettings())
    assert "jump back 1 times: 6 images" in notes_of(path)["k2"]


def test_cameras_with_the_same_images_in_one_bag_are_named(tmp_path: Path) -> None:
    with BagFile(tmp_path / "walk", "mcap") as bag:
        write_camera(bag, "k1")
        write_camera(bag, "k2", world=pose(0.1, 1.0, 0, 0))
    path = tmp_path / "frames.h5"
    frames.run(sequence=row(tmp_path), output=path, settings=FramesSettings())
    assert (
        "cameras k1 (walk) and k2 (walk) hold the same images: k2 is left out"
        in notes_of(path)["k1"]
    )
