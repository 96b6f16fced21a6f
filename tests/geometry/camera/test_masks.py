"""Run-length masks against pycocotools, and strings that are none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycocotools import mask as peer

from intercap_core.geometry.camera import masks

HEIGHT, WIDTH = 37, 53


def blob(height: int, width: int, seed: int) -> np.ndarray:
    """Rectangles that partly cancel each other; none for seed 0."""
    rng = np.random.default_rng(seed)
    mask = np.zeros((height, width), bool)
    for _ in range(3 * seed):
        top, left = rng.integers(0, height - 1), rng.integers(0, width - 1)
        down, right = rng.integers(1, (3 * height // 5, width // 3))
        mask[top : top + down, left : left + right] ^= True
    return mask


NOISE = np.random.default_rng(4).random((3, HEIGHT, WIDTH)) < 0.4
MASKS = [*NOISE, np.ones((HEIGHT, WIDTH), bool)]
MASKS += [blob(*size, seed) for size in ((HEIGHT, WIDTH), (1536, 2048)) for seed in range(4)]


@pytest.mark.parametrize("mask", MASKS)
def test_runs_agree_with_pycocotools(mask):
    height, width = mask.shape
    rle = masks.encode(mask)
    assert rle == bytes(peer.encode(np.asfortranarray(mask, dtype=np.uint8))["counts"])
    runs = masks.Runs(rle, height, width)
    changes = np.flatnonzero(np.diff(mask.T.ravel().astype(np.int8), prepend=0))
    np.testing.assert_array_equal(runs.ends, [*changes, mask.size])
    np.testing.assert_array_equal(runs.decode(), mask)
    assert runs.area == mask.sum()
    box = peer.toBbox({"size": [height, width], "counts": rle}).astype(int)
    np.testing.assert_array_equal(runs.box, box)
    y, x = np.mgrid[-2 : HEIGHT + 2, -2 : WIDTH + 2]
    padded = np.pad(mask, 2)[: HEIGHT + 4, : WIDTH + 4]
    np.testing.assert_array_equal(runs.sample(x, y), padded)


def test_counts_and_polygons_equal_pycocotools():
    mask = blob(HEIGHT, WIDTH, 1)
    changes = np.flatnonzero(np.diff(mask.T.ravel().astype(int), prepend=0))
    counts = np.diff([0, *changes, mask.size]).tolist()
    assert masks.from_counts(counts, HEIGHT, WIDTH) == masks.encode(mask)
    polygons = [[3.0, 3, 20, 3, 20, 15, 3, 15], [30.0, 20, 45, 20, 40, 33]]
    made = masks.decode(masks.from_polygons(polygons, HEIGHT, WIDTH), HEIGHT, WIDTH)
    expected = peer.decode(peer.frPyObjects(polygons, HEIGHT, WIDTH)).any(-1)
    np.testing.assert_array_equal(made, expected)
    assert not masks.decode(masks.from_polygons([], HEIGHT, WIDTH), HEIGHT, WIDTH).any()


@pytest.mark.parametrize(
    ("rle", "words"),
    [
        (b"", "empty"),
        (b"abc\x80", "alphabet"),
        (b" 12", "alphabet"),
        (b"oooooooooooo1", "too long"),
        (b"5o", "cut"),
        (b"5O", "negative"),
        (masks.encode(np.ones((HEIGHT, WIDTH + 1))), "expected 1961"),
    ],
)
def test_wrong_rle_strings_are_refused(rle, words):
    with pytest.raises(ValueError, match=words):
        masks.Runs(rle, HEIGHT, WIDTH)


@given(st.binary(max_size=40))
@settings(max_examples=300, deadline=None)
def test_any_bytes_fill_the_image_or_are_refused(rle):
    try:
        runs = masks.Runs(rle, 4, 5)
    except ValueError:
        return
    assert runs.decode().shape == (4, 5)
    assert runs.decode().sum() == runs.area


@pytest.mark.parametrize(
    "counts",
    [[3, "a"], [1.5, 1], [-1, 21], [3, 4], [[1], [2]], [2**63, 2**63 + 20], [10**400]],
)
def test_wrong_counts_are_refused(counts):
    with pytest.raises(ValueError):
        masks.from_counts(counts, 4, 5)


@pytest.mark.parametrize("polygon", [[1, 2, 3, 4], [1, 2, 3, 4, 5, np.nan], [1, 2, 3, 4, 5, 6, 7]])
def test_wrong_polygons_are_refused(polygon):
    with pytest.raises(ValueError, match="corners"):
        masks.from_polygons([polygon], 4, 5)


@pytest.mark.parametrize("value", [1e9, -1e9, 1e300, 100001.0])
def test_polygons_far_outside_are_refused(value):
    with pytest.raises(ValueError, match="pixels of the image"):
        masks.from_polygons([[1, 2, value, 4, 5, 6]], 4, 5)


@pytest.mark.parametrize(
    ("x0", "y0", "size"), [(0, 0, (9, 12)), (0, 0, (40, 50)), (3, 31, (9, 12)), (38, 28, (12, 12))]
)
@pytest.mark.parametrize("filled", [0.0, 0.5, 0.97, 1.0])
def test_a_window_is_encoded_as_the_whole_image(x0, y0, size, filled):
    rng = np.random.default_rng(3)
    whole = np.zeros((40, 50), bool)
    window = rng.random(size)[: 40 - y0, : 50 - x0] < filled
    whole[y0 : y0 + window.shape[0], x0 : x0 + window.shape[1]] = window
    assert masks.encode_window(window, x0, y0, 40, 50) == masks.encode(whole)
