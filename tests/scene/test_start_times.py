"""Cameras that started up to seconds apart, on studio captures and on walking stick people."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from intercap_core.camera.transforms import apply, invert
from intercap_core.camera.triangulation import reproject
from intercap_core.person.sides import swapped
from intercap_core.scene.moments import find_moments
from intercap_core.scene.people_in_view import middles
from intercap_core.scene.start_times import InStep, Starts, find_starts
from tests.helpers.keypoint_capture import KeypointCapture, keypoint_capture
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import seen_by, walking
from tests.scene.test_slips import walker

RIG, UP = ring()


@dataclass(frozen=True)
class Late:
    """The people of images (T, C) lists of (P, 135, 3), each camera's ``late`` (C,) sets late."""

    images: list[list[list[np.ndarray] | None]]
    late: np.ndarray

    @property
    def num_sets(self) -> int:
        return len(self.images)

    def people(self, t: int, c: int) -> np.ndarray:
        moment = t - int(self.late[c])
        found = self.images[moment][c] if 0 <= moment < len(self.images) else None
        return np.array(found or []).reshape(-1, 135, 3)

    @property
    def available(self) -> np.ndarray:
        shape = range(self.num_sets), range(len(self.late))
        return np.array([[len(self.people(t, c)) > 0 for c in shape[1]] for t in shape[0]])


def walk(late_s: np.ndarray, fps: float, seconds: float, *, moving: bool = True) -> Late:
    """A walker whose cameras' images are ``late_s`` (C,) older; a detector that errs by 2 px and
    calls left what is right in a fifth of the images."""
    rng = np.random.default_rng(5)
    times = np.arange(round(seconds * fps)) / fps
    images: list[list[list[np.ndarray] | None]] = [[None] * len(RIG) for _ in times]
    for c, late in enumerate(late_s):
        points = walker((times - late) * moving)
        pixels = reproject(apply(invert(UP), points.reshape(-1, 3)), RIG)[:, c]
        pixels = pixels.reshape(len(times), 135, 2) + rng.normal(0, 2, (len(times), 135, 2))
        for t, person in enumerate(np.dstack([pixels, np.full(pixels.shape[:2], 0.9)])):
            images[t][c] = [swapped(person) if rng.uniform() < 0.2 else person]
    return Late(images, np.zeros(len(RIG), int))


@pytest.mark.parametrize(("fps", "seconds"), [(15.0, 5.0), (30.0, 4.0), (60.0, 4.0)])
def test_a_walker_shows_when_each_camera_started(fps, seconds):
    late = np.r_[0.0, np.random.default_rng(int(fps)).uniform(-1, 1, len(RIG) - 1)]
    seen = walk(late, fps, seconds)
    times = np.arange(seen.num_sets) / fps
    found = find_starts(seen, RIG, times, seen.available)
    assert found.apart and not found.in_doubt.any()
    assert np.abs(found.late - late).max() < 0.5 / fps  # what is left, offsets tell
    assert (found.sets == np.round(found.late * fps)).all()


@pytest.mark.parametrize("apart", [False, True], ids=["together", "apart"])
def test_somebody_who_stands_by_does_not_put_cameras_out_of_step(apart):
    """Of both people a detector means some points otherwise in each view, and in any order: what is
    taken off one over time is not the other's. Who stands still agrees at any time."""
    fps, rng = 15.0, np.random.default_rng(11)
    late = np.r_[0.0, rng.uniform(-1, 1, len(RIG) - 1)] * apart
    seen = walk(late, fps, 5.0)
    standing = seen_by(walking(1, np.array([0.9, -0.7]), np.zeros(2)), RIG, UP)[0]
    for c in range(len(RIG)):
        meant = rng.normal(0, 15, (2, 135, 2))
        for row in seen.images:
            other = standing[c].copy()
            other[:, :2] += rng.normal(0, 2, (135, 2)) + meant[0]
            row[c][0][:, :2] += meant[1]
            row[c].insert(int(rng.integers(2)), other)
    found = find_starts(seen, RIG, np.arange(seen.num_sets) / fps, seen.available)
    assert found.apart == apart and not found.in_doubt.any()
    assert np.abs(found.late - late).max() < 0.5 / fps


@dataclass
class Slower:
    """What ``seen`` shows, in every ``every[c]``-th set of camera c."""

    seen: Late
    every: list[int]

    @property
    def num_sets(self) -> int:
        return self.seen.num_sets

    def people(self, t: int, c: int) -> np.ndarray:
        there = t % self.every[c] == self.every[c] - 1
        return self.seen.people(t, c) if there else np.zeros((0, 135, 3))

    @property
    def available(self) -> np.ndarray:
        first = np.array(self.every) - 1
        return np.arange(self.num_sets)[:, None] % self.every == first


