"""Video files: their preview, sound track and images.

JPEG packets are copied. Packets of other codecs mostly hold differences to earlier images, so that
their images are decoded and stored as JPEG.
"""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.calibration.opencv import MAX_SIDE, check_rate
from intercap_core.formats.recordings.encodings import (
    JPEG_QUALITY,
    DamagedImage,
    encode_jpeg,
    encoded_size,
    store_colour,
    turn,
)
from intercap_core.formats.recordings.image_files import (
    DEFAULT,
    Decoding,
    inspect_files,
    list_remarks,
    read_pairs,
)
from intercap_core.formats.recordings.source import (
    SOUND_RATE,
    CameraRecording,
    Image,
    RecordingPreview,
    Sound,
)
from intercap_core.formats.recordings.timestamps import Timestamps, pair_images
from intercap_core.geometry.camera.rig import Camera
from intercap_core.inputs.files import UnreadableFile, check_file

# FFmpeg would also follow lists of other files or addresses.
FORMATS = "matroska,webm,mov,mp4,m4a,3gp,3g2,mj2,avi,mpeg,mpegts,mpegvideo"
LATEST_US = 10**16  # of a device's clock, which may count from 1970; later times are damage
_REMOVE_ROTATION = "remove the rotation (ffmpeg -display_rotation 0 -i FILE -c copy NEW)"
# Exif orientation by the matrix [a b; c d] of a track, with x' = a x + c y and y' = b x + d y.
# Source: ISO/IEC 14496-12, 8.3.2.
_ORIENTATIONS = {
    (1, 0, 0, 1): 1, (-1, 0, 0, 1): 2, (-1, 0, 0, -1): 3, (1, 0, 0, -1): 4,
    (0, 1, 1, 0): 5, (0, 1, -1, 0): 6, (0, -1, -1, 0): 7, (0, -1, 1, 0): 8,
}  # fmt: skip


def open_container(path: Path, **options: str) -> Any:
    """Open a regular file with PyAV.

    Raises UnreadableFile if it is no regular file, and PyAV's errors if it is no container of
    :data:`FORMATS`.
    """
    check_file(path, None)
    return av.open(
        f"file:{path}",
        options={"format_whitelist": FORMATS, "protocol_whitelist": "file", **options},
        metadata_errors="replace",
    )


def demux(container: Any, streams: Any, on_error: Callable[[], None]) -> Iterator[Any]:
    """Yield packets up to the file's end or its first error, at which ``on_error`` is called."""
    packets = container.demux(streams)
    while True:
        try:
            yield next(packets)
        except (StopIteration, av.error.EOFError):
            return
        except (av.error.FFmpegError, OSError):
            on_error()
            return


def preview_video(path: Path, stream_index: int, fps: float) -> RecordingPreview:
    """Inspect one track of a video file that opens.

    This takes milliseconds for files with an index (mp4, mov, avi) and for Matroska, which states
    its length. Other files are read from the last image to which FFmpeg can seek. A file that was
    cut off holds only a share of what it states.
    """
    with open_container(path) as container:
        stream: Any = container.streams[stream_index]
        # read here: after its container is closed, the stream is freed memory
        stated, frames = float(container.duration or 0) / av.time_base, int(stream.frames)
        length = os.path.getsize(path)
        entries = getattr(stream, "index_entries", None) or ()
        if "matroska" in container.format.name:
            share = _share_of_segment(path, length)
            seconds = stated * share if stated else None
        elif frames and len(entries) == frames:
            share = sum(entry.pos + entry.size <= length for entry in entries) / frames
            seconds = float(stream.duration * stream.time_base) * share if stream.duration else None
        else:
            seconds = _last_time(container, stream)
            share = 1.0
            if frames and seconds is not None:
                share = min(1.0, (round(seconds * fps) + 1) / frames)
    with open_container(path) as container:
        first = _first_image(container, container.streams[stream_index])
    size = None if first is None else first.size
    if seconds is None:
        return RecordingPreview(size, None, None, share, counted=False)
    counted = frames > 0
    images = round(frames * share) if counted else max(1, round(seconds * fps))
    return RecordingPreview(size, images, seconds, share, counted=counted)


