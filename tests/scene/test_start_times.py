"""Start times of cameras that were started up to seconds apart, on walking stick people."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import reproject
from intercap_core.person.sides import swap_sides
from intercap_core.scene.keypoint_timing import find_offsets
from intercap_core.scene.moments import Moments, describe_stated_start, find_moments
from intercap_core.scene.start_costs import body_middles
from intercap_core.scene.start_times import find_starts
from intercap_core.scene.starts import (
    AlignedPeople,
    StartTimes,
    StatedStarts,
    describe_start,
    shift_images,
)
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import DelayedPeople, seen_by, walker, walking

RIG, UP = ring()
VIEWS = len(RIG)
FULL = pytest.mark.full


def walk(late_s: np.ndarray, fps: float, seconds: float, *, moving: bool = True) -> DelayedPeople:
    """A walker seen by cameras whose images are ``late_s`` (C,) seconds older than stated.

    The detector errs by 2 px and exchanges left and right in a fifth of the images.
    """
    rng = np.random.default_rng(5)
    times = np.arange(round(seconds * fps)) / fps
    images: list[list[list[np.ndarray] | None]] = [[None] * VIEWS for _ in times]
    for c, late in enumerate(late_s):
        points = walker((times - late) * moving)
        pixels = reproject(apply(invert(UP), points.reshape(-1, 3)), RIG)[:, c]
        pixels = pixels.reshape(len(times), 135, 2) + rng.normal(0, 2, (len(times), 135, 2))
        for t, person in enumerate(np.dstack([pixels, np.full(pixels.shape[:2], 0.9)])):
            images[t][c] = [swap_sides(person) if rng.uniform() < 0.2 else person]
    return DelayedPeople(images, np.zeros(VIEWS, int))


def delays(seed: int, most: float = 1.0) -> np.ndarray:
    """Random delays (C,) of all cameras but the master, seconds."""
    return np.r_[0.0, np.random.default_rng(seed).uniform(-most, most, VIEWS - 1)]


def starts_of(people, fps: float, stated: StatedStarts | None = None) -> StartTimes:
    times = np.arange(people.num_sets) / fps
    return find_starts(people, RIG, times, people.available, stated=stated)


def moments_of(people, fps: float, stated: StatedStarts | None = None) -> Moments:
    times = np.arange(people.num_sets) / fps
    return find_moments(people, RIG, times, fps, people.available, master=0, stated=stated)


@pytest.mark.parametrize(
    ("fps", "seconds"),
    [(15.0, 5.0), pytest.param(30.0, 3.5, marks=FULL), pytest.param(60.0, 4.0, marks=FULL)],
)
def test_walker_reveals_the_start_of_each_camera(fps, seconds):
    late = delays(int(fps))
    starts = starts_of(walk(late, fps, seconds), fps)
    assert starts.apart and not starts.in_doubt.any()
    assert np.abs(starts.late - late).max() < 0.5 / fps  # offsets explain the rest
    assert (starts.sets == np.round(starts.late * fps)).all()


@pytest.mark.parametrize(
    "apart", [pytest.param(False, marks=FULL), True], ids=["together", "apart"]
)
def test_bystander_who_stands_still_does_not_shift_cameras(apart):
    """Two people in any order; the detector's bias differs by person and view. A person who stands
    still agrees at any lag."""
    fps, rng = 15.0, np.random.default_rng(11)
    late = np.r_[0.0, rng.uniform(-1, 1, VIEWS - 1)] * apart
    people = walk(late, fps, 5.0)
    standing = seen_by(walking(1, np.array([0.9, -0.7]), np.zeros(2)), RIG, UP)[0]
    for c in range(VIEWS):
        bias = rng.normal(0, 15, (2, 135, 2))
        for row in people.images:
            bystander = standing[c].copy()
            bystander[:, :2] += rng.normal(0, 2, (135, 2)) + bias[0]
            row[c][0][:, :2] += bias[1]
            row[c].insert(int(rng.integers(2)), bystander)
    starts = starts_of(people, fps)
    assert starts.apart == apart and not starts.in_doubt.any()
    assert np.abs(starts.late - late).max() < 0.5 / fps


@pytest.mark.parametrize(
    "apart", [pytest.param(False, marks=FULL), True], ids=["together", "apart"]
)
def test_another_person_in_one_view_affects_only_those_images(apart):
    """The third camera shows a passer-by instead of the subject for two of five seconds.

    If the cameras started apart, its own start may be undetermined, and is then named.
    """
    fps, rng = 15.0, np.random.default_rng(12)
    late = np.r_[0.0, rng.uniform(-1, 1, VIEWS - 1)] * apart
    people = walk(late, fps, 5.0)
    passing = walking(people.num_sets, np.array([0.9, -0.7]), np.array([-0.01, 0]))
    other = seen_by(passing, RIG, UP)
    other[..., :2] += rng.normal(0, 2, other[..., :2].shape)
    wrong = np.zeros((people.num_sets, VIEWS), bool)
    wrong[20:50, 2] = True
    for t in range(20, 50):
        people.images[t][2] = [other[t, 2]]
    result = moments_of(people, fps)
    doubt = result.starts.in_doubt
    assert result.starts.apart == apart and not doubt[[0, 1, 3, 4, 5]].any()
    assert not doubt[2] or (apart and result.starts.undetermined[2])
    image = np.arange(people.num_sets)[:, None] + result.starts.sets
    recorded = (image >= 0) & (image < people.num_sets)
    of_subject = recorded & ~wrong[np.where(recorded, image, 0), np.arange(VIEWS)] & ~doubt
    np.testing.assert_array_equal(result.image_of[of_subject], image[of_subject])
    error = np.abs(result.starts.sets / fps - result.timing.offset - late)
    assert error[~doubt].max() < 0.005


@pytest.mark.parametrize(
    ("fps", "every"),
    [
        (30.0, [1, 1, 2, 1, 1, 2]),
        pytest.param(60.0, [1, 2, 2, 2, 2, 2], marks=FULL),
        pytest.param(60.0, [1, 4, 1, 2, 3, 1], marks=FULL),
    ],
)
def test_cameras_of_different_rates_are_aligned(fps, every):
    """Camera c has every ``every[c]``-th image."""
    late = delays(3)
    people = walk(late, fps, 4.0)
    for t, c in np.ndindex(people.num_sets, VIEWS):
        if t % every[c] != every[c] - 1:
            people.images[t][c] = None
    starts = starts_of(people, fps)
    assert starts.apart and not starts.in_doubt.any()
    assert np.abs(starts.late - late).max() < 0.017


def test_person_who_stands_still_reveals_no_start():
    starts = starts_of(walk(np.linspace(0, 1, VIEWS), 15.0, 4.0, moving=False), 15.0)
    assert not starts.apart and not starts.late.any() and not starts.in_doubt.any()


def test_optimum_at_the_end_of_the_search_is_named_and_refused():
    late = np.where(np.arange(VIEWS) == 2, 1.5, 0.0)  # 22 sets are searched
    starts = starts_of(walk(late, 15.0, 5.0), 15.0)
    assert not starts.apart and not starts.sets.any() and not starts.in_doubt.any()
    assert "an end of the searched range" in starts.undetermined[2]


def test_a_vague_statement_does_not_admit_an_optimum_at_the_end():
    late = np.where(np.arange(VIEWS) == 2, 1.5, 0.0)
    stated = np.where(np.arange(VIEWS) == 0, np.nan, 0.0)
    vague = StatedStarts(stated, np.where(np.isnan(stated), np.nan, 1.0), ("a note",) * VIEWS)
    starts = starts_of(walk(late, 15.0, 5.0), 15.0, stated=vague)
    assert not starts.sets.any() and not starts.rejected.any()


def test_short_recordings_are_searched_as_far_as_they_allow():
    late = np.where(np.arange(VIEWS) == 4, 0.3, 0.0)
    assert starts_of(walk(late, 60.0, 1.6), 60.0).sets.tolist() == (late * 60).tolist()
    starts = starts_of(walk(late, 30.0, 1.0), 30.0)
    assert starts.too_short and not starts.sets.any()


LIMBS = ("shoulder elbow wrist", "hip knee", "ankle big_toe heel", "nose neck eye ear")


def with_lasting_errors(people: DelayedPeople, fps: float, seed: int) -> DelayedPeople:
    """Adds errors of 30 px, and as much again in all views alike, that last for half a second.

    The points of one limb share them.
    """
    rng, sets = np.random.default_rng(seed), people.num_sets
    stays = np.exp(-2 / fps)
    for names in LIMBS:
        points = [k for k, n in enumerate(KEYPOINT_NAMES[:25]) if n.split("_", 1)[-1] in names]
        error = rng.normal(0, 30, (VIEWS + 1, 2))
        for t in range(sets):
            error = stays * error + np.sqrt(1 - stays**2) * rng.normal(0, 30, error.shape)
            for c in range(VIEWS):
                people.images[t][c][0][points, :2] += error[c] + error[-1]
    return people


@pytest.mark.parametrize(("seconds", "seed"), [(2.0, 1), (2.0, 2), (2.0, 3), (5.0, 4)])
def test_lasting_errors_do_not_move_cameras_that_are_in_step(seconds, seed):
    people = with_lasting_errors(walk(np.zeros(VIEWS), 15.0, seconds), 15.0, seed)
    starts = starts_of(people, 15.0)
    assert not starts.sets.any() and not starts.in_doubt.any()


def test_one_group_of_joints_moves_no_camera():
    """One view sees arms, 8 sets older, and feet, in step."""
    now, old = (walk(np.where(np.arange(VIEWS) == 2, s, 0.0), 15.0, 3.0) for s in (0, 8 / 15))
    arms = [k for k, n in enumerate(KEYPOINT_NAMES[:25]) if "elbow" in n or "wrist" in n]
    feet = [k for k, n in enumerate(KEYPOINT_NAMES[:25]) if "ankle" in n or "toe" in n]
    hidden = np.setdiff1d(np.arange(25), [*arms, *feet])
    for t in range(now.num_sets):
        now.images[t][2][0][arms] = old.images[t][2][0][arms].copy()
        now.images[t][2][0][hidden, 2] = 0
    starts = starts_of(now, 15.0)
    assert not starts.sets.any() and starts.undetermined[2]


@pytest.mark.parametrize(
    ("odd", "late"), [(0, 6), (3, 0)], ids=["the master, one late", "another camera, in step"]
)
def test_one_camera_of_other_motion_moves_no_other(odd, late):
    """One camera shows the recording backwards."""
    people = walk(np.where(np.arange(VIEWS) == 2, late / 15, 0.0), 15.0, 3.0)
    forth = [row[odd] for row in people.images]
    for row, image in zip(people.images, reversed(forth), strict=True):
        row[odd] = image
    starts = starts_of(people, 15.0)
    right = np.arange(VIEWS) != odd
    assert starts.sets[right].tolist() == np.where(np.arange(VIEWS) == 2, late, 0)[right].tolist()
    assert starts.sets[odd] == 0 and starts.undetermined[odd]
    assert not starts.in_doubt[right].any()


def test_a_late_master_moves_all_others_against_it():
    starts = starts_of(walk(np.where(np.arange(VIEWS) == 0, 8 / 15, 0.0), 15.0, 3.0), 15.0)
    assert starts.sets.tolist() == [0, *[-8] * (VIEWS - 1)] and not any(starts.undetermined)


def test_a_long_slip_is_not_a_start():
    """The images of camera 4 are 3 sets late from the ninth set on."""
    people, late = (walk(np.where(np.arange(VIEWS) == 4, s / 15, 0.0), 15.0, 3.0) for s in (0, 3))
    for t in range(8, people.num_sets):
        people.images[t][4] = late.images[t][4]
    result = moments_of(people, 15.0)
    assert not result.starts.sets.any()
    assert result.slip[:, 4].tolist() == [0] * 8 + [3] * 37


def test_a_statement_outweighs_most_of_the_joints():
    """All points but elbows and wrists of camera 2 are 6 sets older than stated."""
    stated = stated_by_annotation(np.zeros(VIEWS))
    late = np.where(np.arange(VIEWS) == 2, 6 / 15, 0.0)
    people, now = walk(late, 15.0, 3.0), walk(np.zeros(VIEWS), 15.0, 3.0)
    assert starts_of(people, 15.0, stated).rejected.tolist() == (late > 0).tolist()
    arms = [k for k, n in enumerate(KEYPOINT_NAMES[:25]) if "elbow" in n or "wrist" in n]
    for t in range(now.num_sets):
        people.images[t][2][0][arms] = now.images[t][2][0][arms].copy()
    starts = starts_of(people, 15.0, stated)
    assert not starts.rejected.any() and not starts.sets.any()


def test_search_can_be_switched_off():
    people, times = walk(delays(15), 15.0, 2.0), np.arange(30) / 15
    result = find_moments(people, RIG, times, 15.0, people.available, master=0, search=False)
    assert not result.starts.sets.any()


def test_offsets_of_tens_of_milliseconds_are_not_underestimated():
    """With the first paths only, each is 3 to 12 % too small, by up to 3.5 ms."""
    late = np.array([0, 0.03, -0.03, 0.02, -0.02, 0.03])
    people, times = walk(late, 15.0, 3.0), np.arange(45) / 15
    keypoints = np.array([[image[0] for image in row] for row in people.images])
    found = find_offsets(keypoints, np.zeros((45, VIEWS), int), RIG, times)
    assert np.abs(found.offset + late).max() < 0.002
    assert np.sqrt(np.mean(((found.offset + late)[1:] / found.sigma[1:]) ** 2)) < 2


def test_middles_do_not_depend_on_sides():
    person = np.random.default_rng(2).uniform(0.4, 1, (135, 3))
    np.testing.assert_allclose(body_middles(swap_sides(person)), body_middles(person))
    person[2, 2] = 0  # without one shoulder, their middle is unknown
    assert np.isnan(body_middles(person)).any(axis=1).sum() == 1


def aligned_starts(late: np.ndarray, sets: np.ndarray) -> StartTimes:
    none = np.zeros(len(late), bool)
    return StartTimes(late, sets, none, True, 0.1, np.full(len(late), np.nan), none)


def test_images_move_to_their_moments_and_back():
    """The images of camera 1 are two sets old, those of camera 2 one set ahead."""
    starts = aligned_starts(np.array([0, 0.21, -0.1]), np.array([0, 2, -1]))
    images = np.arange(1, 16).reshape(5, 3)
    moved = shift_images(images, starts.sets)
    assert moved[:, 0].tolist() == images[:, 0].tolist()
    assert moved[:, 1].tolist() == [*images[2:, 1], 0, 0]
    assert moved[:, 2].tolist() == [0, *images[:-1, 2]]
    back = shift_images(moved, -starts.sets)
    assert back[:, 1].tolist() == [0, 0, *images[2:, 1]]
    assert back[:, 2].tolist() == [*images[:-1, 2], 0]
    slip = np.zeros((5, 3), int)
    slip[1, 1] = 3  # of the image of set 3
    assert starts.with_slips(slip)[:, 1].tolist() == [2, 2, 2, 5, 2]
    np.testing.assert_allclose(starts.offset, [0, -0.01, 0.0], atol=1e-12)


def test_people_follow_their_images():
    images = [[[np.full((135, 3), t)] for _ in range(2)] for t in range(4)]
    starts = aligned_starts(np.zeros(2), np.array([0, 1]))
    people = AlignedPeople(DelayedPeople(images, np.zeros(2, int)), starts)
    assert people.num_sets == 4
    assert people.people(1, 1)[0, 0, 0] == 2 and not len(people.people(3, 1))


def stated_by_annotation(late: np.ndarray, sigma: float = 0.028) -> StatedStarts:
    """Stated starts of all cameras but the master; NaN = not stated."""
    late = np.r_[np.nan, late[1:]]
    source = ("", *("the annotation",) * (len(late) - 1))
    return StatedStarts(late, np.where(np.isnan(late), np.nan, sigma), source)


def test_stated_starts_align_cameras_that_see_no_motion():
    late = delays(4)
    people = walk(late, 15.0, 3.0, moving=False)
    stated = stated_by_annotation(late + 0.01)
    starts = moments_of(people, 15.0, stated).starts
    assert not starts.in_doubt.any() and not starts.rejected.any()
    assert (starts.sets == stated.sets(1 / 15)).all()
    np.testing.assert_allclose(starts.late[1:], late[1:] + 0.01, atol=1e-9)
    np.testing.assert_allclose(starts.offset_sigma[1:], 0.028)
    assert np.abs(starts.sets / 15 - starts.offset - late)[1:].max() < 0.011


def test_keypoints_correct_a_slightly_wrong_statement():
    """The master's own statement is wrong by a set and a third, and so are all the others."""
    late = delays(7, 0.8)
    result = moments_of(walk(late, 15.0, 3.0), 15.0, stated_by_annotation(late + 0.088))
    assert not result.starts.rejected.any() and not result.slips.intervals
    np.testing.assert_allclose(result.slip.mean(0) / 15 - result.timing.offset, late, atol=0.004)


