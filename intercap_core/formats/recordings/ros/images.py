"""Images in messages of ROS: ``sensor_msgs/Image`` and ``CompressedImage``.

Encodings: sensor_msgs/image_encodings.h; depth units: REP 118. Compressed depth is that of
compressed_depth_image_transport: 12 bytes (format, two parameters), then a 16-bit PNG or RVL
(Wilson 2017, "Fast Lossless Depth Image Compression").
"""

from __future__ import annotations

import re
import struct
from typing import Any, Literal

import cv2
import numpy as np
from numba import njit

from intercap_core.errors import UserError
from intercap_core.formats.recordings.encodings import (
    JPEG_QUALITY,
    DamagedImage,
    decode,
    decode_raw,
    encode_jpeg,
    encoded_size,
    store_colour,
    to_millimetres,
)

Kind = Literal["colour", "depth", "other"]

# Bytes of a pixel, and OpenCV's conversion to BGR, of colour encodings in lower case.
_COLOUR: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgr8": (3, None),
    "8uc3": (3, None),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUYV),
    "yuyv": (2, cv2.COLOR_YUV2BGR_YUYV),
    "yuy2": (2, cv2.COLOR_YUV2BGR_YUYV),
}
_DEPTH = {"16uc1": "u2", "mono16": "u2", "z16": "u2", "32fc1": "f4"}
_NO_COLOUR = ("mono8", "8uc1")  # infrared
_CODEC = re.compile("jpe?g|png")
_DEPTH_TRANSPORT = "compresseddepth"
_CONFIG = struct.Struct("<iff")  # of compressed depth: format, two parameters


def kind_of(message: Any) -> Kind:
    """Kind of the images of a topic, by one of its messages.

    Raises UserError for an encoding that is not supported; the text follows the topic's name.
    """
    encoding, text = _encoding(message), _format(message)
    if hasattr(message, "encoding"):
        supported = encoding in (*_COLOUR, "nv12", "mjpg", *_DEPTH, *_NO_COLOUR)
        what = f"encoding {encoding[:80]!r}"
    else:
        codec = text.partition(_DEPTH_TRANSPORT)[2].strip()
        is_depth = _DEPTH_TRANSPORT in text
        supported = codec in ("", "png", "rvl") if is_depth else bool(_CODEC.search(text))
        what = f"format {text[:80]!r}"
    if not supported:
        colour = ", ".join([*_COLOUR, "nv12", "mjpg"])
        raise UserError(
            f"has images of {what}, expected an encoding of colour ({colour}) or of depth "
            f"({', '.join(_DEPTH)}), or compressed images as jpeg, png or "
            "compressedDepth (png, rvl); record another topic of the camera, or convert the bag"
        )
    if encoding in _DEPTH or _DEPTH_TRANSPORT in text:
        return "depth"
    return "other" if encoding in _NO_COLOUR else "colour"


def decode_colour(message: Any) -> tuple[bytes, str]:
    """Return a colour image as the file that is stored, and a remark on what was changed.

    Raises :class:`DamagedImage`. The remark follows "colour images".
    """
    content, encoding = np.asarray(message.data, np.uint8), _encoding(message)
    if not hasattr(message, "encoding") or encoding == "mjpg":
        return store_colour(content.tobytes())
    size = (int(message.width), int(message.height))
    if encoding == "nv12":
        try:
            image = decode_raw(content.tobytes(), "NV12", size)
        except ValueError as error:
            raise DamagedImage(f"has another number of bytes than its size ({error})") from None
    else:
        channels, conversion = _COLOUR[encoding]
        rows = _rows(message, channels).reshape(size[1], size[0], channels)
        image = rows if conversion is None else cv2.cvtColor(rows, conversion)
    return encode_jpeg(image), f"are {encoding}, stored as JPEG of quality {JPEG_QUALITY}"


def decode_depth(message: Any, unit_m: float) -> np.ndarray:
    """Return a depth image (H, W) uint16, millimetres, 0 = invalid.

    Args:
        message: an image of kind "depth".
        unit_m: metres for one unit of images of 16 bits; those of 32 bits are in metres.

    Raises :class:`DamagedImage`.
    """
    if hasattr(message, "encoding"):
        kind = _DEPTH[_encoding(message)]
        values = _rows(message, np.dtype(kind).itemsize)
        depth = values.view(f"{'>' if message.is_bigendian else '<'}{kind}")
    else:
        depth = _decompress_depth(np.asarray(message.data, np.uint8).tobytes(), _format(message))
    depth = depth.astype(depth.dtype.newbyteorder("="), copy=False)
    return to_millimetres(depth, unit_m if depth.dtype == np.uint16 else 1.0)


