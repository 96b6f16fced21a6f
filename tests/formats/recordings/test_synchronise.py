"""Frame sets by device time, on time lines whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from intercap_core.formats.recordings.synchronise import (
    images_of_moments,
    nearest_images,
    synchronise,
)

PERIOD = 33_333
SKEW = 8_000


def ticks(numbers, offset=0) -> np.ndarray:
    return 7_000_000 + np.array(list(numbers), np.int64) * PERIOD + offset


def run(*times, master=0):
    return synchronise(times, period_us=PERIOD, max_skew_us=SKEW, master=master)


def test_cameras_that_start_and_stop_apart():
    table = run(ticks(range(2, 8)), ticks(range(0, 6), 500), ticks(range(4, 12), -300))
    assert len(table.times_us) == 12
    assert np.array_equal((table.index >= 0).sum(axis=0), [6, 6, 8])
    assert table.index[:, 0].tolist() == [-1, -1, 0, 1, 2, 3, 4, 5, -1, -1, -1, -1]
    assert table.times_us[0] == ticks([0], 500)[0]  # the master has no image there
    assert table.times_us[2] == ticks([2])[0]


def test_other_cameras_make_the_sets_that_the_master_lacks():
    table = run(ticks([0, 1, 3]), ticks(range(4), 160), ticks(range(4), 320))
    assert table.index[:, 0].tolist() == [0, 1, -1, 2]
    assert table.index[2].tolist() == [-1, 2, 2]
    assert table.times_us[2] == ticks([2], 160)[0]


def test_an_image_between_two_sets_is_left_out_and_counted():
    table = run(ticks(range(5)), ticks(range(5), PERIOD // 2))
    assert len(table.times_us) == 5
    assert table.unmatched.tolist() == [0, 5]


def test_a_missing_camera_and_a_missing_master():
    table = run(ticks(range(3)), np.array([], np.int64))
    assert table.index.tolist() == [[0, -1], [1, -1], [2, -1]]
    table = run(np.array([], np.int64), ticks(range(3)), ticks(range(3), 200))
    assert table.index.tolist() == [[-1, 0, 0], [-1, 1, 1], [-1, 2, 2]]
    assert run(np.array([], np.int64)).index.shape == (0, 1)


def test_gaps_of_the_whole_recording():
    table = run(ticks([0, 1, 2, 6, 7]), ticks([0, 1, 2, 6, 7], 100))
    assert table.gaps(PERIOD) == [(2, 3)]


def test_times_out_of_order_keep_their_positions():
    table = run(ticks([2, 0, 1]), ticks(range(3)))
    assert table.index.tolist() == [[1, 0], [2, 1], [0, 2]]


def test_depth_joins_the_sets_after_its_delay():
    sets = ticks(range(5))
    assert nearest_images(sets, ticks([0, 2, 3]), SKEW).tolist() == [0, -1, 1, 2, -1]
    assert nearest_images(sets, ticks([0], 9_000), SKEW).tolist() == [-1] * 5


@pytest.mark.parametrize("bad", [{"master": 3}, {"max_skew_us": 20_000}])
def test_impossible_settings_are_refused(bad):
    options = dict(period_us=PERIOD, max_skew_us=SKEW, master=0) | bad
    with pytest.raises(ValueError):
        synchronise([ticks(range(3))], **options)


@settings(max_examples=60, deadline=None)
@given(
    kept=st.lists(st.sets(st.integers(0, 25)), min_size=1, max_size=6),
    jitter=st.integers(0, 1500),
    seed=st.integers(0, 1000),
)
def test_every_image_finds_its_set_whatever_is_lost(kept, jitter, seed):
    """With jitter far below the period, set and camera decide the image, as if by table."""
    rng = np.random.default_rng(seed)
    times, truth = [], []
    for numbers in map(sorted, kept):
        exact = ticks(numbers)
        times.append(exact + rng.integers(-jitter, jitter + 1, len(exact)))
        truth.append(numbers)
    table = run(*times)
    seen = sorted(set().union(*kept))
    assert len(table.times_us) == len(seen)
    assert not table.unmatched.any()
    for camera, numbers in enumerate(truth):
        expected = [numbers.index(n) if n in numbers else -1 for n in seen]
        assert table.index[:, camera].tolist() == expected


def test_a_slipped_image_belongs_to_the_moment_it_shows():
    slip = np.zeros((8, 2), np.int32)
    slip[3:6, 1] = 2  # sets 3, 4, 5 show the moments 1, 2, 3 again
    available = np.ones((8, 2), bool)
    available[1, 1] = False  # its own image is missing: the slipped one stands in
    shown = images_of_moments(slip, available)
    assert shown[:, 0].tolist() == list(range(8))
    assert shown[:, 1].tolist() == [0, 3, 2, 5, -1, -1, 6, 7]
