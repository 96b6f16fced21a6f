"""The subject among several people: by place, contact, name, and build after an absence."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.annotation import SubjectPoint
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.geometry.camera.masks import encode
from intercap_core.geometry.camera.rig import ring_centre
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import reproject
from intercap_core.person.groups import PersonGroup
from intercap_core.person.sides import swap_sides
from intercap_core.person.subject import NamedDetection, SubjectDetections, find_subject
from intercap_core.person.subject_hints import named_people, touch_test
from intercap_core.person.tracks import PersonTrack, join_tracks, same_build
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import seen_by, walking, write_detections

RIG, UP = ring()
SETS, FPS = 30, 15.0
VIEWS = len(RIG)
MIDDLE, ASIDE = np.array([-0.1, 0.1]), np.array([0.9, 0.7])
STILL = np.zeros(2)


def observed(walk: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Keypoints (T, C, 135, 3) of a walk (T, 135, 3) with 4 px of noise."""
    keypoints = seen_by(walk, RIG, UP)
    keypoints[..., :2] += rng.normal(0, 4, keypoints[..., :2].shape)
    return keypoints


def people_of(*walks: np.ndarray, absent: tuple[slice, ...] = ()) -> list:
    """Detections [T][C] of walks (T, 135, 3), in their order; person k is absent in
    ``absent[k]``."""
    present = np.ones((len(walks), len(walks[0])), bool)
    for mask, when in zip(present, absent, strict=False):
        mask[when] = False
    rng = np.random.default_rng(3)
    seen = [observed(walk, rng) for walk in walks]
    return [
        [
            [keypoints[t, c] for keypoints, shown in zip(seen, present, strict=True) if shown[t]]
            for c in range(VIEWS)
        ]
        for t in range(len(walks[0]))
    ]


def shuffled(people: list, first: np.ndarray) -> list:
    """The people of image (t, c) with person ``first[t, c]`` of two at the front."""
    return [
        [own if not first[t, c] else own[::-1] for c, own in enumerate(row)]
        for t, row in enumerate(people)
    ]


def nobody(sets: int) -> list:
    return [[[] for _ in range(VIEWS)] for _ in range(sets)]


def detections_of(tmp_path, people, candidates=None) -> Detections:
    path = write_detections(tmp_path / "detections.h5", RIG, people, candidates)
    return Detections.load(path)


def subject_of(detections: Detections, **given) -> SubjectDetections:
    times = np.arange(detections.num_sets) / FPS
    return find_subject(detections, RIG, times, min_confidence=0.3, **given)


def index_of(tmp_path, people) -> np.ndarray:
    return subject_of(detections_of(tmp_path, people)).people


# --- by place ------------------------------------------------------------------------------------


def test_centre_of_the_ring_is_where_the_cameras_look():
    np.testing.assert_allclose(apply(UP, ring_centre(RIG)[None])[0], [0, 0, 0.8], atol=1e-6)


def test_single_person_is_the_subject_also_with_sides_exchanged(tmp_path):
    people = people_of(walking(SETS, MIDDLE, STILL))
    for row in people:
        row[2] = [swap_sides(row[2][0])]
    subject = subject_of(detections_of(tmp_path, people))
    assert subject.chosen_by == "alone" and not subject.doubts
    assert (subject.people == 0).all() and not subject.others.any()


def test_person_at_the_centre_is_found_in_any_order(tmp_path):
    walks = walking(SETS, MIDDLE, np.array([0.01, 0])), walking(SETS, ASIDE, np.array([0, -0.02]))
    order = (np.arange(SETS)[:, None] + np.arange(VIEWS)) % 2
    people = shuffled(people_of(*walks), order)
    people[4][3] = []
    expected = order.copy()
    expected[4, 3] = -1
    np.testing.assert_array_equal(index_of(tmp_path, people), expected)


def test_single_view_is_bridged_by_earlier_points(tmp_path):
    people = people_of(walking(SETS, ASIDE, STILL), walking(SETS, MIDDLE, STILL))
    people[5][1:] = nobody(1)[0][1:]
    np.testing.assert_array_equal(index_of(tmp_path, people)[5], [1, -1, -1, -1, -1, -1])


