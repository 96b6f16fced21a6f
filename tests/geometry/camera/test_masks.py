"""Run-length masks against pycocotools, and strings that are none."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycocotools import mask as peer

from intercap_core.geometry.camera import masks

HEIGHT, WIDTH = 37, 53


def blob(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    kind = seed % 4
    if kind == 0:
        return rng.random((HEIGHT, WIDTH)) < 0.4
    if kind == 1:
        mask = np.zeros((HEIGHT, WIDTH), bool)
        mask[rng.integers(0, 9) : rng.integers(10, HEIGHT), 5 : rng.integers(6, WIDTH)] = True
        return mask
    return np.full((HEIGHT, WIDTH), kind == 2)


@pytest.mark.parametrize("seed", range(12))
def test_runs_agree_with_the_decoded_mask(seed):
    mask = blob(seed)
    rle = masks.encode(mask)
    runs = masks.Runs(rle, HEIGHT, WIDTH)
    np.testing.assert_array_equal(runs.decode(), mask)
    np.testing.assert_array_equal(
        runs.decode(), peer.decode({"size": [HEIGHT, WIDTH], "counts": rle})
    )
    assert runs.area == mask.sum()
    np.testing.assert_array_equal(
        runs.box, peer.toBbox({"size": [HEIGHT, WIDTH], "counts": rle}).astype(int)
    )
    y, x = np.mgrid[-2 : HEIGHT + 2, -2 : WIDTH + 2]
    np.testing.assert_array_equal(runs.sample(x, y), np.pad(mask, 2))


@pytest.mark.parametrize("seed", range(4))
def test_runs_of_large_images_equal_pycocotools(seed):
    height, width = 1536, 2048
    rng = np.random.default_rng(seed)
    mask = np.zeros((height, width), bool)
    for _ in range(3 * seed):
        top, left = rng.integers(0, height - 1), rng.integers(0, width - 1)
        mask[top : top + rng.integers(1, 900), left : left + rng.integers(1, 700)] ^= True
    rle = bytes(peer.encode(np.asfortranarray(mask, dtype=np.uint8))["counts"])
    runs = masks.Runs(rle, height, width)
    changes = np.flatnonzero(np.diff(mask.T.ravel().astype(np.int8), prepend=0))
    np.testing.assert_array_equal(runs.ends, [*changes, mask.size])
    np.testing.assert_array_equal(
        runs.box, peer.toBbox({"size": [height, width], "counts": rle}).astype(int)
    )


def test_counts_and_polygons_equal_pycocotools():
    mask = blob(1)
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
