"""Starts of cameras in recordings without motion, with a detector whose errors last."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import reproject
from intercap_core.scene.start_times import find_starts
from intercap_core.studio.noise import NoiseSource
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import DelayedPeople, walker

RIG, UP = ring()
VIEWS, FPS = len(RIG), 15.0


def still_person(seconds: float, *, seed: int, shared: bool) -> DelayedPeople:
    """A person who does not move; errors of 20 mm last for half a second.

    ``shared``: all views have the same errors, or each has its own.
    """
    noise = NoiseSource(seed, 1.0, "a", FPS)
    frames = round(seconds * FPS)
    person = walker(np.zeros(frames))
    images: list[list[list[np.ndarray] | None]] = [[None] * VIEWS for _ in range(frames)]
    for c in range(VIEWS):
        rng = noise.rng(0 if shared else c)
        error = 0.02 * noise.first_order(rng, frames, 405, 0.5).reshape(frames, 135, 3)
        seen = apply(invert(UP), (person + error).reshape(-1, 3))
        pixels = reproject(seen, RIG)[:, c].reshape(frames, 135, 2)
        pixels += noise.rng("pixels", c).normal(0, 2, pixels.shape)
        for t in range(frames):
            images[t][c] = [np.c_[pixels[t], np.full(135, 0.9)]]
    return DelayedPeople(images, np.zeros(VIEWS, int))


@pytest.mark.parametrize("seconds", [2.0, 5.0])
@pytest.mark.parametrize("shared", [True, False])
def test_lasting_errors_are_no_motion(seconds: float, shared: bool) -> None:
    for seed in range(2):
        people = still_person(seconds, seed=seed, shared=shared)
        times = np.arange(people.num_sets) / FPS
        starts = find_starts(people, RIG, times, people.available)
        assert not starts.sets.any()