def test_person_is_followed_whichever_points_are_seen(tmp_path):
    """Upper body and knees, then hips and legs, in turn: the centre of the points jumps."""
    people = people_of(walking(SETS, MIDDLE, STILL))
    legs = [*range(8, 15), *range(19, 25)]
    for t, c in np.ndindex(SETS, VIEWS):
        hidden = np.setdiff1d(range(25), legs) if t % 2 else [11, 14, *range(19, 25)]
        people[t][c][0][hidden] = 0
    assert (index_of(tmp_path, people) == 0).all()


def test_brief_visitor_at_the_centre_is_not_the_subject(tmp_path):
    walks = walking(SETS, ASIDE, STILL), walking(SETS, STILL, STILL)
    people = shuffled(
        people_of(*walks, absent=(slice(0, 0), np.arange(SETS) != 7)), np.ones((SETS, VIEWS))
    )
    expected = (np.arange(SETS) == 7)[:, None] * np.ones(VIEWS)
    np.testing.assert_array_equal(index_of(tmp_path, people), expected)


def test_detections_of_single_views_are_nobody(tmp_path):
    rng, sure = np.random.default_rng(1), np.full(135, 0.9)
    people = [
        [[np.column_stack([rng.uniform(0, 1000, (135, 2)), sure])] for _ in range(VIEWS)]
        for _ in range(12)
    ]
    assert (index_of(tmp_path, people) == -1).mean() > 0.9
    assert (index_of(tmp_path, nobody(12)) == -1).all()


@pytest.mark.parametrize(
    ("cameras", "when"),
    [
        ((2,), slice(14, 15)),
        ((2,), slice(8, 20)),
        ((2,), slice(0, 12)),
        ((2,), slice(0, SETS)),
        ((1, 4), slice(8, 20)),  # which agree on the other person
    ],
    ids=["one frame", "a while", "from the start on", "always", "two cameras"],
)
def test_camera_loses_only_the_frames_with_another_person(tmp_path, cameras, when):
    """The detector returns one person an image, for a while another one nearer to the camera."""
    people, other = (people_of(walking(SETS, at, STILL)) for at in (MIDDLE, ASIDE))
    expected = np.zeros((SETS, VIEWS), int)
    expected[when, list(cameras)] = -1
    for t, c in np.argwhere(expected < 0):
        people[t][c] = other[t][c]
    subject = subject_of(detections_of(tmp_path, people))
    np.testing.assert_array_equal(subject.people, expected)
    assert not subject.doubts


@pytest.mark.parametrize("apart_m", [0.6, 0.25])
def test_people_who_pass_each_other_are_not_exchanged(tmp_path, apart_m):
    """Both cross the middle, in opposite directions; while they are close a view misses each of
    them three times in twenty, and the order of people is random in every image."""
    sets = 45
    walks = [
        walking(sets, np.array([-0.6, 0.0]), np.array([0.027, 0])),
        walking(sets, np.array([1.1, apart_m]), np.array([-0.045, 0]), turn=-0.02),
    ]
    close = np.linalg.norm(walks[0][:, 8, :2] - walks[1][:, 8, :2], axis=1) < 0.8
    assert close.sum() > 10
    rng = np.random.default_rng(8)
    both = [observed(walk, rng) for walk in walks]
    expected, people = np.full((sets, VIEWS), -1), nobody(sets)
    for t, c in np.ndindex(sets, VIEWS):
        order = [int(i) for i in rng.permutation(2)]
        if close[t] and rng.random() < 0.3:
            order.pop()
        people[t][c] = [both[i][t, c] for i in order]
        expected[t, c] = order.index(0) if 0 in order else -1
    index, seen = index_of(tmp_path, people), expected >= 0
    np.testing.assert_array_equal(index[seen], expected[seen])
    # if a view misses the subject, a person at the same place may be mistaken for it
    assert (index[~seen] >= 0).mean() < 0.5


# --- by contact and by name ----------------------------------------------------------------------


def ball(points_up: np.ndarray) -> dict:
    """Masks labelled as a ball, 12 px in radius, round a point (T, 3) z up, in every image."""
    pixels = reproject(apply(invert(UP), points_up), RIG)  # (T, C, 2)
    y, x = np.mgrid[: RIG[0].colour.height, : RIG[0].colour.width]
    return {
        (t, c): [("ball", encode((x - at[0]) ** 2 + (y - at[1]) ** 2 < 12**2))]
        for t, row in enumerate(pixels)
        for c, at in enumerate(row)
    }


