"""Video files: packets are copied where each is a JPEG, else images are decoded and stored as such.

The packets of other codecs are no images by themselves: most hold only what changed, so that one
image cannot be read without those before it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.plausible import check_rate
from intercap_core.formats.recordings.containers import (
    LATEST_US,
    MAX_SIDE,
    RecordingPreview,
    open_container,
    preview_video,
)
from intercap_core.formats.recordings.encoded import JPEG_QUALITY, encode_jpeg
from intercap_core.formats.recordings.image_files import faults_of_files, read_pairs
from intercap_core.formats.recordings.sound import Sound, read_sound
from intercap_core.formats.recordings.source import CameraRecording, Image
from intercap_core.formats.recordings.timestamps import Timestamps, pair_images
from intercap_core.geometry.camera.rig import Camera
from intercap_core.inputs.files import Unreadable

FEW_IMAGES = 0.02  # by which a count from duration and rate may be wrong


def video_size(path: Path) -> tuple[int, int] | None:
    """Width and height of a video's images; None where it cannot be opened."""
    try:
        with open_container(path) as container:
            context = container.streams.video[0].codec_context
            return (context.width, context.height) if context and context.width else None
    except (Unreadable, av.error.FFmpegError, OSError, IndexError):
        return None


class VideoRecording(CameraRecording):
    """One video file, and perhaps a folder of depth files.

    The file's own clock, from its first image on, gives the times; ``times`` as
    :func:`.timestamps.read_timestamps` reads them override it, one for each image in order.
    ``offset_s`` is added. Raises UserError, naming the file, where it is no video.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        depth: list[Path],
        *,
        fps: float | None,
        offset_s: float,
        times: Timestamps | None,
    ) -> None:
        try:
            self._container = open_container(path)
        except Unreadable as error:
            raise UserError(f"{path}: cannot be opened as a video ({error.reason})") from error
        except (av.error.FFmpegError, OSError) as error:
            raise UserError(
                f"{path}: cannot be opened as a video ({error.strerror}); copy the file again, or "
                "convert it"
            ) from error
        streams = self._container.streams.video
        if not streams or streams[0].codec_context is None:
            self._container.close()
            raise UserError(
                f"{path}: holds no video that can be decoded; convert it to a common codec"
            )
        self._stream: Any = streams[0]
        self._stream.thread_type = "AUTO"
        rate = fps or float(self._stream.average_rate or self._stream.guessed_rate or 30)
        width, height = self._stream.codec_context.width, self._stream.codec_context.height
        try:
            check_rate(rate, str(path))
            if max(width, height) > MAX_SIDE:
                raise UserError(
                    f"{path}: states images of {width}x{height} pixels, expected at most "
                    f"{MAX_SIDE} a side; copy or convert it again"
                )
        except UserError:
            self._container.close()
            raise
        super().__init__(path, camera, fps=rate)
        self._offset_s = offset_s
        self._times = None if times is None else list(times.values())
        self._shots = pair_images(
            [], depth, fps=rate, offset_s=offset_s, times=times, source=path.with_suffix("")
        )
        self._damaged = 0
        self._first_s: float | None = None  # of the first image, on the file's clock

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def preview(self) -> RecordingPreview:
        """The head, the first image, the index or the last image; beside it the depth files."""
        seen = preview_video(self.source, self._stream.index, self.fps)
        faults = faults_of_files(self._shots, self.camera.depth)
        if self._times is not None and seen.images is not None:
            stated = len(self._times)
            if abs(stated - seen.images) > max(1, FEW_IMAGES * stated):
                faults.append(f"has {stated} timestamps for about {seen.images} images")
        return seen._replace(faults=tuple(faults))

    def images(self) -> Iterator[Image]:
        """Images in the order in which they are shown, then depth."""
        copied = self._stream.codec_context.name == "mjpeg"
        count = 0
        first: float | None = None
        for stamp, content in self._copied() if copied else self._decoded():
            seconds = count / self.fps if stamp is None else stamp
            self._first_s = seconds if self._first_s is None else self._first_s
            first = seconds if first is None else first
            if self._times is not None:
                if count >= len(self._times):
                    self.notes.append(f"only {count} timestamps: the images after them left out")
                    break
                seconds, first = self._times[count], 0.0
            count += 1
            time_us = round((seconds - first + self._offset_s) * 1e6)
            if abs(time_us) > LATEST_US and self._times is None:
                self._damaged += 1
                continue
            yield Image("colour", time_us, content)
        if self._times is not None and count < len(self._times):
            self.notes.append(f"{len(self._times)} timestamps, but {count} images")
        if not copied:
            codec = self._stream.codec_context.name
            self.notes.append(f"colour was recorded as {codec}, stored as JPEG of quality "
                              f"{JPEG_QUALITY}")  # fmt: skip
        if self._damaged:
            self.notes.append(f"{self._damaged} damaged packets left out")
        if self.truncated:
            self.notes.append(f"the file is cut off: {count} images could be read")
        yield from read_pairs(self, self._shots)

    def sound(self) -> Sound | None:
        """The file's first sound track."""
        return None if self._first_s is None else read_sound(self.source, self._first_s)

    def _packets(self) -> Iterator[Any]:
        demuxed = self._container.demux(self._stream)
        while True:
            try:
                yield next(demuxed)
            except (StopIteration, av.error.EOFError):
                return
            except (av.error.FFmpegError, OSError):
                self.truncated = True
                return

    def _copied(self) -> Iterator[tuple[float | None, bytes]]:
        for packet in self._packets():
            if packet.size:
                stamp = None if packet.pts is None else float(packet.pts * packet.time_base)
                yield stamp, bytes(packet)

    def _decoded(self) -> Iterator[tuple[float | None, bytes]]:
        for packet in self._packets():
            try:
                frames = packet.decode()
            except (av.error.FFmpegError, OSError):
                self._damaged += 1
                continue
            for frame in frames:
                if max(frame.width, frame.height) > MAX_SIDE:
                    self._damaged += 1
                    continue
                image = frame.to_ndarray(format="bgr24")
                # A phone held upright records lying images and says so; viewers turn them.
                image = np.rot90(image, round((getattr(frame, "rotation", 0) or 0) / 90))
                yield frame.time, encode_jpeg(np.ascontiguousarray(image))
