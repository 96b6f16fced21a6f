"""Encodings of single colour images: size, orientation, and the form in which an image is stored.

Stored files are whole JPEG or PNG files without an orientation, so that every reader of the frames
artefact (OpenCV, a browser, FFmpeg) shows the same pixels. JPEG: ITU-T T.81, annex B; PNG: RFC 2083
with the chunk eXIf; Exif: CIPA DC-008, 4.6; TIFF: revision 6.0.
"""

from __future__ import annotations

import re
import struct
from typing import Literal, NamedTuple

import av
import cv2
import numpy as np

JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
TIFF_STARTS = (b"II*\0", b"MM\0*")
JPEG_QUALITY = 97  # of colour that was not recorded as JPEG; an error of about 1 grey level
RAW_FORMATS = ("NV12", "YUY2", "BGRA")
# Markers but those within a scan: stuffed bytes and restarts.
_MARKER = re.compile(rb"\xff+[^\x00\xd0-\xd7\xff]")

OrientationUse = Literal["turn", "ignore", "refuse"]
"""Treatment of an image that states an orientation: turn its pixels, as OpenCV and FFmpeg do;
keep them as stored; or refuse half turns and mirrors, because depth would not follow them."""


class DamagedImage(Exception):
    """The file is no usable image or mask; the message follows the file's name."""


class _Jpeg(NamedTuple):
    """Structure of the first image of a JPEG file."""

    size: tuple[int, int]
    """Width and height as stored."""
    orientation: int
    """Exif orientation, 1 to 8."""
    orientation_at: int
    """Offset of the low byte of the Exif orientation; 0 without an entry."""
    end: int
    """Offset after the last byte of the image."""
    ended: bool
    """Whether the end marker is there."""


def encoded_size(content: bytes) -> tuple[int, int] | None:
    """Width and height of a JPEG or PNG file; None if the content is no complete file.

    The size is that of the image as OpenCV decodes it: rotated by a JPEG's Exif orientation. The
    image's end must be there (anything may follow it), and in a JPEG a scan. The chunks of a PNG
    must lie in the file: decoders reserve the memory that a chunk's length states. Pixels are not
    decoded.
    """
    if content.startswith(PNG_START):
        return struct.unpack(">II", content[16:24]) if _png_end(content) >= 33 else None
    jpeg = _parse_jpeg(content)
    if jpeg is None or not jpeg.ended:
        return None
    return jpeg.size[::-1] if jpeg.orientation >= 5 else jpeg.size


