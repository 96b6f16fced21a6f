"""Cameras that started up to seconds apart, on studio captures and on walking stick people."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import reproject
from intercap_core.person.sides import swap_sides
from intercap_core.scene.moments import describe_stated_start, find_moments
from intercap_core.scene.start_costs import body_middles
from intercap_core.scene.start_times import find_starts
from intercap_core.scene.starts import AlignedPeople, StartTimes, StatedStarts, describe_start
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
            images[t][c] = [swap_sides(person) if rng.uniform() < 0.2 else person]
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


@pytest.mark.parametrize("apart", [False, True], ids=["together", "apart"])
def test_a_detector_that_returns_another_person_for_a_while_costs_those_images_alone(apart):
    """One person an image; the third camera's is somebody else in two of five seconds, who passes
    behind the subject: some of those images look late. No other image and no offset is touched."""
    fps, rng = 15.0, np.random.default_rng(12)
    late = np.r_[0.0, rng.uniform(-1, 1, len(RIG) - 1)] * apart
    seen = walk(late, fps, 5.0)
    times = np.arange(seen.num_sets) / fps
    usual = find_moments(seen, RIG, times, fps, seen.available, master=0)
    other = seen_by(walking(seen.num_sets, np.array([0.9, -0.7]), np.array([-0.01, 0])), RIG, UP)
    other[..., :2] += rng.normal(0, 2, other[..., :2].shape)
    wrong = np.zeros((seen.num_sets, len(RIG)), bool)
    wrong[20:50, 2] = True
    for t in range(20, 50):
        seen.images[t][2] = [other[t, 2]]
    found = find_moments(seen, RIG, times, fps, seen.available, master=0)
    assert found.starts.apart == apart and not found.starts.in_doubt.any()
    of_subject = (usual.image_of >= 0) & ~wrong[usual.image_of, np.arange(len(RIG))]
    np.testing.assert_array_equal(found.image_of[of_subject], usual.image_of[of_subject])
    left = found.starts.sets / fps - found.timing.offset - late
    assert np.abs(left).max() < 0.005


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
    np.testing.assert_allclose(body_middles(swap_sides(person)), body_middles(person))
    person[2, 2] = 0  # a shoulder that is not seen has no middle
    assert np.isnan(body_middles(person)).any(axis=1).sum() == 1


def brought(late: np.ndarray, sets: np.ndarray) -> StartTimes:
    none = np.zeros(len(late), bool)
    return StartTimes(late, sets, none, True, 0.1, np.full(len(late), np.nan), none)


def test_images_move_to_their_moments_and_back():
    """Camera 1's images are two sets old, camera 2's are one ahead."""
    starts = brought(np.array([0, 0.21, -0.1]), np.array([0, 2, -1]))
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
    starts = brought(np.zeros(2), np.array([0, 1]))
    seen = AlignedPeople(late, starts)
    assert seen.num_sets == 4
    assert seen.people(1, 1)[0, 0, 0] == 2 and not len(seen.people(3, 1))


def stated(late: np.ndarray, sigma: float = 0.028) -> StatedStarts:
    """What somebody states of all cameras but the master."""
    late = np.r_[np.nan, late[1:]]
    source = ("", *("the annotation",) * (len(late) - 1))
    return StatedStarts(late, np.where(np.isnan(late), np.nan, sigma), source)


def test_who_stands_still_is_brought_into_step_as_stated():
    late = np.r_[0.0, np.random.default_rng(4).uniform(-1, 1, len(RIG) - 1)]
    seen = walk(late, 15.0, 4.0, moving=False)
    told = stated(late + 0.01)
    moments = find_moments(
        seen, RIG, np.arange(60) / 15, 15.0, seen.available, master=0, stated=told
    )
    starts = moments.starts
    assert not starts.in_doubt.any() and not starts.denied.any()
    assert (starts.sets == np.round(told.sets(1 / 15))).all()
    np.testing.assert_allclose(starts.late[1:], late[1:] + 0.01, atol=1e-9)
    np.testing.assert_allclose(starts.offset_sigma[1:], 0.028)
    left = starts.sets / 15 - starts.offset - late
    assert np.abs(left[1:]).max() < 0.011


def test_an_honest_statement_does_not_hold_who_walks_back():
    """The master's own statement is wrong by a set and a third, which is in all the others'."""
    late = np.r_[0.0, np.random.default_rng(7).uniform(-0.8, 0.8, len(RIG) - 1)]
    seen = walk(late, 30.0, 4.0)
    times = np.arange(seen.num_sets) / 30
    for told in (None, stated(late + 0.044)):
        found = find_moments(seen, RIG, times, 30.0, seen.available, master=0, stated=told)
        assert not found.starts.denied.any() and not found.slips.intervals
        np.testing.assert_allclose(found.slip.mean(0) / 30 - found.timing.offset, late, atol=0.004)


@pytest.mark.parametrize("seconds", [4.0, 6.0])
def test_a_stated_start_may_be_farther_than_any_search(seconds):
    """More than a third of the recording: no search without it looks so far."""
    late = np.zeros(len(RIG))
    late[2] = 0.55 * seconds
    seen = walk(late, 15.0, seconds)
    times = np.arange(seen.num_sets) / 15
    found = find_starts(seen, RIG, times, seen.available, stated=stated(late + 0.01))
    assert found.apart and not found.in_doubt.any() and not found.denied.any()
    assert np.abs(found.late - late).max() < 0.03


@pytest.mark.parametrize(("fps", "wrong"), [(15.0, 0.4), (30.0, -0.4), (60.0, 0.4)])
def test_a_wrong_start_is_denied_by_who_walks(fps, wrong):
    late = np.r_[0.0, np.random.default_rng(6).uniform(-0.8, 0.8, len(RIG) - 1)]
    seen = walk(late, fps, 4.0)
    times = np.arange(seen.num_sets) / fps
    told = stated(late + wrong * (np.arange(len(RIG)) == 2))
    moments = find_moments(seen, RIG, times, fps, seen.available, master=0, stated=told)
    starts = moments.starts
    assert np.flatnonzero(starts.denied).tolist() == [2] and np.isnan(starts.sigma[2])
    assert np.abs(starts.late - late).max() < 0.5 / fps + 0.02
    note = describe_stated_start(told, starts, moments.slips, 2, moments.timing.offset[2], 0.002)
    assert note.startswith("the annotation has it start") and "deny" in note
    assert f"{abs(late[2] + wrong):.3f} s" in note
    for c in (1, 3, 4, 5):
        kept = describe_stated_start(
            told, starts, moments.slips, c, moments.timing.offset[c], 0.002
        )
        assert "and was brought into step: so say the annotation and the keypoints" in kept


def test_a_sharp_statement_that_is_a_little_wrong_is_denied_by_the_offsets():
    """Told to a millisecond, wrong by 20: no whole set, so that the offsets tell."""
    late = np.zeros(len(RIG))
    seen = walk(late, 30.0, 4.0)
    told = stated(np.array([0, 0.02, 0, 0, 0, 0]), 0.001)
    times = np.arange(seen.num_sets) / 30
    moments = find_moments(seen, RIG, times, 30.0, seen.available, master=0, stated=told)
    assert np.flatnonzero(moments.starts.denied).tolist() == [1]
    late = moments.slip.mean(0) / 30 - moments.timing.offset
    assert (
        np.abs(late).max() < 0.004
        and np.abs(moments.starts.offset - moments.timing.offset)[1] < 1e-9
    )


def test_of_cameras_that_nobody_states_the_keypoints_tell():
    late = np.r_[0.0, 0.7, -0.6, 0.5, -0.4, 0.3]
    seen = walk(late, 15.0, 5.0)
    told = stated(np.where(np.arange(6) < 3, late, np.nan))
    told = StatedStarts(told.late, np.where(np.isnan(told.late), np.nan, 0.028), told.source)
    found = find_starts(seen, RIG, np.arange(seen.num_sets) / 15, seen.available, stated=told)
    assert not found.in_doubt.any() and np.abs(found.late - late).max() < 0.5 / 15
    still = walk(late, 15.0, 5.0, moving=False)
    found = find_starts(still, RIG, np.arange(seen.num_sets) / 15, still.available, stated=told)
    assert found.apart and found.in_doubt.tolist() == [False] * 3 + [True] * 3


def test_starts_are_told_beside_the_times_of_the_files():
    """k2 began to record 2 s after k1; its file's times say 0.5 s."""
    told = StatedStarts.of(
        {"k1": (100.0, 0.03), "k2": (102.0, 0.04)},
        ["k1", "k2", "k3"],
        0,
        np.array([0.0, 0.5, 0.0]),
        "the annotation",
    )
    np.testing.assert_allclose(told.late, [np.nan, -1.5, np.nan])
    np.testing.assert_allclose(told.sigma, [np.nan, 0.05, np.nan])
    assert told.sets(0.1).tolist() == [0, -15, 0] and told.says_apart(0.1)
    assert describe_start(told.late[1]) == "1.500 s later than its times say"
    with pytest.raises(UserError, match=r"annotation has camera k2 start 1\.500 s later"):
        told.check_common(np.array([0, 1.6]), ["k1", "k2", "k3"])
    told.check_common(np.array([0, 3.0]), ["k1", "k2", "k3"])


def test_two_sources_are_put_together_unless_they_disagree():
    nan = np.nan
    first = StatedStarts(
        np.array([nan, 0.5, 0.5, nan]), np.array([nan, 0.02, 0.02, nan]), ("", *"aa", "")
    )
    other = StatedStarts(
        np.array([nan, 0.53, 0.9, 0.1]), np.array([nan, 0.01, 0.01, 0.01]), ("", *"bbb")
    )
    both, odd = first.combine(other)
    np.testing.assert_allclose(both.late, [nan, 0.524, 0.5, 0.1])
    np.testing.assert_allclose(both.sigma, [nan, 0.02 / 5**0.5, 0.02, 0.01])
    assert both.source == ("", "a and b", "a", "b")
    assert [bool(text) for text in odd] == [False, False, True, False]
