"""Kinect recordings with faults: which images remain, and the notes."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.entries import SequenceEntry
from intercap_core.formats.detections.image_numbers import camera_images
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.synchronise import (
    OUTLIER,
    choose_epoch,
    clock_drift_us,
    find_clock_jumps,
    split_into_epochs,
)
from intercap_core.schemas import FRAMES
from tests.helpers.kinect_files import PERIOD_US, depth_at, entry_of, jpeg_at, notes_of, record, run

TICKS = 12


@pytest.fixture
def capture(tmp_path) -> SequenceEntry:
    """Three cameras, twelve ticks each."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    for camera in range(3):
        record(folder, camera, range(TICKS))
    return entry_of(folder, cameras=3)


def with_clock(camera: int, tick_from: int, clock_us: int):
    """The camera's clock says ``clock_us`` at tick ``tick_from`` and runs on from there."""

    def fault(folder: Path) -> None:
        def time(tick: int) -> int:
            if tick < tick_from:
                return 3_000_000 + tick * PERIOD_US
            return clock_us + (tick - tick_from) * PERIOD_US

        record(folder, camera, range(TICKS), clock_us=0, times_us=time)

    return fault


def one_wrong_time(folder: Path) -> None:
    def time(tick: int) -> int:
        return 3_000_000 + tick * PERIOD_US - (900_000 if tick == 5 else 0)

    record(folder, 1, range(TICKS), clock_us=0, times_us=time)


def same_serial(folder: Path) -> None:
    record(folder, 2, range(TICKS), serial="1")


def copied(folder: Path) -> None:
    shutil.copy(folder / "k2.mkv", folder / "k3.mkv")


def zero_depth(folder: Path) -> None:
    record(folder, 1, range(TICKS), image_of=lambda camera, tick: 0 * depth_at(camera, tick))


def stays(missing=(), depth=True, count=TICKS):
    """Which of a camera's ticks the sets hold: all but ``missing``."""
    return {"ticks": [t for t in range(count) if t not in missing], "depth": depth}


@pytest.mark.parametrize(
    ("fault", "camera", "words", "kept"),
    [
        (same_serial, 2, "k2 (k2.mkv) and k3 (k3.mkv) have the same serial number 1", stays()),
        (copied, 2, "k2 (k2.mkv) and k3 (k3.mkv) hold the same", stays(missing=range(TICKS))),
        (zero_depth, 1, "depth is zero in all 12 images", stays(depth=False)),
        (with_clock(1, 4, 500_000), 1, "jump back 1 times: 8 images", stays(range(4, 12))),
        (with_clock(1, 7, 3_150_000), 1, "jump back 1 times: 5 images", stays(range(7, 12))),
        (with_clock(0, 7, 500_000), 0, "jump back 1 times: 5 images", stays(range(7, 12))),
        (with_clock(1, 7, 303_466_662), 1, "ahead by 300.0 s before image 7", stays()),
        (with_clock(0, 7, 303_466_662), 0, "ahead by 300.0 s before image 7", stays()),
        (one_wrong_time, 1, "1 images with device times out of order", stays(missing=[5])),
    ],
)  # fmt: skip
def test_a_faulty_camera_does_not_affect_the_others(capture, fault, camera, words, kept):
    fault(capture.recordings)
    output = run(capture)
    notes = notes_of(output)
    for name in ("k2", "k3") if fault in (same_serial, copied) else (f"k{camera + 1}",):
        assert words in notes[name]
    with Frames.open(output) as frames:
        assert frames.num_sets == TICKS
        assert np.allclose(np.diff(frames.time_s), PERIOD_US * 1e-6, atol=5e-4)
        for c in range(3):
            at_fault = c == camera or fault in (same_serial, copied, zero_depth)
            if not at_fault:
                assert frames.depth_available[:, c].all()
            for t in np.flatnonzero(frames.colour_available[:, c]):
                source = 1 if fault is copied and c == 2 else c
                assert frames.colour_jpeg(t, c) == jpeg_at(source, t)
            for t in np.flatnonzero(frames.depth_available[:, c]):
                assert np.array_equal(frames.depth(t, c), depth_at(c, t))
        assert np.flatnonzero(frames.colour_available[:, camera]).tolist() == kept["ticks"]
        if kept["depth"]:
            expected = frames.colour_available[:, camera]
            assert np.array_equal(frames.depth_available[:, camera], expected)
        else:
            assert frames.rig[camera].depth is None
            assert not frames.depth_available[:, camera].any()


