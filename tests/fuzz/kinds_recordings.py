"""Recordings: Azure Kinect files, videos and their sound, images, times of images."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

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
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from tests.fuzz.kind import ImplausibleError, Kind, finite, within
from tests.fuzz.kinds_cameras import check_lens, check_pose
from tests.helpers.kinect_files import pose_of, record

SIZE = (64, 48)
LENS = Intrinsics(*SIZE, 50.0, 50.0, 32.0, 24.0)


def _check(recording: CameraRecording) -> list[str]:
    """Walk through a recording as the frames stage does."""
    check_lens(recording.camera.colour)
    if recording.camera.colour_from_depth is not None:
        check_pose(recording.camera.colour_from_depth)
    within(0.01, 1e5, fps=recording.fps)
    within(-2e6, 2e6, delay=recording.depth_delay_us)
    recording.serial.encode("utf-8")
    seen = recording.preview()
    within(0, 1, share=seen.share)
    finite(seconds=seen.seconds or 0)
    colour = depth = damaged = 0
    for image in recording.images():
        within(-(2**62), 2**62, time=image.time_us)
        if image.kind == "colour":
            colour += 1
            assert isinstance(image.content, bytes)
            damaged += encoded_size(image.content) is None  # the frames stage leaves it out
        else:
            depth += 1
    sound = recording.sound()
    if sound is not None:
        within(-1e10, 1e10, first=sound.first_s)
        within(0, 8000 * 700, samples=len(sound.samples))
    if damaged:
        return [f"{recording.source.name}: {damaged} damaged images left out"]
    if not colour + depth:
        return [f"{recording.source.name} holds no image"]
    return [f"{recording.source.name}: {note}" for note in recording.notes]


def _make_kinect(folder: Path) -> None:
    record(folder, 0, range(2))


def _read_kinect(folder: Path) -> list[str]:
    with KinectRecording(folder / "k1.mkv", "k1", pose_of(0)) as recording:
        return _check(recording)


def _make_video(name: str, codec: str, sound: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=10)
            stream.width, stream.height = SIZE
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            audio = container.add_stream(sound, rate=16_000, layout="stereo")
            for number in range(6):
                image = np.full((SIZE[1], SIZE[0], 3), 20 * number, np.uint8)
                frame = av.VideoFrame.from_ndarray(image, format="bgr24")
                frame.pts = number
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
            noise = np.random.default_rng(0).normal(0, 0.1, (2, 9_600)).astype(np.float32)
            heard = av.AudioFrame.from_ndarray(noise, format="fltp", layout="stereo")
            heard.sample_rate, heard.time_base, heard.pts = 16_000, Fraction(1, 16_000), 0
            resampler = av.AudioResampler(format=audio.codec_context.format)
            for part in [*resampler.resample(heard), None]:
                container.mux(audio.encode(part))

    return make


def _read_video(name: str) -> Callable[[Path], list[str]]:
    def read(folder: Path) -> list[str]:
        camera = Camera("left", LENS, None, None, np.eye(4))
        path = folder / name
        with VideoRecording(path, camera, [], fps=None, offset_s=0.0, times=None) as recording:
            notes = _check(recording)
        return [note for note in notes if "stored as JPEG" not in note]

    return read


def _make_images(folder: Path) -> None:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 255, (48, 64, 3), np.uint8), (9, 9), 3)
    cv2.imwrite(str(folder / "a.jpg"), image)
    cv2.imwrite(str(folder / "a.png"), image)
    cv2.imwrite(str(folder / "depth.png"), rng.integers(500, 4000, (48, 64), np.uint16))


def _read_images(folder: Path) -> list[str]:
    notes = []
    for name in ("a.jpg", "a.png", "depth.png"):
        try:
            if name == "depth.png":
                depth = read_depth(folder / name, SIZE)
                if depth.shape != SIZE[::-1] or depth.dtype != np.uint16:
                    raise ImplausibleError(f"depth is {depth.shape} {depth.dtype}")
            else:
                size = encoded_size(read_colour(folder / name))
                within(0, 70_000 if name == "a.jpg" else 2**32, size=size)
        except DamagedImage as error:
            notes.append(f"{name} {error}")
    return notes


def _make_times(folder: Path) -> None:
    lines = [f"frame_{n:04d}.jpg,{3.5 + n / 30:.6f}" for n in range(20)]
    (folder / "timestamps.csv").write_text("name,seconds\n" + "\n".join(lines) + "\n")


def _read_times(folder: Path) -> None:
    times = read_timestamps(folder / "timestamps.csv")
    within(-1e11, 1e11, times=list(times.values()))
    colour = [Path(f"frame_{n:04d}.jpg") for n in range(20)]
    source = folder / "timestamps.csv"
    for shot in pair_images(colour, [], fps=30, offset_s=0, times=times, source=source):
        within(-(2**62), 2**62, time=shot.time_us)


KINDS = (
    Kind("kinect-recording", "bytes", _make_kinect, ["k1.mkv"], _read_kinect),
    Kind("video-mp4", "bytes", _make_video("a.mp4", "mpeg4", "aac"), ["a.mp4"],
         _read_video("a.mp4")),
    Kind("video-mkv", "bytes", _make_video("a.mkv", "mjpeg", "flac"), ["a.mkv"],
         _read_video("a.mkv")),
    Kind("video-mov", "bytes", _make_video("a.mov", "mjpeg", "pcm_s16le"), ["a.mov"],
         _read_video("a.mov")),
    Kind("images", "bytes", _make_images, ["a.jpg", "a.png", "depth.png"], _read_images),
    Kind("timestamps", "table", _make_times, ["timestamps.csv"], _read_times),
)  # fmt: skip