@pytest.mark.parametrize("every", [[1, 1, 2, 1, 1, 2], [1, 2, 2, 2, 2, 2], [1, 4, 1, 2, 3, 1]])
def test_cameras_of_other_rates_are_brought_into_step(every):
    """30 images a second beside 60, and so on."""
    late = np.r_[0.0, np.random.default_rng(3).uniform(-1, 1, len(RIG) - 1)]
    seen = Slower(walk(late, 60.0, 4.0), every)
    found = find_starts(seen, RIG, np.arange(seen.num_sets) / 60, seen.available)
    assert found.apart and not found.in_doubt.any()
    assert np.abs(found.late - late).max() < 0.017


def test_who_stands_still_shows_no_start():
    seen = walk(np.linspace(0, 1, len(RIG)), 15.0, 4.0, moving=False)
    found = find_starts(seen, RIG, np.arange(60) / 15, seen.available)
    assert not found.apart and not found.late.any() and not found.in_doubt.any()


@pytest.fixture(scope="module")
def captures() -> list[KeypointCapture]:
    return [
        keypoint_capture("suitcase_carry", seed=9411, subject="s06"),
        keypoint_capture("toolbox_carry", seed=9412, subject="s01", fps=30, frames=90),
        keypoint_capture("football_kick", seed=9413, subject="s09", family="b"),
    ]


def test_studio_captures_are_in_step(captures):
    for capture in captures:
        seen = Late(capture.people, np.zeros(6, int))
        found = find_starts(seen, capture.rig, capture.times, seen.available)
        assert not found.apart and not found.sets.any()


def test_studio_captures_are_brought_into_step(captures):
    """Starts, the studio's own slips and offsets, all together."""
    wrong, errors = [], []
    for n, capture in enumerate(captures):
        rng = np.random.default_rng(n)
        late = np.r_[0, np.round(rng.uniform(-0.9, 0.9, 5) * capture.fps).astype(int)]
        seen = Late(capture.people, late)
        available = seen.available
        found = find_moments(seen, capture.rig, capture.times, capture.fps, available, master=0)
        place = np.clip(np.arange(len(available))[:, None] - late, 0, len(available) - 1)
        true = np.take_along_axis(capture.slip, place, 0) + late
        told = ~found.starts.in_doubt
        assert told.sum() >= 5
        assert (found.image_of[:, ~told] == -1).all()
        wrong.append((found.slip != true)[available & told].mean())
        errors.append((found.timing.offset - capture.offset)[told])
    assert np.mean(wrong) < 0.05
    assert np.abs(np.concatenate(errors)).mean() < 0.002


def test_middles_do_not_depend_on_sides():
    person = np.random.default_rng(2).uniform(0.4, 1, (135, 3))
    np.testing.assert_allclose(middles(swapped(person)), middles(person))
    person[2, 2] = 0  # a shoulder that is not seen has no middle
    assert np.isnan(middles(person)).any(axis=1).sum() == 1


def test_images_move_to_their_moments_and_back():
    """Camera 1's images are two sets old, camera 2's are one ahead."""
    starts = Starts(np.array([0, 0.21, -0.1]), np.array([0, 2, -1]), np.zeros(3, bool), True, 0.1)
    images = np.arange(1, 16).reshape(5, 3)
    moved = starts.in_step(images)
    assert moved[:, 0].tolist() == images[:, 0].tolist()
    assert moved[:, 1].tolist() == [*images[2:, 1], 0, 0]
    assert moved[:, 2].tolist() == [0, *images[:-1, 2]]
    back = starts.of_images(moved)
    assert back[:, 1].tolist() == [0, 0, *images[2:, 1]]
    assert back[:, 2].tolist() == [*images[:-1, 2], 0]
    slip = np.zeros((5, 3), int)
    slip[1, 1] = 3  # in step: the image of set 3
    assert starts.with_slips(slip)[:, 1].tolist() == [2, 2, 2, 5, 2]
    np.testing.assert_allclose(starts.offset, [0, -0.01, 0.0], atol=1e-12)


def test_people_follow_the_images():
    late = Late([[[np.full((135, 3), t)] for _ in range(2)] for t in range(4)], np.zeros(2, int))
    starts = Starts(np.zeros(2), np.array([0, 1]), np.array([False, False]), True, 0.1)
    seen = InStep(late, starts)
    assert seen.num_sets == 4
    assert seen.people(1, 1)[0, 0, 0] == 2 and not len(seen.people(3, 1))