def store_colour(content: bytes, orientation_use: OrientationUse = "turn") -> tuple[bytes, str]:
    """Convert a JPEG, PNG, BMP or TIFF file to the form that is stored.

    A JPEG or PNG file without orientation is copied up to its end. Raises :class:`DamagedImage`.

    Returns:
        The stored file, and what was changed, as a remark that follows "colour images"; "" if the
        file is stored as it is.
    """
    jpeg = _parse_jpeg(content)
    remarks = []
    if jpeg is not None:
        orientation = jpeg.orientation
        whole = content[: jpeg.end] if jpeg.ended else _complete_jpeg(content[: jpeg.end])
        if not jpeg.ended:
            remarks.append("have no end marker, but are complete")
        if content[jpeg.end :].lstrip(b"\0\xff").startswith(JPEG_START[1:] + b"\xff"):
            remarks.append("are followed by another image in the same file, which is not read")
    elif content.startswith(PNG_START):
        if encoded_size(content) is None:
            raise DamagedImage("is cut off")
        if content[24:26] == b"\x10\0":
            raise DamagedImage("is a 16-bit grey PNG, as depth is; move depth files to depth/")
        whole, orientation = content[: _png_end(content)], stated_orientation(content)
    elif content.startswith((*TIFF_STARTS, b"BM")):
        kind = "BMP" if content.startswith(b"BM") else "TIFF"
        orientation, at = _exif_orientation(content)  # of a BMP: 1
        if kind == "BMP" and int.from_bytes(content[2:6], "little") > len(content):
            raise DamagedImage("is cut off")
        # OpenCV turns TIFF files, whatever its flags.
        whole = encode_jpeg(_decode_8_bit(_as_stored(content, at)))
        remarks.append(f"are {kind}, stored as JPEG of quality {JPEG_QUALITY}")
    elif content.startswith(JPEG_START):
        raise DamagedImage("is no whole JPEG")
    else:
        raise DamagedImage("is no whole JPEG, PNG, BMP or TIFF")
    if orientation == 1:
        return whole, "; ".join(remarks)
    if orientation_use == "ignore":
        if jpeg is not None:
            whole = _as_stored(whole, jpeg.orientation_at)
        elif content.startswith(PNG_START):
            whole = encode_jpeg(_decode_8_bit(content))
        remarks.append(
            f"state orientation {orientation}, which the calibration ignores: used as stored"
        )
        return whole, "; ".join(remarks)
    if orientation_use == "refuse" and orientation < 5:
        raise DamagedImage(
            f"states orientation {orientation} (turned or mirrored), the depth images none; turn "
            "the colour images, or remove the entry (exiftool -Orientation= FILES)"
        )
    image = decode(whole, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    remarks.append(
        f"state orientation {orientation}, were turned by it and stored as JPEG of quality "
        f"{JPEG_QUALITY}"
    )
    return encode_jpeg(turn(image, orientation)), "; ".join(remarks)


def stated_orientation(content: bytes) -> int:
    """Orientation, 1 to 8, that a PNG or TIFF file states; 1 without an entry."""
    tiff = content.partition(b"eXIf")[2] if content.startswith(PNG_START) else content
    return _exif_orientation(tiff)[0]


def turn(image: np.ndarray, orientation: int) -> np.ndarray:
    """The image (H, W, ...) as it is to be shown, by its Exif orientation 1 to 8."""
    image = image.swapaxes(0, 1) if orientation >= 5 else image
    rows = -1 if orientation in (3, 4, 7, 8) else 1
    columns = -1 if orientation in (2, 3, 6, 7) else 1
    return np.ascontiguousarray(image[::rows, ::columns])


def decode(content: bytes, flags: int) -> np.ndarray:
    """Decode an image file with OpenCV; raises :class:`DamagedImage`."""
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:  # its head states more pixels than OpenCV decodes
        image = None
    if image is None:
        raise DamagedImage("does not decode")
    return image


def _as_stored(content: bytes, orientation_at: int) -> bytes:
    """The file with orientation 1 at an offset of :func:`_exif_orientation`; 0 = no entry."""
    if orientation_at == 0:
        return content
    return content[:orientation_at] + b"\1" + content[orientation_at + 1 :]


def _decode_8_bit(content: bytes) -> np.ndarray:
    """(H, W, 3) uint8 BGR of a file as stored; raises :class:`DamagedImage`."""
    image = decode(content, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint8:  # of 10 or 12 bits, the share that holds the image is unknown
        raise DamagedImage(f"has pixels of {image.dtype}, expected 8 bits a channel")
    channels = 1 if image.ndim == 2 else image.shape[2]
    if channels not in (1, 3, 4):
        raise DamagedImage(f"has {channels} channels, expected 1, 3 or 4")
    return cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if channels == 1 else image[..., :3]


def _png_end(content: bytes) -> int:
    """Offset after the last chunk of a PNG file; 0 if the file is cut."""
    at = len(PNG_START)
    while at < len(content):
        start, at = at, at + 12 + int.from_bytes(content[at : at + 4], "big")
        if content[start + 4 : at] == PNG_END:
            return at
    return 0


def _parse_jpeg(content: bytes) -> _Jpeg | None:
    """Parse the first image; None if it is none or has no data."""
    if not content.startswith(JPEG_START):
        return None
    at, data = 2, 0  # bytes
    size: tuple[int, int] | None = None
    orientation, orientation_at = 1, 0
    has_exif = False  # the first segment counts, as in OpenCV
    end = len(content.rstrip(b"\0"))
    ended = False
    while (found := _MARKER.search(content, at)) is not None:
        marker, at = content[found.end() - 1], found.end()
        if marker in (0xD8, 0xD9):  # a start here is that of the next image
            ended = marker == 0xD9
            end = at if ended else found.start()
            break
        if marker == 0x01:  # has no content
            continue
        after = at + int.from_bytes(content[at : at + 2], "big")
        if after < at + 2 or after > len(content):
            return None
        # Frame headers are C0 to CF except tables, reserved and arithmetic conditioning.
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", content[at + 3 : at + 7].ljust(4, b"\0"))
            size = (width, height)
        if marker == 0xE1 and content[at + 2 : at + 8] == b"Exif\0\0" and not has_exif:
            has_exif = True
            orientation, where = _exif_orientation(content[at + 8 : after])
            orientation_at = at + 8 + where
        at = after
        if marker == 0xDA:  # a scan
            following = _MARKER.search(content, at)
            stop = len(content.rstrip(b"\0")) if following is None else following.start()
            data += max(0, stop - at)
            at = max(at, stop)
    if size is None or min(size) < 1 or data < 1:
        return None
    return _Jpeg(size, orientation, orientation_at, end, ended)


def _complete_jpeg(content: bytes) -> bytes:
    """Add a JPEG file's missing end marker; raises :class:`DamagedImage` if pixels are missing."""
    content += b"\0" * content.endswith(b"\xff")  # half of a marker, or of a stuffed byte
    if not holds_all_pixels(content + JPEG_END):
        raise DamagedImage("is cut off")
    return content + JPEG_END


def holds_all_pixels(content: bytes) -> bool:
    """Whether a file with an end is no JPEG, or a JPEG with data for all pixels.

    A camera that loses data in its transfer still writes the end of the image. OpenCV then fills
    the other pixels with grey; FFmpeg reports an error. The image is decoded at an eighth of its
    size: 3 ms for 1920 x 1080.
    """
    if not content.startswith(JPEG_START):
        return True
    decoder = av.CodecContext.create("mjpeg", "r")
    decoder.options = {"err_detect": "explode", "lowres": "3"}
    try:
        return bool(decoder.decode(av.Packet(content)) + decoder.decode(None))
    except av.error.FFmpegError:
        return False


def _exif_orientation(tiff: bytes) -> tuple[int, int]:
    """Orientation, 1 to 8, and the offset of its low byte; (1, 0) without a valid entry."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None or len(tiff) < 10:
        return 1, 0
    (at,) = struct.unpack(f"{order}I", tiff[4:8])
    (entries,) = struct.unpack(f"{order}H", tiff[at : at + 2].ljust(2, b"\0"))
    for start in range(at + 2, min(at + 2 + 12 * entries, len(tiff) - 11), 12):
        tag, _, _, value = struct.unpack(f"{order}HHIH", tiff[start : start + 10])
        if tag == 0x0112 and 1 <= value <= 8:
            return value, start + (8 if order == "<" else 9)
    return 1, 0


def encode_jpeg(image: np.ndarray) -> bytes:
    """Encode (H, W, 3) uint8 BGR as JPEG of :data:`JPEG_QUALITY`."""
    done, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError(f"an image of {image.shape} {image.dtype} cannot be stored as JPEG")
    return content.tobytes()


def decode_raw(content: bytes, pixel_format: str, size: tuple[int, int]) -> np.ndarray:
    """Decode a raw image of ``size`` (width, height) to (H, W, 3) uint8 BGR.

    ``pixel_format`` is one of :data:`RAW_FORMATS`. YUV is BT.601 with limited range, as in the
    viewer of the Azure Kinect. Raises ValueError for another number of bytes.
    """
    width, height = size
    shape, code = {
        "NV12": ((height * 3 // 2, width), cv2.COLOR_YUV2BGR_NV12),
        "YUY2": ((height, width, 2), cv2.COLOR_YUV2BGR_YUY2),
        "BGRA": ((height, width, 4), cv2.COLOR_BGRA2BGR),
    }[pixel_format]
    return cv2.cvtColor(np.frombuffer(content, np.uint8).reshape(shape), code)


def to_millimetres(depth: np.ndarray, unit_m: float) -> np.ndarray:
    """Convert depth (H, W) in units of ``unit_m`` metres to uint16, millimetres, 0 = invalid.

    Invalid are 0, numbers that are not finite, distances above 65.534 m, and the largest number of
    16 bits, which sensors write where they measure nothing.
    """
    if depth.dtype == np.uint16:
        depth = np.where(depth == np.iinfo(np.uint16).max, 0, depth)
        if unit_m == 0.001:
            return depth
    millimetres = np.rint(depth * (1000 * unit_m))
    valid = (millimetres > 0) & (millimetres < np.iinfo(np.uint16).max)  # False for NaN
    return np.where(valid, millimetres, 0).astype(np.uint16)
