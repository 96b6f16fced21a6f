"""Keypoints of one view located by its depth."""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.camera.transforms import apply
from intercap_core.person.lifting import DepthRelief
from tests.helpers.synthetic_capture import ring

RIG, _ = ring()
CAMERA = RIG[1]
NO_INSET = np.zeros(10)


def _wall(mm: int) -> np.ndarray:
    assert CAMERA.depth is not None
    return np.full((CAMERA.depth.height, CAMERA.depth.width), mm, np.uint16)


def _pixels() -> np.ndarray:
    """(10,2) of the colour image, below each other in its middle."""
    middle = np.array([CAMERA.colour.width, CAMERA.colour.height]) / 2
    return middle + np.stack([np.zeros(10), np.linspace(-200, 200, 10)], 1)


def _depths(relief: DepthRelief) -> np.ndarray:
    points = relief.lift(_pixels(), np.ones(10, bool), NO_INSET)
    return apply(CAMERA.colour_from_master, points)[:, 2]


def test_person_is_lifted_behind_a_table():
    """A table hides the lower quarter of the image; the person stands at 2.4 m."""
    room, seen = _wall(4000), _wall(2400)
    table = slice(room.shape[0] * 11 // 20, None)
    room[table] = seen[table] = 1300
    z = _depths(DepthRelief.of(seen, CAMERA, 0.0, room))
    known = np.isfinite(z)
    assert 6 <= known.sum() < 10 and z[known].min() > 2.2
    naive = _depths(DepthRelief.of(seen, CAMERA, 0.0, None))
    assert np.nanmin(naive) < 1.5  # without a background the table is the person


def test_person_in_the_background_is_lifted():
    still = _wall(2400)
    z = _depths(DepthRelief.of(still, CAMERA, 0.0, still))
    assert np.isfinite(z).sum() >= 8 and np.nanmax(np.abs(z - 2.4)) < 0.2


def test_static_trunk_behind_a_table_is_lifted():
    """The upper quarter never moved and is the room's; the table is nearer by a metre."""
    seen, room = _wall(2400), _wall(4000)
    table, still = slice(room.shape[0] * 13 // 20, None), slice(0, room.shape[0] * 7 // 20)
    room[still] = 2400
    room[table] = seen[table] = 1300
    z = _depths(DepthRelief.of(seen, CAMERA, 0.0, room))
    assert np.isnan(z[-1]) and np.nanmin(z) > 2.2
    assert np.isfinite(z[:7]).all(), "the trunk that never moved too"


def test_keypoints_without_depth_are_not_lifted():
    half = _wall(2400)
    half[half.shape[0] // 2 - 20 :] = 0
    z = _depths(DepthRelief.of(half, CAMERA, 0.0, None))
    assert 2 <= np.isfinite(z).sum() <= 6 and np.nanmax(np.abs(z - 2.4)) < 0.2