def test_a_pause_of_all_cameras_or_a_jump_of_their_common_clock_is_noted(capture):
    for camera in range(3):
        with_clock(camera, 7, 303_466_662)(capture.recordings)
    output = run(capture)
    words = (
        r"after frame set 6 for 300\.0 s: unless the recording was paused, .*clock was set ahead"
    )
    assert re.search(words, notes_of(output)["k1"])
    with Frames.open(output) as frames:
        assert frames.num_sets == TICKS and frames.available.all()


def test_if_all_clocks_reset_the_longer_epoch_is_kept(capture):
    for camera in range(3):
        with_clock(camera, 4, 1_000_000)(capture.recordings)
    output = run(capture)
    for note in notes_of(output).values():
        assert note.count("4 images outside the stretch of 8") == 1
    with Frames.open(output) as frames:
        assert frames.num_sets == 8 and frames.available.all()
        assert frames.colour_jpeg(0, 1) == jpeg_at(1, 4)


def test_a_damaged_file_gives_its_readable_images(capture):
    path = capture.recordings / "k2.mkv"
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 300_000] = bytes(300_000)
    path.write_bytes(content)
    output = run(capture)
    assert notes_of(output)["k2"] != "" and notes_of(output)["k1"] == ""
    with Frames.open(output) as frames:
        assert frames.num_sets == TICKS
        assert 1 <= frames.colour_available[:, 1].sum() < TICKS
        for t in np.flatnonzero(frames.colour_available[:, 1]):
            assert frames.colour_jpeg(t, 1) == jpeg_at(1, t)


def damaged_images() -> tuple[bytes, ...]:
    """A JPEG that lacks pixels, one that lacks its end too, no image, and one of another size."""
    noise = np.random.default_rng(0).integers(0, 255, (720, 1280, 3)).astype(np.uint8)
    content = cv2.imencode(".jpg", noise)[1].tobytes()
    other = cv2.imencode(".jpg", noise[:360])[1].tobytes()
    return content[:200_000] + b"\xff\xd9", content[:200_000], b"noise", other


def test_damaged_images_keep_their_number(capture):
    faulty = dict(zip((0, 3, 4, 7), damaged_images(), strict=True))
    record(
        capture.recordings, 1, range(TICKS), jpeg_of=lambda c, t: faulty.get(t, jpeg_at(c, t))
    )  # fmt: skip
    output = run(capture)
    note = notes_of(output)["k2"]
    assert "3 damaged images left out; 1 images of another size left out" in note
    with artefacts.read(output, FRAMES) as source:
        images = camera_images(source, capture)[1]
    whole = [tick not in faulty for tick in range(TICKS)]
    assert images.number.tolist() == np.where(whole, np.arange(TICKS), -1).tolist()
    assert images.recorded == set(range(TICKS))
    with Frames.open(output) as frames:
        assert frames.colour_available[:, 1].tolist() == whole
        for tick in np.flatnonzero(whole):
            assert frames.colour_jpeg(tick, 1) == jpeg_at(1, tick)


def test_damaged_images_choose_no_epoch(tmp_path):
    """The longer epoch has no image that can be used."""
    folder, damaged = tmp_path / "recordings", damaged_images()[0]
    folder.mkdir()
    record(
        folder, 0, range(TICKS), clock_us=0,
        times_us=lambda t: (t + 20 * (t < 8)) * PERIOD_US,
        jpeg_of=lambda c, t: damaged if t < 8 else jpeg_at(c, t),
    )  # fmt: skip
    with Frames.open(run(entry_of(folder, cameras=1))) as frames:
        assert frames.num_sets == 4 and frames.colour_jpeg(0, 0) == jpeg_at(0, 8)


def test_a_master_on_another_clock_leaves_the_others(capture):
    record(capture.recordings, 0, range(TICKS), clock_us=90_000_000)
    output = run(capture)
    notes = notes_of(output)
    assert "do not overlap those of k2" in notes["k1"] and "frame sets follow k2" in notes["k1"]
    with Frames.open(output) as frames:
        assert frames.present.tolist() == [False, True, True] and frames.master == "k1"
        assert frames.num_sets == TICKS and frames.available[:, 1:].all()


def test_hidden_files_are_ignored(capture):
    (capture.recordings / "._k2.mkv").write_bytes(b"\0\5\x16\7")
    with Frames.open(run(capture)) as frames:
        assert frames.rig.names == ("k1", "k2", "k3") and frames.available.all()


def test_a_drifting_clock_is_followed_and_noted(capture):
    def time(tick: int) -> int:
        return 3_000_000 + round(tick * PERIOD_US * 1.008)

    record(capture.recordings, 2, range(TICKS), times_us=time)
    output = run(capture)
    assert "its clock runs away from k1's by 5." in notes_of(output)["k3"]
    with Frames.open(output) as frames:
        assert frames.available.all()


