"""Sizes of image files without decoding them, and colour that is encoded here."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest

from intercap_core.formats.recordings.encodings import (
    RAW_FORMATS,
    decode_raw,
    encode_jpeg,
    encoded_size,
)


def picture(width=50, height=30) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return np.stack([x, y, 255 - x], -1).astype(np.uint8)


def with_exif(jpeg: bytes, orientation: int, order: str) -> bytes:
    entry = struct.pack(f"{order}HHIHH", 0x0112, 3, 1, orientation, 0)
    other = struct.pack(f"{order}HHIHH", 0x0100, 3, 1, 7, 0)
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}IH", 8, 2)
    segment = b"Exif\0\0" + head + other + entry + bytes(4)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


@pytest.mark.parametrize(
    ("suffix", "options"),
    [
        (".jpg", []),
        (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".jpg", [cv2.IMWRITE_JPEG_RST_INTERVAL, 1]),
        (".png", []),
    ],
)
def test_size_of_whole_files(suffix, options):
    content = cv2.imencode(suffix, picture(), options)[1].tobytes()
    assert encoded_size(content) == (50, 30)
    assert encoded_size(content[:-1]) is None
    assert encoded_size(content[1:]) is None
    if suffix == ".jpg":
        assert encoded_size(content + b"\0\0\0") == (50, 30)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("orientation", range(10))
def test_size_follows_the_exif_orientation(orientation, order):
    jpeg = cv2.imencode(".jpg", picture())[1].tobytes()
    turned = with_exif(jpeg, orientation, order)
    decoded = cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR)
    assert encoded_size(turned) == decoded.shape[1::-1]


def test_noise_is_no_image():
    rng = np.random.default_rng(0)
    jpeg = with_exif(cv2.imencode(".jpg", picture())[1].tobytes(), 6, "<")
    for _ in range(300):
        damaged = bytearray(jpeg)
        for at in rng.integers(2, 200, 3):
            damaged[at] = rng.integers(256)
        encoded_size(bytes(damaged))  # some size or none, never an exception
    assert encoded_size(b"") is None and encoded_size(b"\xff\xd8\xff\xd9") is None
    assert encoded_size(rng.bytes(100)) is None
    scan = jpeg.index(b"\xff\xda")
    assert encoded_size(jpeg[:scan] + b"\xff\xd9") is None
    assert encoded_size(jpeg[: scan + 14] + b"\xff\xd9") is None


def test_encoding_changes_little():
    decoded = cv2.imdecode(
        np.frombuffer(encode_jpeg(picture(640, 480)), np.uint8), cv2.IMREAD_COLOR
    )
    assert np.abs(decoded.astype(int) - picture(640, 480)).mean() < 1


@pytest.mark.parametrize("name", RAW_FORMATS)
def test_raw_images_of_another_size_are_refused(name):
    content = bytes(round(64 * 48 * RAW_FORMATS[name]))
    assert decode_raw(content, name, (64, 48)).shape == (48, 64, 3)
    with pytest.raises(ValueError, match="reshape"):
        decode_raw(content[:-1], name, (64, 48))
