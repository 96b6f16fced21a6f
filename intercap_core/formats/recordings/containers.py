"""Files of video and sound, read by PyAV: packets, preview, first image and sound track."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.recordings.encodings import DamagedImage, encoded_size
from intercap_core.formats.recordings.source import SOUND_RATE, RecordingPreview, Sound
from intercap_core.inputs.files import UnreadableFile, check_file

# FFmpeg would also follow lists of other files or addresses.
FORMATS = "matroska,webm,mov,mp4,m4a,3gp,3g2,mj2,avi,mpeg,mpegts,mpegvideo"
REMOVE_ROTATION = "remove the rotation (ffmpeg -display_rotation 0 -i FILE -c copy NEW)"
LATEST_US = 10**16  # of a device's clock, which may count from 1970; later times are damage
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
    first = first_image(path, stream_index)
    size = None if first is None else first.size
    if seconds is None:
        return RecordingPreview(size, None, None, share, counted=False)
    counted = frames > 0
    images = round(frames * share) if counted else max(1, round(seconds * fps))
    return RecordingPreview(size, images, seconds, share, counted=counted)


def orientation_of(frame: Any) -> int:
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


class FirstImage(NamedTuple):
    """Properties of the first image of a video that decodes."""

    size: tuple[int, int]
    """Width and height as shown, after the rotation that the file states."""
    orientation: int
    """Exif orientation of the rotation."""
    copied: bool
    """Whether the packet is a JPEG file of the image as shown."""


def first_image(path: Path, stream_index: int | None = None) -> FirstImage | None:
    """Properties of the first image that decodes; None if no image does.

    Raises UserError for a rotation by other than quarter turns. ``stream_index``: None = the first
    video track.
    """
    with open_container(path) as container:
        streams = container.streams
        stream: Any = streams.video[0] if stream_index is None else streams[stream_index]
        for packet in islice(demux(container, stream, lambda: None), 61):  # of two seconds
            with contextlib.suppress(av.error.FFmpegError, OSError):
                for frame in packet.decode():
                    try:
                        orientation, size = orientation_of(frame), (frame.width, frame.height)
                    except DamagedImage as error:
                        raise UserError(f"{path}: {error}; {REMOVE_ROTATION}") from None
                    # Packets of interlaced videos hold two JPEG files, each with half of the rows.
                    copied = orientation == 1 and encoded_size(bytes(packet)) == size
                    copied = copied and stream.codec_context.name == "mjpeg"
                    return FirstImage(size[::-1] if orientation >= 5 else size, orientation, copied)
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