def test_a_clock_off_by_more_than_the_window_is_noted(capture):
    record(capture.recordings, 2, range(TICKS), clock_us=3_012_000)
    output = run(capture)
    expected = "12 images fit no frame set: their device times are 12.3 ms from the nearest one"
    assert expected in notes_of(output)["k3"]
    with Frames.open(output) as frames:
        assert frames.num_sets == TICKS and not frames.available[:, 2].any()


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ([1, 2, 3, 4], [0, 0, 0, 0]),
        ([10, 11, 1, 2, 3], [0, 0, 1, 1, 1]),
        ([10, 11, 5, 12, 13], [0, 0, OUTLIER, 0, 0]),
        ([10, 11, 90, 12, 13], [0, 0, OUTLIER, 0, 0]),
        ([10, 10, 11], [0, OUTLIER, 0]),
        ([10, 11, 1, 2, 0, 1], [0, 0, 1, 1, 2, 2]),
        ([5], [0]),
    ],
)
def test_epochs(times, expected):
    assert split_into_epochs(np.array(times)).tolist() == expected


def test_the_epoch_that_overlaps_the_others_is_chosen():
    times = np.array([0, 1, 2, 3, 4, -9, -8, -7])
    stretch = split_into_epochs(times)
    assert choose_epoch(times, stretch, np.arange(-12, -6), 0.5) == 1
    assert choose_epoch(times, stretch, np.array([-50, -8, 70]), 0.5) == 1
    assert choose_epoch(times, stretch, np.array([100, 200]), 0.5) == 0
    assert choose_epoch(times, stretch, np.zeros(0), 0.5) == 0
    times = np.array([5, 6, 7, 8, 5, 6, 7, 8, 9])  # both among the others': the reset is at fault
    assert choose_epoch(times, split_into_epochs(times), np.arange(20), 0.5) == 0
    times = np.array([7, 5, 6, 7, 8, 9])  # an image left from before the common start
    assert choose_epoch(times, split_into_epochs(times), np.arange(20), 0.5) == 1


SECOND = 1_000_000


def seconds(*spans: tuple[float, float]) -> np.ndarray:
    """Times of ten images a second in each of the spans."""
    spans = [np.arange(start * 10, end * 10) / 10 for start, end in spans]
    return np.round(np.concatenate(spans) * SECOND).astype(np.int64)


@pytest.mark.parametrize(
    ("own", "others", "jumps"),
    [
        # one clock is set ahead, before or after the end of the others
        ([(0, 60), (90, 130)], [[(0, 100)]], [(600, 30)]),
        ([(0, 60), (960, 1000)], [[(0, 100)], [(3, 101)]], [(600, 900)]),
        # twice; and once by the clock of several cameras
        ([(0, 60), (260, 280), (400, 420)], [[(0, 100)]], [(800, 120), (600, 200)]),
        ([(0, 60), (90, 130)], [[(0, 100)], [(0, 60.1), (90.1, 131)]], [(600, 30)]),
        # pauses: of one camera, of all, and of one camera that ends later than the others
        ([(0, 60), (90, 100)], [[(0, 100)]], []),
        ([(0, 60), (90, 130)], [[(0, 60), (90, 130)]], []),
        ([(0, 60), (72, 300)], [[(0, 100)]], []),
        ([(0, 60), (72, 100)], [[(0, 30), (230, 300)]], []),
        # a pause and a jump of one camera
        ([(0, 20), (32, 60), (360, 400)], [[(0, 100)]], [(480, 300)]),
        ([(0, 60), (90, 130)], [], []),
    ],
)
def test_a_jump_ahead_is_told_from_a_pause(own, others, jumps):
    times, others = seconds(*own), [seconds(*spans) for spans in others]
    found = find_clock_jumps(times, others, SECOND / 10)
    assert [(jump.image, round(jump.ahead_us / SECOND)) for jump in found] == jumps
    for jump in found:
        times = jump.undo(times)
    if jumps:
        assert abs(times[-1] - max(other[-1] for other in others[:1])) < 3 * SECOND
        assert np.diff(times).max() < 13 * SECOND


def test_drift_ignores_jitter_and_gaps():
    times = np.arange(0, 60_000_000, 33_333)
    rng = np.random.default_rng(0)
    skew = 50e-6 * times + rng.normal(0, 300, len(times)) + 160
    skew[rng.random(len(times)) < 0.3] = np.nan
    assert clock_drift_us(times, skew) == pytest.approx(3000, abs=80)
    assert clock_drift_us(times[:3], skew[:3]) == 0
