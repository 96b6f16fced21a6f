"""The plain layout: folders of images and videos with a calibration in OpenCV's terms."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections.image_numbers import camera_images
from intercap_core.formats.recordings.encodings import turn
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.layouts import list_unread, open_layout
from intercap_core.formats.recordings.video import read_video_size
from intercap_core.schemas import FRAMES
from tests.helpers.kinect_files import notes_of, row, run
from tests.helpers.videos import write_video

SIZE, DEPTH_SIZE = (64, 48), (32, 24)
FPS = 25


def picture(camera: int, number: int) -> np.ndarray:
    image = np.full((SIZE[1], SIZE[0], 3), (40 * camera, 5 * number, 128), np.uint8)
    cv2.circle(image, (5 + number, 20), 6, (255, 255, 255), -1)
    return image


def jpeg(camera: int, number: int) -> bytes:
    return cv2.imencode(".jpg", picture(camera, number))[1].tobytes()


def depth_of(camera: int, number: int, size=DEPTH_SIZE) -> np.ndarray:
    return np.full((size[1], size[0]), 1000 + 100 * camera + number, np.uint16)


def lens(size=SIZE) -> dict:
    matrix = [[60.0, 0, size[0] / 2], [0, 60.0, size[1] / 2], [0, 0, 1]]
    coefficients = [0.1, -0.05, 0.001, -0.001, 0.01]
    return dict(image_size=size, camera_matrix=matrix, distortion_coefficients=coefficients)


def pictures(camera: int, count: int = 8):
    return (picture(camera, number) for number in range(count))


def calibrated(**changes) -> dict:
    own_depth = lens(DEPTH_SIZE) | {"colour_from_depth": np.eye(4).tolist()}
    cameras = {
        "left": lens() | {"R": [0, 0, 0], "T": [0, 0, 0], "depth": own_depth},
        "right": lens() | {"R": [0, 0.5, 0], "T": [1, 0, 0.2], "depth": "aligned"},
        "top": lens() | {"R": np.eye(3).tolist(), "T": [[0], [1], [0]]},
    }
    for name, change in changes.items():
        cameras[name] |= change
    return {"master": "left", "fps": FPS, "cameras": cameras}


def write_images(folder: Path, camera: int, numbers, *, depth_size=None, colour="", suffix="jpg"):
    (folder / colour).mkdir(parents=True, exist_ok=True)
    for number in numbers:
        path = folder / colour / f"{number:05d}.{suffix}"
        path.write_bytes(cv2.imencode(f".{suffix}", picture(camera, number))[1].tobytes())
        if depth_size:
            (folder / "depth").mkdir(exist_ok=True)
            image = depth_of(camera, number, depth_size)
            cv2.imwrite(str(folder / "depth" / f"{number:05d}.png"), image)


@pytest.fixture
def capture(tmp_path) -> SequenceEntry:
    """Three folders of eight images: own depth lens, aligned depth, no depth."""
    folder = tmp_path / "recordings"
    write_images(folder / "left", 0, range(8), depth_size=DEPTH_SIZE)
    write_images(folder / "right", 1, range(8), depth_size=SIZE, colour="colour")
    write_images(folder / "top", 2, range(8), suffix="png")
    (tmp_path / "calibration.json").write_text(json.dumps(calibrated()))
    return row(folder, tmp_path / "calibration.json", layout="plain")


def remove_images(capture: SequenceEntry, pattern: str) -> None:
    for path in capture.recordings.glob(pattern):
        path.unlink()


def test_images_are_copied_unchanged(capture):
    output = run(capture)
    assert notes_of(output) == {"left": "", "right": "", "top": "has no depth"}
    with Frames.open(output) as frames:
        assert frames.rig.names == ("left", "right", "top") and frames.fps == FPS
        assert frames.num_sets == 8 and frames.colour_available.all()
        assert np.allclose(np.diff(frames.time_s), 1 / FPS, atol=1e-6)
        for t in range(8):
            left = capture.recordings / "left" / f"{t:05d}.jpg"
            assert frames.colour_jpeg(t, 0) == left.read_bytes()
            assert np.array_equal(frames.colour(t, 2), picture(2, t))
            assert np.array_equal(frames.depth(t, 0), depth_of(0, t))
            assert np.array_equal(frames.depth(t, 1), depth_of(1, t, SIZE))
            assert frames.depth(t, 2) is None
        left, right, top = frames.rig
        assert (left.depth.width, left.depth.height) == DEPTH_SIZE
        assert np.array_equal(right.depth.parameters, right.colour.parameters)
        assert np.array_equal(right.colour_from_depth, np.eye(4)) and top.depth is None
        world = np.array([0.3, -0.2, 2.0, 1])
        turn = cv2.Rodrigues(np.array([0, 0.5, 0]))[0]
        assert np.allclose((right.colour_from_master @ world)[:3], turn @ world[:3] + [1, 0, 0.2])
        assert np.allclose(top.colour_from_master @ world, world + np.eye(4)[1])


def test_missing_numbers_are_gaps(capture):
    (capture.recordings / "top" / "00003.png").unlink()
    (capture.recordings / "left" / "depth" / "00002.png").unlink()
    remove_images(capture, "**/00005.*")
    output = run(capture)
    with Frames.open(output) as frames:
        assert frames.num_sets == 7
        assert np.allclose(frames.time_s * FPS, [0, 1, 2, 3, 4, 6, 7], atol=1e-4)
        assert frames.colour_available[:, 2].tolist() == [True] * 3 + [False] + [True] * 3
        assert frames.depth_available[:, 0].tolist() == [True] * 2 + [False] + [True] * 4
    notes = notes_of(output)
    assert "no image in 1 frame sets" in notes["top"]
    assert "no camera has an image for 1 periods in 1 places" in notes["left"]


def test_hidden_files_are_ignored(capture):
    (capture.recordings / "left" / "._00003.jpg").write_bytes(b"\0\5\x16\7")
    (capture.recordings / "left" / "depth" / "._00003.png").write_bytes(b"\0\5\x16\7")
    output = run(capture)
    assert notes_of(output)["left"] == ""
    with Frames.open(output) as frames:
        assert frames.num_sets == 8 and frames.available.all()


def test_timestamps_override_numbers(capture):
    times = 100 + np.arange(8) / 10 + 0.001 * np.arange(8)
    for name, suffix in (("left", "TXT"), ("top", "tsv")):
        text = "\n".join(f"{value:.6f}" for value in times)
        (capture.recordings / name / f"timestamps.{suffix}").write_text(text + "\n")
    named = "name,seconds\n" + "".join(f"{t:05d}.jpg,{times[t] + 0.002}\n" for t in range(8))
    (capture.recordings / "right" / "timestamps.csv").write_text(named)
    content = calibrated(right={"time_offset": 0.001})
    del content["fps"]
    capture.calibration.write_text(json.dumps(content))
    with Frames.open(run(capture)) as frames:
        assert frames.fps == pytest.approx(1 / 0.101)
        assert np.allclose(frames.time_s, times - 100, atol=1e-6)
        assert frames.available.all()
        assert np.allclose(frames.skew_s[:, 1], 0.003, atol=2e-6)


@pytest.mark.parametrize("suffix", ["avi", "mkv", "mp4"])
def test_packets_of_an_mjpeg_video_are_copied(capture, suffix):
    path = capture.recordings / f"top.{suffix}"
    remove_images(capture, "top/*")
    write_video(path, pictures(2), "mjpeg", fps=FPS)
    with av.open(str(path)) as container:
        packets = [bytes(p) for p in container.demux(video=0) if p.size]
    output = run(capture)
    assert notes_of(output)["top"] == "has no depth"
    with Frames.open(output) as frames:
        assert frames.colour_available.all()
        assert [frames.colour_jpeg(t, 2) for t in range(8)] == packets
        assert np.abs(frames.colour(7, 2).astype(int) - picture(2, 7)).mean() < 4


@pytest.mark.parametrize(
    ("suffix", "codec"), [("mp4", "h264"), ("avi", "mpeg4"), ("webm", "libvpx")]
)
def test_other_codecs_are_stored_as_jpeg_with_a_note(capture, suffix, codec):
    remove_images(capture, "top/*")
    path = capture.recordings / f"top.{suffix}"
    options = {"bf": "2"} if codec == "h264" else {}
    try:
        write_video(path, pictures(2), codec, fps=FPS, options=options)
    except av.codec.codec.UnknownCodecError:
        pytest.skip(f"this build of FFmpeg has no {codec} encoder")
    reader, expected = cv2.VideoCapture(str(path)), []
    while (read := reader.read())[0]:
        expected.append(read[1])
    output = run(capture)
    assert f"recorded as {'vp8' if codec == 'libvpx' else codec}, stored" in notes_of(output)["top"]
    with Frames.open(output) as frames:
        assert frames.num_sets == 8 and frames.colour_available.all()
        for t in range(8):
            assert np.abs(frames.colour(t, 2).astype(int) - expected[t]).mean() < 3


def test_a_camera_of_half_the_rate_is_in_every_second_set(capture):
    remove_images(capture, "top/*")
    half = Fraction(FPS, 2)
    write_video(capture.recordings / "top.mp4", pictures(2, 4), "mjpeg", fps=half)
    output = run(capture)
    with Frames.open(output) as frames:
        assert frames.num_sets == 8 and frames.fps == FPS
        assert frames.colour_available[:, 2].tolist() == [True, False] * 4
        assert np.abs(frames.colour(6, 2).astype(int) - picture(2, 3)).mean() < 4
    assert "12.5 images a second beside 25 frame sets: those between" in notes_of(output)["top"]
    with artefacts.read(output, FRAMES) as read:
        assert not read["truncated"].any()  # its last image is a set before the last


def test_a_slow_master_leaves_images_out_with_a_note(capture):
    for number in range(1, 8, 2):
        (capture.recordings / "left" / f"{number:05d}.jpg").unlink()
    with Frames.open(run(capture)) as frames:  # the stated rate: sets of the others between
        assert frames.num_sets == 8 and frames.colour_available[:, 1:].all()
    for number in (2, 4, 6):
        path = capture.recordings / "left" / f"{number:05d}.jpg"
        path.rename(path.with_name(f"{number // 2:05d}.jpg"))
    capture.calibration.write_text(json.dumps(calibrated(left={"fps": FPS / 2})))
    output = run(capture)
    with Frames.open(output) as frames:
        assert frames.num_sets == 4 and frames.colour_available.all()
    note = notes_of(output)["right"]
    assert "25 images a second beside 12.5 frame sets" in note and "4 images are left out" in note
    assert "max_skew_ms" not in note


def test_uneven_image_times_are_kept_and_noted(capture):
    stamps = np.arange(8) / FPS + np.tile([0.0, 0.006], 4)
    times = "".join(f"{number:05d}, {time:.6f}\n" for number, time in enumerate(stamps))
    (capture.recordings / "right" / "timestamps.csv").write_text(times)
    output = run(capture)
    with Frames.open(output) as frames:
        assert frames.colour_available.all()
        np.testing.assert_allclose(frames.skew_s[:, 1], np.tile([0.0, 0.006], 4), atol=1e-6)
    assert "the skew of its images varies by 3.0 ms" in notes_of(output)["right"]
    assert "varies" not in notes_of(output)["left"]


def test_a_video_with_a_folder_of_depth(capture):
    remove_images(capture, "left/*.jpg")
    write_video(capture.recordings / "left.mp4", pictures(0), fps=FPS)
    with Frames.open(run(capture)) as frames:
        assert frames.available.all() and frames.depth_available[:, :2].all()
        assert np.array_equal(frames.depth(6, 0), depth_of(0, 6))


def other_resolution(capture):
    capture.calibration.write_text(json.dumps(calibrated(top=lens((128, 96)))))


def top_video(name: str, change=None):
    """Replace the images of the top camera by a video."""

    def fault(capture):
        remove_images(capture, "top/*")
        path = capture.recordings / name
        write_video(path, pictures(2), "mjpeg", fps=FPS)
        path.write_bytes(change(path.read_bytes()))

    return fault


def timestamps(text: str):
    return lambda capture: (capture.recordings / "top" / "timestamps.txt").write_text(text)


def one_huge_time(capture):
    remove_images(capture, "top/0000[1-7]*")
    timestamps("1700000000000000000\n")(capture)


def times_as_names(capture):
    for path in sorted((capture.recordings / "top").iterdir()):
        path.rename(path.with_name(f"17000000000000{path.name}"))


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (times_as_names, "the numbers in the names are likely times, or time_offset"),
        (other_resolution, "colour images are 64x48, the calibration of camera top is for 128x96"),
        (lambda capture: write_video(capture.recordings / "top.mp4", pictures(2)),
         "camera top is recorded as top.mp4 and top/"),
        (top_video("top.mp4", lambda content: b"no video"),
         "top.mp4: cannot be opened as a video"),
        (top_video("top.avi", lambda content: content.replace(b"MJPG", b"ZZZZ")),
         "top.avi: holds no video that can be decoded"),
        (timestamps("1.0\n2.0\n"), "top: 2 timestamps for 8 colour images"),
        (timestamps("\n".join(str(40 * t) for t in range(8))),
         "timestamps.txt: times are 40 apart, expected seconds"),
        (one_huge_time, "timestamps.txt, line 1: 1.7e+18 are no seconds; write seconds"),
        (timestamps("1.0\nnoon\n"), "timestamps.txt, line 2: found 'noon'"),
        (timestamps("".join(f"{t:05d}.png {t / FPS}\n" for t in range(7))),
         "top: 1 images have no timestamp (first: 00007.png)"),
    ],
)  # fmt: skip
def test_an_unusable_camera_is_excluded_with_a_note(capture, fault, words):
    fault(capture)
    output = run(capture)
    assert words in notes_of(output)["top"]
    assert str(capture.recordings.parent) not in notes_of(output)["top"]
    with Frames.open(output) as frames:
        assert frames.present.tolist() == [True, True, False] and frames.num_sets == 8


def test_images_of_another_size_are_left_out(capture):
    cv2.imwrite(str(capture.recordings / "left" / "00006.jpg"), np.zeros((10, 10, 3), np.uint8))
    assert "1 images of another size left out" in notes_of(run(capture))["left"]


def test_depth_without_a_lens_is_not_read(capture):
    content = calibrated()
    del content["cameras"]["left"]["depth"]
    capture.calibration.write_text(json.dumps(content))
    output = run(capture)
    assert "the calibration has no entry 'depth'" in notes_of(output)["left"]
    with Frames.open(output) as frames:
        assert frames.rig[0].depth is None


def test_a_rig_of_sixteen_cameras_without_a_stated_master(tmp_path):
    cameras = {
        f"c{index:02d}": lens() | {"R": [0, 0, 0], "T": [index, 0, 0]} for index in range(16)
    }
    for index, name in enumerate(cameras):
        write_images(tmp_path / "recordings" / name, index, range(3))
    (tmp_path / "rig.json").write_text(json.dumps({"fps": FPS, "cameras": cameras}))
    entry = row(tmp_path / "recordings", tmp_path / "rig.json", layout="plain")
    with Frames.open(run(entry)) as frames:
        assert frames.rig.names == tuple(cameras) and frames.master == "c00"
        assert frames.colour_available.shape == (3, 16) and frames.available.all()


def test_a_recording_without_times_is_refused(capture):
    content = calibrated()
    del content["fps"]
    capture.calibration.write_text(json.dumps(content))
    with pytest.raises(UserError, match="add fps to the calibration"):
        run(capture)


def states_matrix(path: Path, matrix: tuple[float, float, float, float]) -> None:
    """Write the display matrix [a b; c d] into the header of an MP4 file."""
    content = bytearray(path.read_bytes())
    at = content.index(b"tkhd") + 4 + 40
    one = 1 << 16
    a, b, c, d = (round(one * value) for value in matrix)
    content[at : at + 36] = np.array([a, b, 0, c, d, 0, 0, 0, 1 << 30], ">i4").tobytes()
    path.write_bytes(content)


@pytest.mark.parametrize("codec", ["mpeg4", "mjpeg"])
@pytest.mark.parametrize(
    ("matrix", "orientation"),
    [((-1, 0, 0, 1), 2), ((-1, 0, 0, -1), 3), ((0, 1, -1, 0), 6), ((0, -1, 1, 0), 8)],
)
def test_video_is_stored_as_it_is_shown(capture, codec, matrix, orientation):
    path = capture.recordings / "top.mp4"
    remove_images(capture, "top/*")
    write_video(path, pictures(2), codec, fps=FPS)
    states_matrix(path, matrix)
    if orientation >= 5:
        size = {"image_size": [48, 64], "camera_matrix": [[60, 0, 24], [0, 60, 32], [0, 0, 1]]}
        capture.calibration.write_text(json.dumps(calibrated(top=size)))
    expected = turn(picture(2, 0), orientation)
    assert read_video_size(path) == expected.shape[1::-1]
    with open_layout(capture).open("top") as recording:
        assert recording.preview().size == expected.shape[1::-1]
        (note,) = recording.notes
        assert f"orientation {orientation}" in note and ("mirrored" in note) == (orientation == 2)
        image = next(iter(recording.images()))
    shown = cv2.imdecode(np.frombuffer(image.content, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(shown.astype(int) - expected).mean() < 5


@pytest.mark.parametrize("matrix", [(0.7071, 0.7071, -0.7071, 0.7071), (0, 0, 0, 0)])
def test_a_video_turned_by_other_than_quarter_turns_is_refused(capture, matrix):
    path = capture.recordings / "top.mp4"
    remove_images(capture, "top/*")
    write_video(path, pictures(2, 1), "mpeg4", fps=FPS)
    states_matrix(path, matrix)
    for read in (read_video_size, lambda path: open_layout(capture).open("top")):
        with pytest.raises(UserError, match=r"top\.mp4: states a rotation.*expected quarter turns"):
            read(path)


def test_a_video_turned_by_half_with_depth_is_refused(capture):
    remove_images(capture, "left/*.jpg")
    path = capture.recordings / "left.mp4"
    write_video(path, pictures(0), "mpeg4", fps=FPS)
    states_matrix(path, (-1, 0, 0, -1))
    with pytest.raises(UserError, match="half turn or a mirror"):
        open_layout(capture).open("left")


def test_folders_and_suffixes_in_capitals_are_read(capture):
    (capture.recordings / "left" / "depth").rename(capture.recordings / "left" / "DEPTH")
    (capture.recordings / "right" / "colour").rename(capture.recordings / "right" / "RGB")
    for path in [*capture.recordings.glob("left/*.jpg"), *capture.recordings.glob("*/*/*.png")]:
        path.rename(path.with_suffix(path.suffix.upper()))
    assert list_unread(capture) == []
    with Frames.open(run(capture)) as frames:
        assert frames.colour_available.all() and frames.depth_available[:, :2].all()
        assert np.array_equal(frames.depth(3, 0), depth_of(0, 3))


@pytest.mark.parametrize(
    ("place", "count"),
    [
        ("left/image.webp", 1), ("left/depth/00000.exr", 3), ("left/depth_raw/00000.png", 8),
        ("cam 3.mp4", 1), ("caméra/00000.jpg", 2), ("top.mp4.bak", 1), ("left/video/left.mp4", 1),
        ("top.wmv", 1), ("left/times.csv", 1), ("left/a/b/c.png", 1),
        ("left/times.txt", 1), ("top_timestamps.json", 1),
    ],
)  # fmt: skip
def test_files_that_nothing_reads_are_listed(capture, place, count):
    first = capture.recordings / place
    first.parent.mkdir(exist_ok=True, parents=True)
    for number in range(count):
        first.with_name(first.name.replace("00000", f"{number:05d}")).write_bytes(b"")
    (note,) = list_unread(capture)
    used = f"{place} is not used" if count == 1 else f"{place} and {count - 1} more of "
    assert used in note and "not used; layout plain reads" in note


def test_folders_of_other_columns_are_not_listed(capture):
    masks = capture.recordings / "masks"
    (masks / "left" / "cup").mkdir(parents=True)
    (masks / "left" / "cup" / "0000.png").write_bytes(b"")
    assert "masks/left/cup/0000.png is not used" in list_unread(capture)[0]
    assert list_unread(capture.model_copy(update={"candidates": masks})) == []


def test_images_are_found_without_a_call_for_each(capture, monkeypatch):
    paths, stat = [], Path.stat
    monkeypatch.setattr(Path, "stat", lambda path, **o: paths.append(path) or stat(path, **o))
    assert open_layout(capture).names == ["left", "right", "top"]
    assert not {path.suffix for path in paths} & {".jpg", ".png"}


def test_two_folders_of_colour_are_noted(capture):
    write_images(capture.recordings / "left", 0, range(8), colour="colour")
    with open_layout(capture).open("left") as recording:
        assert "the images in left/ are not read" in recording.notes[0]


def test_depth_that_the_calibration_states_but_no_file_holds_is_noted(capture):
    remove_images(capture, "left/depth/*")
    assert "states its depth, but it has no depth files" in notes_of(run(capture))["left"]


def test_the_unit_of_depth_is_stated_for_all_cameras_or_one(capture):
    capture.calibration.write_text(
        json.dumps(calibrated(right={"depth_unit": 0.0002}) | {"depth_unit": 0.002})
    )
    with Frames.open(run(capture)) as frames:
        assert np.array_equal(frames.depth(2, 0), 2 * depth_of(0, 2))
        assert np.array_equal(frames.depth(2, 1), np.rint(depth_of(1, 2, SIZE) / 5))


@pytest.mark.parametrize("unit", [1000, 1, 0, -0.001, "mm"])
def test_an_impossible_unit_of_depth_is_refused(capture, unit):
    capture.calibration.write_text(json.dumps(calibrated() | {"depth_unit": unit}))
    with pytest.raises(UserError, match="depth_unit is"):
        open_layout(capture)


def test_a_damaged_image_of_a_video_keeps_its_number(capture):
    remove_images(capture, "top/*")
    path = capture.recordings / "top.mkv"
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (*SIZE[::-1], 3)).astype(np.uint8) for _ in range(8)]
    write_video(path, noise, "mjpeg", fps=FPS)
    with av.open(str(path)) as container:
        packet = [bytes(packet) for packet in container.demux(video=0)][3]
    half = packet[: len(packet) // 2] + b"\xff\xd9"
    path.write_bytes(path.read_bytes().replace(packet, half.ljust(len(packet), b"\0")))
    output = run(capture)
    assert "1 damaged images left out" in notes_of(output)["top"]
    with artefacts.read(output, FRAMES) as source:
        images = camera_images(source, capture)[2]
    assert images.number.tolist() == [0, 1, 2, -1, 4, 5, 6, 7] and len(images.recorded) == 8


def test_images_that_lack_most_data_are_left_out(capture):
    noise = np.random.default_rng(0).integers(0, 255, (*SIZE[::-1], 3)).astype(np.uint8)
    content = cv2.imencode(".jpg", noise)[1].tobytes()
    for number in range(8):
        (capture.recordings / "left" / f"{number:05d}.jpg").write_bytes(content)
    cut = capture.recordings / "left" / "00004.jpg"
    cut.write_bytes(content[: len(content) // 2] + b"\xff\xd9")
    output = run(capture)
    assert "1 damaged images left out" in notes_of(output)["left"]
    with Frames.open(output) as frames:
        assert frames.colour_available[:, 0].tolist() == [True] * 4 + [False] + [True] * 3