def test_person_who_touches_the_object_is_the_subject(tmp_path):
    """Both are seen alike, and the other one is nearer the middle."""
    walks = [walking(8, place, STILL) for place in (MIDDLE, ASIDE)]
    detections = detections_of(tmp_path, people_of(*walks), ball(walks[1][:, 25]))  # in the hand
    plain = subject_of(detections)
    assert (plain.people == 0).all() and plain.chosen_by == "middle"
    assert len(plain.doubts) == 1 and "another person" in plain.doubts[0]
    subject = subject_of(detections, touches=touch_test(detections, ("ball",), min_confidence=0.3))
    assert (subject.people == 1).all() and subject.chosen_by == "handling"
    assert not subject.doubts and (subject.others == 1).all()
    other_object = touch_test(detections, ("cup",), min_confidence=0.3)
    assert other_object(0, 0, 1) is None  # no candidate has the object's label
    assert subject_of(detections, touches=other_object).chosen_by == "middle"


def name(detections: Detections, people: list, *points, late: int = 0, **change):
    """Detections named by points (person, t, c), each at that person's hips; the images of
    camera 2 are ``late`` sets late."""
    image_of = np.tile(np.arange(len(people))[:, None], VIEWS)
    image_of[:, 2] = np.where(image_of[:, 2] < late, -1, image_of[:, 2] - late)
    named = []
    for person, t, c in points:
        x, y = people[t][c][person][8, :2]
        values = {"camera": RIG.names[c], "frame": t, "x": x + 6, "y": y - 8} | change
        named.append(SubjectPoint.model_validate(values))
    return named_people(named, detections.showing(image_of), image_of, min_confidence=0.3)


@pytest.fixture
def two_people(tmp_path) -> tuple[Detections, list]:
    people = people_of(*(walking(SETS, place, STILL) for place in (MIDDLE, ASIDE)))
    return detections_of(tmp_path, people), people


@pytest.mark.parametrize("person", [0, 1])
def test_named_person_is_the_subject(two_people, person):
    detections, people = two_people
    named = name(detections, people, (person, 12, 2), late=3)
    assert named == [NamedDetection(15, 2, person, "subject[0]")]
    subject = subject_of(detections, named=name(detections, people, (person, 12, 1)))
    assert (subject.people == person).all()
    assert subject.chosen_by == "named" and not subject.doubts


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": "k9"}, "subject[0] names camera 'k9'; the recording has"),
        ({"frame": 40}, "frame 40, which has no image"),
        ({"x": 5000.0}, "is at x 5000"),
        ({"x": 3.0, "y": 3.0}, "where nobody was detected; there are people at ("),
    ],
)
def test_point_without_a_person_reports_people_nearby(two_people, change, message):
    with pytest.raises(UserError) as error:
        name(*two_people, (0, 4, 1), **change)
    assert message in str(error.value) and "sequence test" in str(error.value)


def test_points_on_two_people_at_once_are_refused(two_people):
    named = name(*two_people, (0, 4, 1), (1, 20, 3))
    with pytest.raises(UserError, match=r"subject\[0\] and subject\[1\] name two people"):
        subject_of(two_people[0], named=named)


def hide(people: list, person: int, sets: slice, parts: list[int], cameras=range(VIEWS)) -> None:
    """The detector does not see ``parts`` of a person, in place."""
    for row in people[sets]:
        for c in cameras:
            row[c][person][parts] = 0


UPPER, LOWER = [*range(8), *range(15, 19)], [10, 11, 13, 14, *range(19, 25)]


def test_named_person_is_followed_while_parts_are_hidden(tmp_path):
    """The subject walks behind furniture and shows hips and legs, or hips and trunk, by turns."""
    sets = 36
    people = people_of(walking(sets, MIDDLE, STILL), walking(sets, ASIDE, STILL))
    for first in range(0, sets, 12):
        hide(people, 0, slice(first, first + 6), UPPER)
        hide(people, 0, slice(first + 6, first + 12), LOWER)
    detections = detections_of(tmp_path, people)
    subject = subject_of(detections, named=name(detections, people, (0, 2, 1)))
    assert (subject.people == 0).all() and not subject.doubts


