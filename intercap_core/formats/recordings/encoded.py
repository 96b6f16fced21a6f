"""Colour images as files in memory: JPEG or PNG as recorded, never decoded on the way through.

JPEG: ITU-T T.81, annex B; PNG: RFC 2083; Exif: CIPA DC-008, 4.6.
"""

from __future__ import annotations

import struct

import numpy as np

JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
JPEG_QUALITY = 97  # of colour that was not recorded as JPEG; about 1 grey level of error
RAW_FORMATS = {"NV12": 1.5, "YUY2": 2.0, "BGRA": 4.0}  # bytes a pixel
_SCAN = 0xDA
_NO_FRAME_HEADERS = (0xC4, 0xC8, 0xCC)  # among C0..CF: tables, reserved, arithmetic conditioning


def encoded_size(content: bytes) -> tuple[int, int] | None:
    """Return width and height of a JPEG or PNG file; None for what is no whole file of these.

    They are those of the image as OpenCV decodes it: turned as a JPEG's Exif orientation says. The
    end must be there (zero bytes may follow a JPEG's), and in a JPEG a scan; its pixels are not
    looked at.
    """
    if content.startswith(PNG_START):
        whole = content.endswith(PNG_END) and len(content) >= 33
        return struct.unpack(">II", content[16:24]) if whole else None
    if not content.startswith(JPEG_START):
        return None
    if not content.endswith(JPEG_END) and not content.rstrip(b"\0").endswith(JPEG_END):
        return None
    return _jpeg_size(content)


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Walk the segments up to the first scan; the frame header before it holds the size."""
    at, lying = 2, False
    size: tuple[int, int] | None = None
    while at + 9 <= len(content) and content[at] == 0xFF:
        marker = content[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME_HEADERS:
            height, width = struct.unpack(">HH", content[at + 5 : at + 9])
            size = (height, width) if lying else (width, height)
        end = at + 2 + int.from_bytes(content[at + 2 : at + 4], "big")
        if marker == 0xE1 and content[at + 4 : at + 10] == b"Exif\0\0":
            lying = _orientation(content[at + 10 : end]) >= 5  # by a quarter turn
        if marker == _SCAN:
            return size if end + 2 < len(content.rstrip(b"\0")) else None
        at = end
    return None


def _orientation(tiff: bytes) -> int:
    """The Exif orientation, 1 to 8; 1 (as stored) where there is none."""
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None or len(tiff) < 10:
        return 1
    (at,) = struct.unpack(f"{order}I", tiff[4:8])
    (entries,) = struct.unpack(f"{order}H", tiff[at : at + 2].ljust(2, b"\0"))
    for start in range(at + 2, min(at + 2 + 12 * entries, len(tiff) - 11), 12):
        tag, _, _, value = struct.unpack(f"{order}HHIH", tiff[start : start + 10])
        if tag == 0x0112:
            return value if 1 <= value <= 8 else 1
    return 1


def encode_jpeg(image: np.ndarray) -> bytes:
    """Encode (H, W, 3) uint8 BGR, for recordings whose colour cannot be copied."""
    import cv2

    done, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError(f"an image of {image.shape} {image.dtype} cannot be stored as JPEG")
    return content.tobytes()


def decode_raw(content: bytes, pixel_format: str, size: tuple[int, int]) -> np.ndarray:
    """Return (H, W, 3) uint8 BGR of a raw image of ``size`` (width, height).

    ``pixel_format`` is one of :data:`RAW_FORMATS`; YUV is BT.601 with limited range, as the Azure
    Kinect's own viewer takes it. Raises ValueError for another number of bytes.
    """
    import cv2

    width, height = size
    shape, code = {
        "NV12": ((height * 3 // 2, width), cv2.COLOR_YUV2BGR_NV12),
        "YUY2": ((height, width, 2), cv2.COLOR_YUV2BGR_YUY2),
        "BGRA": ((height, width, 4), cv2.COLOR_BGRA2BGR),
    }[pixel_format]
    return cv2.cvtColor(np.frombuffer(content, np.uint8).reshape(shape), code)
