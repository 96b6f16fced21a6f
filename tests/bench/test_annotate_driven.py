"""What the driver of the annotation page decides without a browser."""

from __future__ import annotations

import numpy as np
import pytest

from bench.annotate_driven import _start, _to_place, _within


@pytest.mark.parametrize("apart", [1, 2, 4])
def test_every_lost_frame_has_a_pose_near_it(apart: int) -> None:
    rng = np.random.default_rng(apart)
    lost, posed = rng.random(60) < 0.4, {7, 30}
    found = _to_place(lost, posed, apart)
    every = sorted([*found, *posed])
    assert set(found) <= set(np.flatnonzero(lost).tolist())
    assert all(min(abs(t - other) for other in every) < apart for t in np.flatnonzero(lost))
    assert all(abs(a - b) >= apart for a in found for b in every if a != b)


def test_a_drag_is_as_long_as_a_hand_reaches_and_keeps_its_direction() -> None:
    assert _within((30.2, -4.9)) == (30, -5)
    far = _within((3000.0, 4000.0))
    assert far == (156, 208)


def test_a_drag_begins_on_the_object_where_the_view_shows_it() -> None:
    box = [100.0, 50.0, 400.0, 300.0]
    assert _start(box, (150.0, 90.0), (10, 10)) == (150.0, 90.0)
    x, y = _start(box, (-900.0, 90.0), (200, 40))
    assert box[0] < x < box[0] + box[2] and box[1] < y < box[1] + box[3]