def test_stated_start_may_lie_beyond_the_search_range():
    """A delay of more than half of the recording."""
    late = np.zeros(VIEWS)
    late[2] = 0.55 * 4.0
    starts = starts_of(walk(late, 15.0, 4.0), 15.0, stated_by_annotation(late + 0.01))
    assert starts.apart and not starts.in_doubt.any() and not starts.rejected.any()
    assert np.abs(starts.late - late).max() < 0.03


@pytest.mark.parametrize(
    ("fps", "wrong"),
    [(15.0, 0.4), pytest.param(30.0, -0.4, marks=FULL), pytest.param(60.0, 0.4, marks=FULL)],
)
def test_keypoints_of_a_walker_reject_a_wrong_statement(fps, wrong):
    late = delays(6, 0.8)
    stated = stated_by_annotation(late + wrong * (np.arange(VIEWS) == 2))
    result = moments_of(walk(late, fps, 4.0), fps, stated)
    starts = result.starts
    assert np.flatnonzero(starts.rejected).tolist() == [2] and np.isnan(starts.sigma[2])
    assert np.abs(starts.late - late).max() < 0.5 / fps + 0.02

    def note(c: int) -> str:
        offset = result.timing.offset[c]
        return describe_stated_start(stated, starts, result.slips, c, offset, 0.002)

    assert note(2).startswith("the annotation states") and "contradict" in note(2)
    assert f"{abs(late[2] + wrong):.3f} s" in note(2)
    for c in (1, 3, 4, 5):
        assert "according to the annotation and the keypoints" in note(c)


