"""Recordings that are one video file for each camera.

JPEG packets are copied. Packets of other codecs mostly hold differences to earlier images, so that
their images are decoded and stored as JPEG.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av

from intercap_core.errors import UserError
from intercap_core.formats.calibration.opencv import MAX_SIDE, check_rate
from intercap_core.formats.recordings.containers import (
    LATEST_US,
    REMOVE_ROTATION,
    demux,
    first_image,
    open_container,
    orientation_of,
    preview_video,
    read_sound,
)
from intercap_core.formats.recordings.encodings import (
    JPEG_QUALITY,
    DamagedImage,
    encode_jpeg,
    store_colour,
    turn,
)
from intercap_core.formats.recordings.image_files import (
    DEFAULT,
    Decoding,
    FilesRecording,
    list_remarks,
)
from intercap_core.formats.recordings.source import (
    Image,
    RecordingPreview,
    Sound,
)
from intercap_core.formats.recordings.timestamps import Timestamps, pair_images
from intercap_core.geometry.camera.rig import Camera
from intercap_core.inputs.files import UnreadableFile


def read_video_size(path: Path) -> tuple[int, int] | None:
    """Width and height of a video's images as shown; None if none can be decoded.

    Raises UserError for a rotation by other than quarter turns.
    """
    try:
        first = first_image(path)
        return None if first is None else first.size
    except (UnreadableFile, av.error.FFmpegError, OSError, IndexError):
        return None


class VideoRecording(FilesRecording):
    """One video file, with or without a folder of depth files.

    Raises UserError, naming the file, if it is no video.
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
        decoding: Decoding = DEFAULT,
    ) -> None:
        """Open the file.

        Args:
            path: the video.
            camera: lenses and pose.
            depth: depth files, in order.
            fps: images a second; None = as the file states.
            offset_s: seconds that are added to all times.
            times: times of :func:`.timestamps.read_timestamps`, one for each image in order; None =
                the file's clock from its first image on.
            decoding: unit of the depth files; its orientation is not used.
        """
        try:
            self._container = open_container(path)
        except (av.error.FFmpegError, OSError) as error:
            raise UserError(
                f"{path}: cannot be opened as a video ({error.strerror}); copy the file again, or "
                "convert it"
            ) from error
        try:
            self._stream, rate = self._choose_stream(path, fps)
            first = first_image(path, self._stream.index)
            orientation = 1 if first is None else first.orientation
            if depth and orientation in (2, 3, 4):
                raise UserError(
                    f"{path}: states a half turn or a mirror (orientation {orientation}), which "
                    "its depth files would not follow; turn the video itself, or "
                    f"{REMOVE_ROTATION}"
                )
        except UserError:
            self._container.close()
            raise
        shots, _, notes = pair_images(
            [],
            depth,
            fps=rate,
            offset_s=offset_s,
            times=times,
            source=path.with_suffix(""),
            images=int(self._stream.frames),
        )
        super().__init__(path, camera, shots, rate, decoding)
        self.notes += notes
        self._copied = first is not None and first.copied
        self._remarks: Counter[str] = Counter()
        self._offset_s = offset_s
        self._times = None if times is None else list(times.values())
        self.timing = "" if times is None else "by timestamps"
        if orientation != 1:
            mirrored = ", and mirrored, which OpenCV does not do" * (orientation in (2, 4, 5, 7))
            self.notes.append(
                f"the video states orientation {orientation}: its images are stored turned by it"
                f"{mirrored}; calibrate and detect on such images"
            )
        self._damaged = 0
        self._first_s: float | None = None  # time of the first image on the file's clock

    def _choose_stream(self, path: Path, fps: float | None) -> tuple[Any, float]:
        """The video stream and its frame rate; raises UserError if it cannot be decoded."""
        streams = self._container.streams.video
        if not streams or streams[0].codec_context is None:
            raise UserError(
                f"{path}: holds no video that can be decoded; convert it to a common codec"
            )
        stream: Any = streams[0]
        stream.thread_type = "AUTO"
        rate = fps or float(stream.average_rate or stream.guessed_rate or 30)
        check_rate(rate, str(path))
        width, height = stream.codec_context.width, stream.codec_context.height
        if max(width, height) > MAX_SIDE:
            raise UserError(
                f"{path}: states images of {width}x{height} pixels, expected at most "
                f"{MAX_SIDE} a side; copy or convert it again"
            )
        return stream, rate

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def preview(self) -> RecordingPreview:
        """Inspect the head, the first image, the length as :func:`preview_video`, depth files."""
        seen = preview_video(self.source, self._stream.index, self.fps)
        faults, _ = self._inspect_files()
        if self._times is not None and seen.images is not None:
            stated = len(self._times)
            if abs(stated - seen.images) > max(1, 0.02 * stated):  # images may be estimated
                faults.append(f"has {stated} timestamps for about {seen.images} images")
        return seen._replace(faults=tuple(faults))

    def images(self) -> Iterator[Image]:
        """Yield images in the order in which they are shown, then depth.

        Times are the stated timestamps, or else count from the first image.
        """
        count = 0
        first: float | None = None
        for stamp, content in self._packet_files() if self._copied else self._decoded():
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
        if not self._copied:
            codec = self._stream.codec_context.name
            self.notes.append(f"colour was recorded as {codec}, stored as JPEG of quality "
                              f"{JPEG_QUALITY}")  # fmt: skip
        self.notes += list_remarks(self._remarks)
        if self._damaged:
            self.notes.append(f"{self._damaged} damaged packets left out")
        if self.truncated:
            self.notes.append(f"the file is cut off: {count} images could be read")
        yield from super().images()

    def sound(self) -> Sound | None:
        """The file's first sound track."""
        return None if self._first_s is None else read_sound(self.source, self._first_s)

    def _packets(self) -> Iterator[Any]:
        def cut_off() -> None:
            self.truncated = True

        return demux(self._container, self._stream, cut_off)

    def _packet_files(self) -> Iterator[tuple[float | None, bytes]]:
        """Yield time on the file's clock, seconds, None = not stated, and JPEG of each packet.

        A damaged packet is yielded as it is: it keeps its place among images without times.
        """
        for packet in self._packets():
            if packet.size:
                stamp = None if packet.pts is None else float(packet.pts * packet.time_base)
                content = bytes(packet)
                with contextlib.suppress(DamagedImage):
                    content, remark = store_colour(content)
                    self._remarks[remark] += 1
                yield stamp, content

    def _decoded(self) -> Iterator[tuple[float | None, bytes]]:
        """The same of each decoded image, encoded as JPEG."""
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
                try:  # an upright phone records rotated images and states the rotation
                    image = turn(frame.to_ndarray(format="bgr24"), orientation_of(frame))
                except DamagedImage:
                    self._damaged += 1
                    continue
                yield frame.time, encode_jpeg(image)
