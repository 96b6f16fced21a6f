"""`intercap check` of recordings that are cut, short, of another size or sparse."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from intercap_core.commands.check_recordings import RecordingCheck
from intercap_core.config import DetectionsSettings
from intercap_core.entries import SequenceEntry
from intercap_core.formats.recordings.layouts import open_layout
from tests.helpers.kinect_files import entry_of, record
from tests.helpers.plain_capture import CAMERAS, plain_entry, write_rig

SIZE, COUNT, FPS = (96, 64), 40, 10


def picture(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    noise = np.random.default_rng(number).integers(0, 255, (size[1], size[0], 3))
    return noise.astype(np.uint8)


def write_video(path: Path, count: int = COUNT, size: tuple[int, int] = SIZE) -> None:
    """A video of noise, so that each image takes as many bytes; the index of an mp4 comes first."""
    codec, options = "mpeg4", {"movflags": "faststart"} if path.suffix == ".mp4" else {}
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream(codec, rate=FPS)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        for number in range(count):
            frame = av.VideoFrame.from_ndarray(picture(number, size), format="bgr24")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def look(row: SequenceEntry) -> RecordingCheck:
    layout = open_layout(row)
    check = RecordingCheck(row, DetectionsSettings())
    check.check_recordings(layout, layout.names)
    return check


def cut(path: Path, share: float = 0.1) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: round(share * len(content))])


@pytest.fixture
def images(tmp_path: Path) -> SequenceEntry:
    """Two folders of images, with keypoints and candidates of all of them."""
    for folder in write_rig(tmp_path, SIZE, 60.0).values():
        (tmp_path / "keypoints" / folder.name).mkdir(parents=True)
        (tmp_path / "candidates").mkdir(exist_ok=True)
        for number in range(COUNT):
            cv2.imwrite(str(folder / f"{number:05d}.jpg"), picture(number))
            file = tmp_path / "keypoints" / folder.name / f"{number:05d}_keypoints.json"
            file.write_text('{"people": []}')
        results = [{"image_id": n, "category_id": 1} for n in range(COUNT)]
        (tmp_path / "candidates" / f"{folder.name}.json").write_text(json.dumps(results))
    return plain_entry(
        tmp_path, keypoints=tmp_path / "keypoints", candidates=tmp_path / "candidates"
    )


def videos(folder: Path, suffix: str) -> SequenceEntry:
    for images in write_rig(folder, SIZE, 60.0).values():
        images.rmdir()
        write_video(images.with_suffix(suffix))
    return plain_entry(folder)


def of_another_size(folder: Path) -> None:
    for path in (folder / "recordings" / "left").iterdir():
        cv2.imwrite(str(path), picture(0, (SIZE[0] * 2, SIZE[1] * 2)))


def without(share: float, *, tail: bool) -> Callable[[Path], None]:
    def fault(folder: Path) -> None:
        paths = sorted((folder / "recordings" / "left").iterdir())
        left = round(share * len(paths))
        kept = paths[:left] if tail else [*paths[: left // 2], *paths[-(left - left // 2) :]]
        for path in set(paths) - set(kept):
            path.unlink()

    return fault


def emptied(folder: Path) -> None:
    (folder / "recordings" / "left" / "00003.jpg").write_bytes(b"")


def all_cut(folder: Path) -> None:
    for path in (folder / "recordings" / "left").iterdir():
        cut(path, 0.5)


def few_keypoints(folder: Path) -> None:
    for path in sorted((folder / "keypoints" / "left").iterdir())[4:]:
        path.unlink()


def few_candidates(folder: Path) -> None:
    (folder / "candidates" / "left.json").write_text('[{"image_id": 0}, {"image_id": 1}]')


@pytest.mark.parametrize(
    ("spoil", "fault", "note"),
    [
        (lambda folder: None, "", ""),
        (of_another_size, "left's images are 192x128, ", ""),
        (without(0.1, tail=True), "left lasts 0.3 s (4 images), the other cameras 3.9 s",
         "cover 40 images, it has 4"),
        (without(0.8, tail=True), "", "left lasts 3.1 s (32 images), the other cameras 3.9 s"),
        (without(0.5, tail=False), "", "left has 20 images in 3.9 s, expected about 40 at 10 a"),
        (emptied, "", "left 1 of 40 colour files are empty (first: 00003.jpg)"),
        (all_cut, "left has no image that can be read, expected 96x64", "files are damaged"),
        (few_keypoints, "", "keypoints of camera left cover 4 of its 40 images; run the"),
        (few_candidates, "", "masks (candidates) of camera left cover 2 of its 40 images; run the"),
    ],
)  # fmt: skip
def test_a_faulty_folder_of_images_is_reported(
    images: SequenceEntry, spoil: Callable[[Path], None], fault: str, note: str
) -> None:
    spoil(images.recordings.parent)
    found = look(images)
    assert bool(found.faults) == bool(fault), found.faults
    assert bool(found.notes) == bool(note), found.notes
    assert fault in "".join(found.faults)
    assert note in "".join(found.notes)
    assert not [text for text in (*found.faults, *found.notes) if "right" in text]


def test_summary_of_a_good_sequence(images: SequenceEntry) -> None:
    assert look(images).summary == (
        "2 cameras; 96x64; 40 images; 3.9 s; no depth; keypoints of 2; "
        "segmentation masks (candidates) of 2; images: by number"
    )


def test_ids_do_not_count_if_images_are_matched_by_name(images: SequenceEntry) -> None:
    results = [{"image_id": n + 1, "file_name": f"{n:05d}.jpg"} for n in range(COUNT)]
    for name in CAMERAS:
        (images.candidates / f"{name}.json").write_text(json.dumps(results))
    assert not look(images).recognised.get("candidates")
    for entry in results:
        del entry["file_name"]
    (images.candidates / f"{CAMERAS[0]}.json").write_text(json.dumps(results))
    assert look(images).recognised["candidates"] == {"images numbered from 1"}


@pytest.mark.parametrize("suffix", [".mp4", ".avi", ".mkv", ".ts"])
def test_a_video_cut_to_a_tenth_is_a_problem(tmp_path: Path, suffix: str) -> None:
    row = videos(tmp_path, suffix)
    for _ in range(2):  # reading must not change the files
        good = look(row)
        assert not good.faults and not good.notes
        count = re.search(r"; (\d+)(?: to \d+)? images; ", good.summary)
        assert count and abs(int(count.group(1)) - COUNT) <= 1
    cut(row.recordings / f"{CAMERAS[0]}{suffix}", 0.12)
    found = look(row)
    (fault,) = found.faults
    # a transport stream states no length: its duration beside the other's tells
    assert ("lasts" if suffix == ".ts" else "is cut off: it has about ") in fault
    assert str(row.recordings / f"left{suffix}") in fault


def test_a_video_of_another_size(tmp_path: Path) -> None:
    row = videos(tmp_path, ".mp4")
    write_video(row.recordings / "right.mp4", size=(64, 96))
    (fault,) = look(row).faults
    assert "right's images are 64x96" in fault and "rig.json is for 96x64" in fault


@pytest.mark.parametrize(("share", "is_fault"), [(0.3, True), (0.8, False), (1.0, None)])
def test_a_kinect_recording_that_is_cut(
    tmp_path: Path, share: float, is_fault: bool | None
) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    for camera in range(2):
        record(folder, camera, range(20))
    cut(folder / "k1.mkv", share)
    row = entry_of(folder, cameras=2)
    found = look(row)
    assert look(row) == found  # reading must not change the files
    images = re.search(r"(\d+) images; ", found.summary)
    assert images and abs(int(images.group(1)) - 20) <= 1  # of the whole one
    assert bool(found.faults) == (is_fault is True)
    assert bool(found.notes) == (is_fault is False)
    if is_fault is not None:
        (text,) = found.faults or found.notes
        assert f"k1's recording is cut off: it has about {share:.0%}" in text


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_a_real_kinect_recording(tmp_path: Path, real_recording: Path, share: float) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    for name in ("k1.mkv", "k2.mkv"):
        shutil.copyfile(real_recording, folder / name)
    cut(folder / "k2.mkv", share)
    found = look(entry_of(folder, cameras=2))
    texts = [*found.faults, *found.notes]
    assert bool(texts) == (share < 1.0) and bool(found.faults) == (share < 0.5)
    assert all("k2" in text for text in texts)
