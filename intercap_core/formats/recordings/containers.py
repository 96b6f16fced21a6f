"""A preview at a video: its head, first and last image, how much of it is there; not its images.

Takes milliseconds for files with an index (mp4, mov, avi) and for Matroska, which states its own
length; other files are read from the last image that can be jumped to.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np

from intercap_core.formats.recordings.encoded import encoded_size
from intercap_core.inputs.files import check_file

# By content a file may also be a list of other files or addresses, which FFmpeg would follow.
FORMATS = "matroska,webm,mov,mp4,m4a,3gp,3g2,mj2,avi,mpeg,mpegts,mpegvideo"
LATEST_US = 10**15  # of a device's clock: some thirty years; later ones are damage
MAX_SIDE = 16_384  # px of an image that is decoded


def open_container(path: Path, **options: str) -> Any:
    """Open a regular file; raises Unreadable where it is none, and what PyAV raises where it is no
    container of :data:`FORMATS`."""
    check_file(path, None)
    return av.open(
        f"file:{path}",
        options={"format_whitelist": FORMATS, "protocol_whitelist": "file", **options},
        metadata_errors="replace",
    )


FIRST_PACKETS = 60  # within these some image must decode: two seconds
_MATROSKA = "matroska"
_SEGMENT_ID = b"\x18\x53\x80\x67"


class RecordingPreview(NamedTuple):
    """What a look at a recording shows without reading all of it.

    ``size`` (width, height) of the first colour image, None = none can be read. ``images`` counts
    the colour images that are there (one by one where ``counted``, else by duration and rate),
    ``seconds`` lasts from the first to the last; None = nothing says. ``share`` of what the head
    states is in the file. ``faults`` are what else is wrong, in words that follow its name.
    """

    size: tuple[int, int] | None
    images: int | None
    seconds: float | None
    share: float = 1.0
    faults: tuple[str, ...] = ()
    counted: bool = True


def preview_video(path: Path, stream_index: int, fps: float) -> RecordingPreview:
    """Look at one track of a video file that opens."""
    with open_container(path) as container:
        stream: Any = container.streams[stream_index]
        # read here: a stream of a closed container is freed memory
        stated, frames = float(container.duration or 0) / av.time_base, int(stream.frames)
        length = os.path.getsize(path)
        entries = getattr(stream, "index_entries", None) or ()
        if _MATROSKA in container.format.name:
            share = _share_of_segment(path, length)
            seconds = stated * share if stated else None
        elif frames and len(entries) == frames:
            there = sum(entry.pos + entry.size <= length for entry in entries)
            share = there / frames
            seconds = float(stream.duration * stream.time_base) * share if stream.duration else None
        else:
            seconds = _last_time(container, stream)
            share = 1.0
            if frames and seconds is not None:
                share = min(1.0, (round(seconds * fps) + 1) / frames)
    with open_container(path) as container:
        size = _first_size(container, container.streams[stream_index])
    if seconds is None:
        return RecordingPreview(size, None, None, share, counted=False)
    counted = frames > 0
    images = round(frames * share) if counted else max(1, round(seconds * fps))
    return RecordingPreview(size, images, seconds, share, counted=counted)


def _first_size(container: Any, stream: Any) -> tuple[int, int] | None:
    """Size of the first image that decodes, turned as its file says."""
    try:
        for number, packet in enumerate(container.demux(stream)):
            if number > FIRST_PACKETS:
                return None
            if stream.codec_context.name == "mjpeg":
                size = encoded_size(bytes(packet))
                if size is not None:
                    return size
                continue
            for frame in packet.decode():
                turned = round((getattr(frame, "rotation", 0) or 0) / 90) % 2
                return (frame.height, frame.width) if turned else (frame.width, frame.height)
    except (av.error.FFmpegError, OSError):
        pass
    return None


def _last_time(container: Any, stream: Any) -> float | None:
    """Seconds from the first image to the last that can be read; None where there is none."""
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
    """Which share of the bytes that a Matroska file's Segment states is there; 1 = it does not."""
    with open(path, "rb") as file:
        end = segment_end(file.read(4096))
    return 1.0 if end is None else min(1.0, length / end)


def segment_end(head: bytes) -> int | None:
    """Where the Segment of a Matroska file ends, bytes; None where it was never finished.

    ``head`` is the file's beginning. Source: RFC 8794, section 6; RFC 9559, section 5.1.
    """
    at = head.find(_SEGMENT_ID)
    if at < 0 or at + 5 > len(head):
        return None
    width = 9 - head[at + 4].bit_length()  # of the length that follows the id
    field = head[at + 4 : at + 4 + width]
    stated = int.from_bytes(field, "big") & ((1 << 7 * width) - 1)
    return None if stated == (1 << 7 * width) - 1 else at + 4 + width + stated
