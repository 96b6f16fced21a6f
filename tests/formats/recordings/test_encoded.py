"""Sizes of image files without decoding them, and colour that is encoded here."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from intercap_core.formats.recordings.encodings import (
    DamagedImage,
    decode_raw,
    encode_jpeg,
    encoded_size,
    holds_all_pixels,
    store_colour,
)
from intercap_core.formats.recordings.image_files import read_depth


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


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("orientation", range(10))
def test_size_follows_the_exif_orientation(orientation, order):
    jpeg = cv2.imencode(".jpg", picture())[1].tobytes()
    turned = with_exif(jpeg, orientation, order)
    for content in (turned, with_exif(turned, 1, order), with_exif(turned, 6, order)):
        decoded = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        assert encoded_size(content) == decoded.shape[1::-1]


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


@pytest.mark.parametrize(("name", "pixel_bytes"), [("NV12", 1.5), ("YUY2", 2), ("BGRA", 4)])
def test_raw_images_of_another_size_are_refused(name, pixel_bytes):
    content = bytes(round(64 * 48 * pixel_bytes))
    assert decode_raw(content, name, (64, 48)).shape == (48, 64, 3)
    with pytest.raises(ValueError, match="reshape"):
        decode_raw(content[:-1], name, (64, 48))


def encoded(suffix: str, image: np.ndarray, options: tuple[int, ...] = ()) -> bytes:
    return cv2.imencode(suffix, image, options)[1].tobytes()


def shown(content: bytes, flags: int = cv2.IMREAD_COLOR) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(content, np.uint8), flags)


PROGRESSIVE = (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)
JPEG = encoded(".jpg", picture(160, 120))
OTHER = encoded(".jpg", picture(160, 120)[:, ::-1])
TIFF_ORIENTATION = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, 3, 0, 0)


@pytest.mark.parametrize("tail", [b"\xff" * 64, bytes(64), b"MODEL" * 20, b"\0\0\0\x18ftypmp42\0"])
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_what_follows_an_image_is_left_out(suffix, tail):
    content = encoded(suffix, picture(160, 120))
    assert store_colour(content + tail) == (content, "")
    assert encoded_size(content + tail) == (160, 120)


def test_further_images_of_a_file_are_noted():
    for content in (JPEG + OTHER, JPEG + bytes(9) + OTHER, JPEG[:-2] + OTHER):
        stored, remark = store_colour(content)
        assert stored == JPEG and "followed by another image" in remark


def test_a_complete_jpeg_without_its_end_marker_is_used():
    for whole in (JPEG, encoded(".jpg", picture(160, 120), PROGRESSIVE)):
        for content in (whole[:-2], whole[:-1], whole[:-2] + bytes(500)):
            stored, remark = store_colour(content)
            assert np.array_equal(shown(stored), shown(whole)) and "no end marker" in remark


def test_jpegs_without_all_data_are_damaged():
    noise = np.random.default_rng(0).integers(0, 255, (120, 160, 3)).astype(np.uint8)
    content = encoded(".jpg", noise)
    scan = content.index(b"\xff\xda") + 14
    half = content[: len(content) // 2]
    for damaged in (
        half, half + bytes(5000), content[:scan] + b"\xff\xd9", content[:scan] + bytes(9000),
    ):  # fmt: skip
        with pytest.raises(DamagedImage):
            store_colour(damaged)
    assert holds_all_pixels(content)
    for cut in (scan + 60, len(content) // 2, int(0.9 * len(content))):
        assert not holds_all_pixels(content[:cut] + b"\xff\xd9")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_stored_images_have_no_orientation(orientation):
    """OpenCV is the peer that turns; the stored file looks alike with and without orientation."""
    content = with_exif(JPEG, orientation, ">")
    for use, flags in (("turn", cv2.IMREAD_COLOR), ("ignore", cv2.IMREAD_COLOR | 128)):
        stored, remark = store_colour(content, use)
        true = shown(content, flags).astype(int)
        assert shown(stored).shape == shown(stored, cv2.IMREAD_COLOR | 128).shape == true.shape
        assert np.abs(shown(stored) - true).mean() < 1 and bool(remark) == (orientation > 1)
    if orientation in (2, 3, 4):
        with pytest.raises(DamagedImage, match="the depth images none"):
            store_colour(content, "refuse")
    else:
        store_colour(content, "refuse")


def test_a_png_with_an_orientation_is_turned():
    png = encoded(".png", picture(160, 120))
    chunk = b"eXIf" + TIFF_ORIENTATION
    length, checksum = struct.pack(">I", len(chunk) - 4), struct.pack(">I", zlib.crc32(chunk))
    stored, _ = store_colour(png[:33] + length + chunk + checksum + png[33:])
    assert np.abs(shown(stored).astype(int) - picture(160, 120)[::-1, ::-1]).mean() < 2


def tiff(image: np.ndarray, orientation: int, order: str) -> bytes:
    """An uncompressed TIFF file of the image (H, W, 3) BGR, at most 65,535 bytes."""
    height, width, _ = image.shape
    values = {
        256: width, 257: height, 259: 1, 262: 2, 273: 142, 274: orientation, 277: 3, 278: height,
        279: image.size,
    }  # fmt: skip
    entries = [struct.pack(f"{order}HHIHH", tag, 3, 1, n, 0) for tag, n in values.items()]
    entries.insert(2, struct.pack(f"{order}HHII", 258, 3, 3, 136))  # bits: 3 numbers at byte 136
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}IH", 8, len(entries))
    content = (head + b"".join(entries)).ljust(136, b"\0") + struct.pack(f"{order}3H", 8, 8, 8)
    return content + image[..., ::-1].tobytes()


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_tiff_is_turned_once_or_not_at_all(orientation, order):
    """OpenCV is the peer that turns."""
    image = picture(160, 120)
    content = tiff(image, orientation, order)
    for use, true in (("turn", shown(content)), ("ignore", image)):
        stored, remark = store_colour(content, use)
        assert shown(stored).shape == true.shape and ("orientation" in remark) == (orientation > 1)
        assert np.abs(shown(stored).astype(int) - true).mean() < 2


@pytest.mark.parametrize("length", [0, 0x7F0002FE, 0xFFFFFFFF])
def test_a_png_whose_chunk_has_another_length_is_cut_off(tmp_path, length):
    depth = encoded(".png", np.zeros((30, 50), np.uint16))
    damaged = depth[:33] + struct.pack(">I", length) + depth[37:]
    (tmp_path / "depth.png").write_bytes(damaged)
    assert encoded_size(depth) == (50, 30) and encoded_size(damaged) is None
    with pytest.raises(DamagedImage, match="is cut off"):
        read_depth(tmp_path / "depth.png", (50, 30))


@pytest.mark.parametrize("form", ["TIFF", "PNG"])
def test_depth_that_states_an_orientation_is_refused(tmp_path, form):
    depth, exif, path = np.arange(6, dtype=np.uint16).reshape(2, 3), Image.Exif(), tmp_path / "d"
    for orientation in range(1, 9):
        exif[0x0112], exif[0x0132] = orientation, "9999:99:99 99:99:99"  # no time that exists
        Image.fromarray(depth).save(path, form, exif=exif)
        if orientation == 1:
            np.testing.assert_array_equal(read_depth(path, (3, 2)), depth)
        else:
            with pytest.raises(DamagedImage, match=f"orientation {orientation}, the depth lens no"):
                read_depth(path, (3, 2))


def test_heads_that_state_too_many_pixels_are_damage(tmp_path):
    """OpenCV raises for more than 2^20 pixels a side or 2^30 in all."""
    bmp = bytearray(encoded(".bmp", picture()))
    bmp[18:22] = struct.pack("<i", 1 << 21)
    at = JPEG.index(b"\xff\xc0") + 5
    jpeg = JPEG[:at] + struct.pack(">HH", 65_000, 65_000) + JPEG[at + 4 :]
    for content in (bytes(bmp), with_exif(jpeg, 6, "<")):
        with pytest.raises(DamagedImage, match="does not decode"):
            store_colour(content)
    depth = bytearray(encoded(".tif", picture()[..., 0].astype(np.uint16)))
    tag = struct.pack("<H", 256)
    entry = depth.index(tag + struct.pack("<HI", 3, 1))
    depth[entry : entry + 12] = tag + struct.pack("<HII", 4, 1, 1 << 21)
    (tmp_path / "depth.tif").write_bytes(depth)
    with pytest.raises(DamagedImage, match="does not decode"):
        read_depth(tmp_path / "depth.tif", (50, 30))


@pytest.mark.parametrize("suffix", [".bmp", ".tif"])
def test_bmp_and_tiff_are_stored_as_jpeg(suffix):
    stored, remark = store_colour(encoded(suffix, picture(160, 120)))
    assert stored.startswith(b"\xff\xd8") and "stored as JPEG of quality 97" in remark
    assert np.abs(shown(stored).astype(int) - picture(160, 120)).mean() < 2
    with pytest.raises(DamagedImage):
        store_colour(encoded(suffix, picture(160, 120))[:-4000])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (encoded(".tif", picture().astype(np.uint16)), "uint16, expected 8 bits"),
        (encoded(".tif", picture().astype(np.float32)), "float32, expected 8 bits"),
        (encoded(".png", picture()[..., 0].astype(np.uint16)), "16-bit grey PNG, as depth"),
        (encoded(".webp", picture()), "no whole JPEG, PNG, BMP or TIFF"),
    ],
)
def test_other_images_are_refused(content, words):
    with pytest.raises(DamagedImage, match=words):
        store_colour(content)