def test_offsets_reject_a_precise_but_wrong_statement():
    """Stated to a millisecond and wrong by 20 ms: less than a set, so only offsets reveal it."""
    people = walk(np.zeros(VIEWS), 15.0, 4.0)
    result = moments_of(people, 15.0, stated_by_annotation(np.array([0, 0.02, 0, 0, 0, 0]), 0.001))
    assert np.flatnonzero(result.starts.rejected).tolist() == [1]
    late = result.slip.mean(0) / 15 - result.timing.offset
    assert np.abs(late).max() < 0.004
    assert np.abs(result.starts.offset - result.timing.offset)[1] < 1e-9


def test_keypoints_align_cameras_without_a_statement():
    late = np.r_[0.0, 0.7, -0.6, 0.5, -0.4, 0.3]
    stated = stated_by_annotation(np.where(np.arange(VIEWS) < 3, late, np.nan))
    starts = starts_of(walk(late, 15.0, 4.0), 15.0, stated)
    assert not starts.in_doubt.any() and np.abs(starts.late - late).max() < 0.5 / 15
    starts = starts_of(walk(late, 15.0, 4.0, moving=False), 15.0, stated)
    assert starts.apart and starts.in_doubt.tolist() == [False] * 3 + [True] * 3


def test_stated_starts_are_relative_to_the_times_of_the_files():
    """k2 began to record 2 s after k1; the times of its file say 0.5 s."""
    names = ["k1", "k2", "k3"]
    seconds = {"k1": (100.0, 0.03), "k2": (102.0, 0.04)}
    stated = StatedStarts.of(seconds, names, 0, np.array([0.0, 0.5, 0.0]), "the annotation")
    np.testing.assert_allclose(stated.late, [np.nan, -1.5, np.nan])
    np.testing.assert_allclose(stated.sigma, [np.nan, 0.05, np.nan])
    assert stated.sets(0.1).tolist() == [0, -15, 0] and stated.states_apart(0.1)
    assert describe_start(stated.late[1]) == "1.500 s later than its times say"
    with pytest.raises(UserError, match=r"annotation states that camera k2 started 1\.500 s later"):
        stated.check_common(np.array([0, 1.6]), names)
    stated.check_common(np.array([0, 3.0]), names)


def test_two_sources_are_combined_unless_they_disagree():
    nan = np.nan
    first = StatedStarts(
        np.array([nan, 0.5, 0.5, nan]), np.array([nan, 0.02, 0.02, nan]), ("", *"aa", "")
    )
    other = StatedStarts(
        np.array([nan, 0.53, 0.9, 0.1]), np.array([nan, 0.01, 0.01, 0.01]), ("", *"bbb")
    )
    both, disagreements = first.combine(other)
    np.testing.assert_allclose(both.late, [nan, 0.524, 0.5, 0.1])
    np.testing.assert_allclose(both.sigma, [nan, 0.02 / 5**0.5, 0.02, 0.01])
    assert both.source == ("", "a and b", "a", "b")
    assert [bool(text) for text in disagreements] == [False, False, True, False]