def _orientation(frame: Any) -> int:
    """Exif orientation of a decoded image, from the matrix of its track or its own Exif.

    Raises :class:`DamagedImage` for a rotation by other than quarter turns.
    """
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return 1
    a, b, _, c, d, *_ = (np.frombuffer(bytes(matrix), np.int32)[:9] / (1 << 16)).tolist()
    orientation = _ORIENTATIONS.get((round(a), round(b), round(c), round(d)))
    if orientation is None or abs(abs(a * d - b * c) - 1) > 1e-3 or max(abs(a), abs(b)) < 0.999:
        raise DamagedImage(f"states a rotation by {frame.rotation} degrees, expected quarter turns")
    return orientation


class _FirstImage(NamedTuple):
    """Properties of the first image of a video that decodes."""

    size: tuple[int, int]
    """Width and height as shown, after the rotation that the file states."""
    orientation: int
    """Exif orientation of the rotation."""
    copied: bool
    """Whether the packet is a JPEG file of the image as shown."""


def _first_image(container: Any, stream: Any) -> _FirstImage | None:
    """Properties of the first image that decodes; None if no image does.

    Raises :class:`DamagedImage` as :func:`_orientation` does.
    """
    for number, packet in enumerate(demux(container, stream, lambda: None)):
        if number > 60:  # two seconds, within which an image must decode
            break
        with contextlib.suppress(av.error.FFmpegError, OSError):
            for frame in packet.decode():
                orientation, size = _orientation(frame), (frame.width, frame.height)
                # Packets of interlaced videos hold two JPEG files, each with half of the rows.
                copied = orientation == 1 and encoded_size(bytes(packet)) == size
                copied = copied and stream.codec_context.name == "mjpeg"
                return _FirstImage(size[::-1] if orientation >= 5 else size, orientation, copied)
    return None


def _last_time(container: Any, stream: Any) -> float | None:
    """Seconds from the first to the last readable image; None without images."""
    times: list[float] = []
    try:
        if container.duration:
            container.seek((container.start_time or 0) + container.duration, backward=True)
        for packet in container.demux(stream):
            if packet.size and packet.pts is not None:
                times.append(float(packet.pts * packet.time_base))
    except (av.error.FFmpegError, OSError):
        pass
    start = float(stream.start_time * stream.time_base) if stream.start_time else 0.0
    return float(np.max(times)) - start if times else None


def _share_of_segment(path: Path, length: int) -> float:
    """Share of the bytes of a Matroska file's Segment that the file holds; 1 = not stated."""
    with open(path, "rb") as file:
        end = segment_end(file.read(4096))
    return 1.0 if end is None else min(1.0, length / end)


def segment_end(head: bytes) -> int | None:
    """Offset of the end of a Matroska file's Segment, bytes; None if it was never finished.

    ``head`` is the file's beginning. Source: RFC 8794, section 6; RFC 9559, section 5.1.
    """
    at = head.find(b"\x18\x53\x80\x67")  # the id of a Segment
    if at < 0 or at + 5 > len(head):
        return None
    # EBML: the number of leading zero bits states how many bytes follow; all ones = unknown length.
    width = 9 - head[at + 4].bit_length()  # bytes of the length that follows the id
    field = head[at + 4 : at + 4 + width]
    stated = int.from_bytes(field, "big") & ((1 << 7 * width) - 1)
    return None if stated == (1 << 7 * width) - 1 else at + 4 + width + stated


