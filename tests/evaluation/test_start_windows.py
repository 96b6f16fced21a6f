"""Starts in windows of a recording, on a walking stick person."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.evaluation.start_windows import (
    Recording,
    WindowErrors,
    measure_windows,
    window_figures,
)
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import reproject
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import DelayedPeople, walker

RIG, UP = ring()
FPS = 15.0


def recording(late: np.ndarray, true_late: np.ndarray) -> Recording:
    """Two seconds of images that are ``late`` (C,) sets, with a truth that states ``true_late``."""
    rng, times = np.random.default_rng(1), np.arange(30) / FPS
    seen = np.full((30, len(RIG), 135, 3), 0.9)
    for c, delay in enumerate(late / FPS):
        points = apply(invert(UP), walker(times - delay).reshape(-1, 3))
        seen[:, c, :, :2] = reproject(points, RIG)[:, c].reshape(30, 135, 2)
    seen[..., :2] += rng.normal(0, 2, seen[..., :2].shape)
    people = DelayedPeople([[[image] for image in row] for row in seen], np.zeros(len(RIG), int))
    stated = np.broadcast_to(true_late, people.available.shape)
    return Recording(people, RIG, 0, times, FPS, people.available, stated)


def test_true_starts_are_removed_and_only_other_delays_are_errors() -> None:
    true = np.array([0, 0, 7, 0, -2, 0])
    errors = measure_windows(recording(true + 2 * (np.arange(6) == 1), true))
    assert errors.moved.tolist() == [True, False, False, False, False]
    assert errors.silent.tolist() == [False, True]  # the second window cuts the same camera


def test_shares_are_of_cameras() -> None:
    some = WindowErrors(np.array([True, False, False, False]), np.array([True]))
    none = WindowErrors(np.zeros(4, bool), np.array([False, False, False]))
    found = window_figures([some, none])
    assert found == {"in_step_moved_share": 0.125, "starts_silent_share": pytest.approx(0.25)}
    assert window_figures([]) == {}