@pytest.mark.parametrize("together", [False, True], ids=["by turns", "at once"])
def test_two_points_on_one_person_join_its_tracks(tmp_path, together):
    """The detector shows legs alone or trunk alone, by turns, or to different cameras at once."""
    sets = 36
    people = people_of(walking(sets, MIDDLE, STILL), walking(sets, ASIDE, STILL))
    for k, part in enumerate(([*UPPER, 8, 9, 12], [*LOWER, 8, 9, 12])):
        if together:
            hide(people, 0, slice(12, sets), part, cameras=[k, k + 2, k + 4])
        else:
            for first in range(4 * k, sets, 8):
                hide(people, 0, slice(first, first + 4), part)
    detections = detections_of(tmp_path, people)
    named = [NamedDetection(14, 0, 0, "subject[0]"), NamedDetection(17, 1, 0, "subject[1]")]
    subject = subject_of(detections, named=named)
    assert (subject.people == 0).mean() > 0.9 and (subject.people != 1).all()


# --- after an absence ----------------------------------------------------------------------------


def test_subject_is_recognised_after_a_second_without_detections(tmp_path):
    """Two people in any order, as a detector without neck and mid hip sees them."""
    sets, gap = 45, slice(15, 30)
    walks = [
        walking(sets, np.array([-0.2, 0.1]), np.array([0.01, 0.005])),
        walking(sets, np.array([1.2, 0.9]), np.array([-0.01, -0.02])),
    ]
    order = np.random.default_rng(7).integers(0, 2, (sets, VIEWS))
    people = shuffled(people_of(*walks), order)
    for t, c in np.ndindex(sets, VIEWS):
        for person in people[t][c]:
            person[[1, 8]] = 0
    people[gap] = nobody(15)
    order[gap] = -1
    np.testing.assert_array_equal(index_of(tmp_path, people), order)


@pytest.mark.parametrize("size", [0.93, 1.07])
def test_person_who_returns_is_recognised_by_build(tmp_path, size):
    """While the subject is away for three seconds another person, ``size`` times as large, comes,
    stays, and is nearer the middle."""
    own, away = walking(105, MIDDLE, STILL), slice(30, 75)
    own[75:] += np.array([0.5, -0.6, 0])
    other = walking(105, np.array([0.5, 0.5]), STILL, size=size)
    index = index_of(tmp_path, people_of(own, other, absent=(away, slice(0, 50))))
    assert (index[:30] == 0).all() and (index[75:] == 0).all() and (index[away] == -1).all()


def test_other_person_who_comes_later_is_not_the_subject(tmp_path):
    """Of another build, seen only while the subject is away."""
    walks = walking(105, MIDDLE, STILL), walking(105, ASIDE, STILL, size=0.9)
    index = index_of(tmp_path, people_of(*walks, absent=(slice(60, 105), slice(0, 80))))
    assert (index[:60] == 0).all() and (index[60:] == -1).all()


def test_uncertain_return_is_reported(tmp_path):
    """Seen in four sets only before and after: the build is unknown."""
    people = people_of(walking(60, MIDDLE, STILL), absent=(slice(4, 56),))
    detections = detections_of(tmp_path, people)
    subject = subject_of(detections)
    assert (subject.people[:4] == 0).all() and (subject.people[56:] == 0).all()
    assert len(subject.doubts) == 1 and "from frame 56 on" in subject.doubts[0]
    named = name(detections, people, (0, 2, 1), (0, 57, 1))
    assert not subject_of(detections, named=named).doubts


def test_tracks_without_a_common_set_are_one_person():
    whole = track_of(1.0, 60, 1)
    groups = whole.groups
    odd, even = (PersonTrack({t: groups[t] for t in range(k, 60, 2)}) for k in (1, 0))
    times = np.arange(60) / FPS
    (person,) = join_tracks([odd, even], times)
    assert list(person.track.groups.items()) == list(groups.items())
    even = PersonTrack({max(t, 1): group for t, group in even.groups.items()})
    assert len(join_tracks([odd, even], times)) == 2


def track_of(size: float, sets: int, seed: int) -> PersonTrack:
    points = walking(sets, MIDDLE, STILL, size=size)[:, :25]
    points = points + np.random.default_rng(seed).normal(0, 0.02, points.shape)
    none = np.zeros(VIEWS)
    groups = [PersonGroup(none.astype(np.int32), body, 1.0, none) for body in points]
    return PersonTrack(dict(enumerate(groups)))


def test_build_is_more_certain_with_more_frames():
    own = track_of(1.0, 60, 1)
    assert same_build(own, track_of(1.0, 60, 2)) > 1
    other = [same_build(own, track_of(0.88, sets, 3)) for sets in (4, 10, 60)]
    assert other[0] == 0 > other[1] > other[2]
