"""The recording reader: a real recording against an independent parse, and bad files."""

from __future__ import annotations

import struct
from pathlib import Path

import av
import cv2
import numpy as np
import psutil
import pytest

from intercap_core.errors import UserError
from intercap_core.formats.calibration.k4a import parse_camera
from intercap_core.formats.recordings.k4a import KinectFile, parse_imu_samples
from intercap_core.studio.calibration import write_calibration
from intercap_core.studio.mkv import MkvWriter
from tests.helpers.kinect_files import MODES, make_camera

CALIBRATION = write_calibration(make_camera(0), serial="1", **MODES)
MASTERS = {0x18538067, 0x1F43B675, 0xA0, 0x1941A469, 0x61A7}  # elements that hold elements


def ebml(data: bytes, start: int = 0, end: int | None = None):
    """Walk Matroska elements, knowing nothing but ids and lengths: yields (id, payload)."""
    at, end = start, len(data) if end is None else end
    while at < end:
        width = 9 - data[at].bit_length()
        number = int.from_bytes(data[at : at + width], "big")
        at += width
        width = 9 - data[at].bit_length()
        length = int.from_bytes(data[at : at + width], "big") & ((1 << 7 * width) - 1)
        at += width
        if number in MASTERS:
            yield from ebml(data, at, at + length)
        else:
            yield number, data[at : at + length]
        at += length


def blocks(data: bytes) -> list[tuple[int, int, bytes]]:
    """(track, time in the file, payload) of every block."""
    found, cluster = [], 0
    for number, payload in ebml(data):
        if number == 0xE7:
            cluster = int.from_bytes(payload, "big")
        elif number in (0xA3, 0xA1):
            relative = struct.unpack(">h", payload[1:3])[0]
            found.append((payload[0] & 0x7F, cluster + relative, payload[4:]))
    return found


def test_real_depth_equals_an_independent_parse_in_every_pixel(real_recording):
    raw = blocks(real_recording.read_bytes())
    with KinectFile(real_recording) as recording:
        packets = list(recording.packets())
        depth = [p for p in packets if p.kind == "depth"]
        images = [recording.depth_image(p.content) for p in depth]
    expected = [np.frombuffer(b, ">u2").reshape(576, 640) for track, _, b in raw if track == 2]
    assert len(images) == len(expected) > 0
    for image, other in zip(images, expected, strict=True):
        assert image.dtype == np.uint16 and np.array_equal(image, other)
    assert np.mean(images[0] > 0) > 0.2 and 300 < np.median(images[0][images[0] > 0]) < 6000