def _decompress_depth(content: bytes, text: str) -> np.ndarray:
    """Depth (H, W) uint16 in the recorded unit, or float32 metres."""
    if _DEPTH_TRANSPORT not in text:
        return _decode_png(content)
    if len(content) <= _CONFIG.size:
        raise DamagedImage("is cut off")
    _, scale, offset = _CONFIG.unpack_from(content)
    packed = content[_CONFIG.size :]
    if text.endswith("rvl"):
        depth = _decode_rvl_image(packed)
    else:  # messages of old releases name no codec; all of them are PNG
        depth = _decode_png(packed)
    if not text.startswith("32fc1"):
        return depth
    with np.errstate(divide="ignore", invalid="ignore"):  # quantised inverse depth
        metres = scale / (depth.astype(np.float32) - offset)
    return np.where(depth == 0, np.float32(0), metres).astype(np.float32)


def _decode_png(content: bytes) -> np.ndarray:
    if encoded_size(content) is None:
        raise DamagedImage("is no whole PNG")
    depth = decode(content, cv2.IMREAD_UNCHANGED)
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise DamagedImage(f"has pixels of {depth.dtype}, expected one channel of uint16")
    return depth


def _decode_rvl_image(packed: bytes) -> np.ndarray:
    """Decode columns, rows (int32 each) and the packed pixels."""
    if len(packed) < 8:
        raise DamagedImage("is cut off")
    columns, rows = struct.unpack_from("<ii", packed)
    if not (0 < columns <= 1 << 14 and 0 < rows <= 1 << 14):
        raise DamagedImage(f"states a size of {columns}x{rows}")
    words = np.frombuffer(packed[8 : 8 + (len(packed) - 8) // 4 * 4], "<u4")
    depth = np.zeros(rows * columns, np.uint16)
    if not _decode_rvl(words.astype(np.uint32), depth):
        raise DamagedImage("is cut off")
    return depth.reshape(rows, columns)


@njit(cache=True)
def _decode_rvl(words: np.ndarray, depth: np.ndarray) -> bool:
    """Write pixels to ``depth`` (N,) uint16; return whether ``words`` (W,) uint32 hold all of them.

    Runs of zeros and of other pixels alternate. A run's length, and each difference to the pixel
    before, is a number of groups of three bits, the lowest first, each with a bit that states
    whether another group follows. Differences alternate in sign: 0, -1, 1, -2, 2, ...
    """
    at = 0  # groups of four bits, of which a word holds eight
    total = 8 * len(words)
    pixel, previous, run = 0, 0, 0
    stage = 0  # 0: length of a run of zeros, 1: length of a run of others, 2: a difference
    while pixel < len(depth):
        number, shift = 0, 0
        while True:
            if at >= total or shift > 30:
                return False
            group = (words[at // 8] >> np.uint32(28 - 4 * (at % 8))) & np.uint32(15)
            at += 1
            number |= (int(group) & 7) << shift
            shift += 3
            if group < 8:
                break
        if stage == 0:
            pixel += number
            stage = 1
        elif stage == 1:
            run = number
            if run > len(depth) - pixel:
                return False
            stage = 2 if run else 0
        else:
            previous += (number >> 1) ^ -(number & 1)
            depth[pixel] = previous & 0xFFFF
            pixel += 1
            run -= 1
            stage = 2 if run else 0
    return pixel == len(depth)


def _rows(message: Any, pixel_bytes: int) -> np.ndarray:
    """Pixels (H, W * pixel_bytes) uint8 without the padding at the end of rows."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    content = np.asarray(message.data, np.uint8)
    if min(height, width) < 1 or step < width * pixel_bytes or len(content) < height * step:
        raise DamagedImage(
            f"has {len(content)} bytes for {width}x{height} pixels in rows of {step} bytes"
        )
    rows = content[: height * step].reshape(height, step)[:, : width * pixel_bytes]
    return np.ascontiguousarray(rows)


def _encoding(message: Any) -> str:
    """Encoding of the pixels, in lower case; of a compressed image that before the compression."""
    stated = getattr(message, "encoding", None)
    return (_format(message).split(";")[0] if stated is None else stated).strip().lower()


def _format(message: Any) -> str:
    """Format of a compressed image, in lower case; "" for other images."""
    return str(getattr(message, "format", "")).strip().lower()