def read_sound(path: Path, first_image_s: float) -> Sound | None:
    """Read a video's first sound track; None if there is none that can be decoded.

    ``first_image_s`` is the time of the first image on the file's clock, seconds. Damaged packets
    become gaps.
    """
    parts: list[np.ndarray] = []
    start: float | None = None
    count = 0
    longest = 600.0 * SOUND_RATE  # ten minutes are read: 19 MB
    for time_s, samples in _pieces(path):
        if start is None:
            start = time_s
        gap = round((time_s - start) * SOUND_RATE) - count
        if gap > 0.05 * SOUND_RATE:  # a shorter one is jitter of the packets' times
            if count + gap > longest:
                break
            parts.append(np.zeros(gap, np.float32))
            count += gap
        parts.append(samples)
        count += len(samples)
        if count >= longest:
            break
    if start is None or not count:
        return None
    return Sound(np.concatenate(parts), start - first_image_s)


def _pieces(path: Path) -> Iterator[tuple[float, np.ndarray]]:
    """Yield times on the file's clock, seconds, and decoded samples (n,)."""
    try:
        container = open_container(path)
    except (UnreadableFile, av.error.FFmpegError, OSError):
        return
    with container:
        streams: Any = container.streams.audio
        if not streams or streams[0].codec_context is None:
            return
        resampler = av.AudioResampler(format="flt", layout="mono", rate=SOUND_RATE)
        after = 0.0
        for frame in _decode_frames(container, streams[0]):
            after = frame.time if frame.time is not None else after
            if not frame.sample_rate or not abs(after) < LATEST_US * 1e-6:
                continue
            time_s, after = after, after + frame.samples / frame.sample_rate
            try:
                for made in resampler.resample(frame):
                    yield time_s, made.to_ndarray().ravel().astype(np.float32)
            except (av.error.FFmpegError, ValueError):
                continue


def _decode_frames(container: Any, stream: Any) -> Iterator[Any]:
    for packet in demux(container, stream, lambda: None):
        with contextlib.suppress(av.error.FFmpegError, OSError):
            yield from packet.decode()


def read_video_size(path: Path) -> tuple[int, int] | None:
    """Width and height of a video's images as shown; None if none can be decoded.

    Raises UserError for a rotation by other than quarter turns.
    """
    try:
        with open_container(path) as container:
            first = _first_image(container, container.streams.video[0])
            return None if first is None else first.size
    except DamagedImage as error:
        raise _impossible_rotation(path, error) from None
    except (UnreadableFile, av.error.FFmpegError, OSError, IndexError):
        return None


def _impossible_rotation(path: Path, error: DamagedImage) -> UserError:
    return UserError(f"{path}: {error}; {_REMOVE_ROTATION}")


class VideoRecording(CameraRecording):
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
            with open_container(path) as other:
                first = _first_image(other, other.streams[self._stream.index])
            orientation = 1 if first is None else first.orientation
            if depth and orientation in (2, 3, 4):
                raise UserError(
                    f"{path}: states a half turn or a mirror (orientation {orientation}), which "
                    "its depth files would not follow; turn the video itself, or "
                    f"{_REMOVE_ROTATION}"
                )
        except DamagedImage as error:
            self._container.close()
            raise _impossible_rotation(path, error) from None
        except UserError:
            self._container.close()
            raise
        super().__init__(path, camera, fps=rate)
        self._copied = first is not None and first.copied
        self._decoding = decoding
        self._remarks: Counter[str] = Counter()
        self._offset_s = offset_s
        self._times = None if times is None else list(times.values())
        self.timing = "" if times is None else "by timestamps"
        self._shots, _, self.notes = pair_images(
            [],
            depth,
            fps=rate,
            offset_s=offset_s,
            times=times,
            source=path.with_suffix(""),
            images=int(self._stream.frames),
        )
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
        faults, _ = inspect_files(self._shots, self.camera.depth, self._decoding)
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
        yield from read_pairs(self, self._shots, self._decoding)

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
                    image = turn(frame.to_ndarray(format="bgr24"), _orientation(frame))
                except DamagedImage:
                    self._damaged += 1
                    continue
                yield frame.time, encode_jpeg(image)