def test_real_colour_times_and_head(real_recording):
    raw = blocks(real_recording.read_bytes())
    with KinectFile(real_recording) as recording:
        info = recording.info
        packets = list(recording.packets())
    assert (info.colour_mode, info.depth_mode, info.fps) == ("720P", "NFOV_UNBINNED", 5)
    assert info.serial == "001514394512"
    assert info.start_offset_us == 336_277 and not info.truncated
    numbers = {"colour": 1, "depth": 2, "imu": 4}
    ours = [(numbers[p.kind], p.device_time_us, p.content) for p in packets]
    assert ours == [(n, t + 336_277, b) for n, t, b in raw if n != 3]
    colour = next(p for p in packets if p.kind == "colour")
    image = cv2.imdecode(np.frombuffer(colour.content, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (720, 1280, 3)


def test_real_calibration_and_gravity(real_recording, real_calibration):
    attached = next(p for n, p in ebml(real_recording.read_bytes()) if n == 0x465C)
    with KinectFile(real_recording) as recording:
        assert recording.info.calibration == attached
        camera = recording.camera("k1")
        samples = [parse_imu_samples(p.content) for p in recording.packets() if p.kind == "imu"]
        rotation = recording.colour_from_accelerometer()
    other = parse_camera(
        real_calibration, colour_mode="720P", depth_mode="NFOV_UNBINNED", name="k1", source="json"
    )
    assert np.array_equal(camera.colour.parameters, other.colour.parameters)
    assert np.array_equal(camera.depth.parameters, other.depth.parameters)
    assert np.array_equal(camera.colour_from_depth, other.colour_from_depth)
    acceleration = np.concatenate(samples)[:, :3].mean(axis=0)
    assert np.linalg.norm(acceleration) == pytest.approx(9.81, abs=0.3)
    down = rotation @ -acceleration / np.linalg.norm(acceleration)
    assert down[1] > 0.8  # the camera stood upright


def write(path: Path, frames: int = 5, **changes) -> Path:
    options = dict(
        calibration_json=b"{}", colour_mode="720P", depth_mode="NFOV_2X2BINNED", fps=30,
        serial="1", start_offset_ns=2_000_000_000,
    )  # fmt: skip
    jpeg = cv2.imencode(".jpg", np.full((720, 1280, 3), 99, np.uint8))[1].tobytes()
    options |= changes
    with MkvWriter(path, **options) as writer:
        for index in range(frames):
            time_us = options["start_offset_ns"] // 1000 + index * 33_333
            writer.write_colour(jpeg, time_us)
            if options["depth_mode"]:
                writer.write_depth(np.full((288, 320), index, np.uint16), time_us)
    return path


def read(path: Path) -> list:
    with KinectFile(path) as recording:
        return list(recording.packets())


def test_a_cut_file_gives_its_complete_images(tmp_path):
    whole = write(tmp_path / "whole.mkv").read_bytes()
    expected = read(tmp_path / "whole.mkv")
    cut = tmp_path / "cut.mkv"
    counts = []
    for share in (0.3, 0.5, 0.75, 0.95, 0.99):
        cut.write_bytes(whole[: int(len(whole) * share)])
        with KinectFile(cut) as recording:
            assert recording.info.truncated
            packets = list(recording.packets())
        assert packets == expected[: len(packets)]
        counts.append(len(packets))
    assert counts == sorted(counts) and 0 < counts[0] < counts[-1] <= 10


def test_an_unfinished_file_is_readable(tmp_path):
    """Without the final patch the length is unknown and there is no index."""
    path = write(tmp_path / "k1.mkv")
    expected = read(path)
    data = bytearray(path.read_bytes())
    at = data.find(b"\x18\x53\x80\x67") + 4
    data[at : at + 8] = b"\x01" + b"\xff" * 7
    path.write_bytes(data)
    with KinectFile(path) as recording:
        assert recording.info.truncated
        assert list(recording.packets()) == expected


def test_packets_without_an_image_keep_their_place(tmp_path):
    path = tmp_path / "k1.mkv"
    jpeg = cv2.imencode(".jpg", np.zeros((720, 1280, 3), np.uint8))[1].tobytes()
    with MkvWriter(
        path, calibration_json=b"{}", colour_mode="720P", depth_mode=None, fps=30, serial="1"
    ) as writer:
        for time_us, content in enumerate([jpeg + b"\0\0", jpeg[:-2], b"noise"]):
            writer.write_colour(content, time_us * 40_000)
    with KinectFile(path) as recording:
        assert [p.device_time_us for p in recording.packets()] == [0, 40_000, 80_000]


def another_video(path: Path, whole: bytes) -> None:
    with av.open(str(path), "w", format="matroska") as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height = 64, 48
        frame = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8))
        container.mux(stream.encode(frame))
        container.mux(stream.encode())


def test_clocks_that_count_from_1970_are_read(tmp_path):
    """Orbbec's K4A wrapper sets the clock of a Femto camera to that of the computer."""
    start_us = 1_760_000_000_123_456
    path = write(tmp_path / "femto.mkv", start_offset_ns=start_us * 1000)
    times = [p.device_time_us for p in read(path) if p.kind == "depth"]
    assert times == [start_us + index * 33_333 for index in range(5)]


def tagged(**times_ns):
    return lambda path, whole: write(path, calibration_json=CALIBRATION, **times_ns)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path, whole: None, "cannot be read"),
        (lambda path, whole: path.write_bytes(b""), "is empty"),
        (lambda path, whole: path.write_text("no images\n" * 500), "not a Matroska file"),
        (lambda path, whole: path.write_bytes(whole[:30]), "cannot be opened"),
        (lambda path, whole: path.mkdir(), "cannot be read"),
        (lambda path, whole: write(path, calibration_json=None), "holds no calibration.json"),
        (lambda path, whole: path.write_bytes(whole.replace(b"COLOR", b"COL0R")), "no COLOR track"),
        (another_video, "no COLOR track"),
        (tagged(start_offset_ns=10**398), "tag K4A_START_OFFSET_NS is .*expected nanoseconds"),
        (tagged(start_offset_ns=(1 << 63) * 1000), "tag K4A_START_OFFSET_NS"),
        (tagged(depth_delay_ns=10**29), "tag K4A_DEPTH_DELAY_NS"),
    ],
)  # fmt: skip
def test_unusable_files_are_refused(tmp_path, make, words):
    whole = write(tmp_path / "whole.mkv").read_bytes()
    path = tmp_path / "k1.mkv"
    make(path, whole)
    with pytest.raises(UserError, match=words) as caught, KinectFile(path) as recording:
        list(recording.packets())
    message = str(caught.value)
    assert str(path) in message and "\n" not in message and ";" in message


def test_memory_does_not_grow_with_length(tmp_path):
    process = psutil.Process()

    def growth(frames: int) -> int:
        path = write(tmp_path / f"{frames}.mkv", frames)
        peak = before = process.memory_info().rss
        with KinectFile(path) as recording:
            for index, _ in enumerate(recording.packets()):
                if index % 50 == 0:
                    peak = max(peak, process.memory_info().rss)
        return peak - before

    growth(50)
    assert growth(600) < 20e6  # the file has 120 MB
