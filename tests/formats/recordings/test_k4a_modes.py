"""Every colour and depth mode that the device has, written and read back through the layout."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from intercap_core.errors import UserError
from intercap_core.formats.calibration.extrinsics import Extrinsics, write_rig_file
from intercap_core.formats.calibration.k4a import COLOUR_MODES, DEPTH_MODES
from intercap_core.formats.recordings.encodings import JPEG_QUALITY
from intercap_core.formats.recordings.k4a import KinectLayout
from intercap_core.formats.recordings.source import CameraRecording, Image
from intercap_core.studio.calibration import write_calibration
from intercap_core.studio.mkv import MkvWriter
from tests.helpers.kinect_files import MODES, make_camera, row

CALIBRATION = write_calibration(make_camera(0), serial="1", **MODES)


def picture(width: int, height: int) -> np.ndarray:
    """Smooth colour, so that halved chroma and JPEG change it little."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    bands = [40 + 150 * x, 60 + 120 * y, 200 - 100 * x * y]
    return np.stack(bands, -1).astype(np.uint8)


def raw_bytes(image: np.ndarray, colour_format: str) -> bytes:
    """The image as the device sends it: planes of 4:2:0, pairs of 4:2:2, or four channels."""
    if colour_format == "BGRA":
        return cv2.cvtColor(image, cv2.COLOR_BGR2BGRA).tobytes()
    height, width = image.shape[:2]
    planes = cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420)
    luma, rest = planes[:height], planes[height:].ravel()
    u, v = (plane.reshape(height // 2, width // 2) for plane in np.split(rest, 2))
    if colour_format == "NV12":
        return luma.tobytes() + np.stack([u, v], -1).tobytes()
    packed = np.empty((height, width, 2), np.uint8)
    packed[..., 0] = luma
    packed[:, 0::2, 1], packed[:, 1::2, 1] = np.repeat(u, 2, axis=0), np.repeat(v, 2, axis=0)
    return packed.tobytes()


def write(folder: Path, **options) -> MkvWriter:
    usual = dict(colour_mode="720P", depth_mode=None, fps=30, serial="1")
    return MkvWriter(folder / "k1.mkv", calibration_json=CALIBRATION, **(usual | options))


def read(folder: Path) -> tuple[CameraRecording, list[Image]]:
    write_rig_file(folder / "rig.json", Extrinsics("k1", {"k1": np.eye(4)}))
    with KinectLayout(row(folder, folder / "rig.json")).open("k1") as recording:
        return recording, list(recording.images())


@pytest.mark.parametrize("mode", DEPTH_MODES)
def test_every_depth_mode(tmp_path, mode):
    width, height = DEPTH_MODES[mode].size
    depth = np.random.default_rng(0).integers(0, 5000, (height, width), dtype=np.uint16)
    with write(tmp_path, depth_mode=mode, fps=5) as writer:
        writer.write_depth(depth, 100)
    recording, images = read(tmp_path)
    assert [(i.kind, i.time_us) for i in images] == [("depth", 100)]
    assert np.array_equal(images[0].content, depth)
    lens = recording.camera.depth
    assert (lens.width, lens.height) == (width, height)


@pytest.mark.parametrize("mode", COLOUR_MODES)
def test_every_colour_mode_is_copied(tmp_path, mode):
    width, height = COLOUR_MODES[mode].size
    jpeg = cv2.imencode(".jpg", np.zeros((height, width, 3), np.uint8))[1].tobytes()
    with write(tmp_path, colour_mode=mode) as writer:
        writer.write_colour(jpeg, 0)
    recording, images = read(tmp_path)
    assert images == [Image("colour", 0, jpeg)] and recording.notes == []
    lens = recording.camera.colour
    assert (lens.width, lens.height) == (width, height) and recording.camera.depth is None


@pytest.mark.parametrize(
    ("colour_format", "mode"), [("NV12", "720P"), ("YUY2", "720P"), ("BGRA", "1080P")]
)
def test_raw_colour_is_stored_as_jpeg_with_a_note(tmp_path, colour_format, mode):
    width, height = COLOUR_MODES[mode].size
    image = picture(width, height)
    raw = raw_bytes(image, colour_format)
    with write(tmp_path, colour_mode=mode, colour_format=colour_format) as writer:
        writer.write_colour(raw, 0)
        writer.write_colour(raw[:-2], 40_000)  # cut short
        writer.write_colour(raw, 80_000)
    recording, images = read(tmp_path)
    assert [i.time_us for i in images] == [0, 40_000, 80_000]
    assert images[1].content == b"" and images[0].content == images[2].content
    read_back = cv2.imdecode(np.frombuffer(images[0].content, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(read_back.astype(int) - image).mean() < 1.5
    assert recording.notes == [
        f"colour was recorded as {colour_format} and is stored as JPEG of quality {JPEG_QUALITY}"
    ]


def test_passive_infrared_is_no_depth(tmp_path):
    path = tmp_path / "k1.mkv"
    with write(tmp_path, depth_mode="WFOV_UNBINNED", with_ir=True) as writer:
        writer.write_ir(np.ones((1024, 1024), np.uint16), 0)
    content = path.read_bytes()
    assert content.count(b"WFOV_UNBINNED") == 1
    path.write_bytes(content.replace(b"WFOV_UNBINNED", b"PASSIVE_IR\0\0\0"))
    recording, images = read(tmp_path)
    assert recording.camera.depth is None and images == []


def test_an_unknown_codec_is_named(tmp_path):
    path = tmp_path / "k1.mkv"
    with write(tmp_path) as writer:
        writer.write_colour(bytes(100), 0)
    path.write_bytes(path.read_bytes().replace(b"MJPG\0", b"Y800\0"))
    with pytest.raises(UserError, match="recorded as Y800, expected MJPG, NV12"):
        read(tmp_path)
