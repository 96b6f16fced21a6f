"""Who of several people is the subject: named, by what they touch, by build after an absence."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.annotation import SubjectPoint
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.geometry.camera.masks import encode
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.geometry.camera.triangulation import reproject
from intercap_core.person.groups import PersonGroup
from intercap_core.person.subject import SubjectDetections, find_subject
from intercap_core.person.subject_hints import named_people, touch_test
from intercap_core.person.tracks import PersonTrack, same_build
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import seen_by, walking, write_detections

RIG, UP = ring()
SETS, FPS = 30, 15.0
VIEWS = len(RIG)
MIDDLE, ASIDE = np.array([-0.1, 0.1]), np.array([0.9, 0.7])


def people_of(*walks: np.ndarray, absent: tuple[slice, ...] = ()) -> list:
    """What a detector says of walks (T, 135, 3), in their order in every image; 4 px of noise. The
    k-th person is ``absent[k]``."""
    rng = np.random.default_rng(3)
    seen = [seen_by(walk, RIG, UP) for walk in walks]
    for keypoints in seen:
        keypoints[..., :2] += rng.normal(0, 4, keypoints[..., :2].shape)
    gone = [np.zeros(len(seen[0]), bool) for _ in seen]
    for mask, when in zip(gone, absent, strict=False):
        mask[when] = True
    return [
        [
            [keypoints[t, c] for keypoints, away in zip(seen, gone, strict=True) if not away[t]]
            for c in range(VIEWS)
        ]
        for t in range(len(seen[0]))
    ]


def detections_of(tmp_path, people, candidates=None) -> Detections:
    path = write_detections(tmp_path / "detections.h5", RIG, people, candidates)
    return Detections.load(path)


def subject_of(detections: Detections, **given) -> SubjectDetections:
    times = np.arange(detections.num_sets) / FPS
    return find_subject(detections, RIG, times, min_confidence=0.3, **given)


def ball(points_up: np.ndarray) -> dict:
    """Masks labelled as a ball, 12 px in radius, round a point (T, 3) z up, in every image."""
    pixels = reproject(apply(invert(UP), points_up), RIG)  # (T, C, 2)
    found = {}
    for t, c in np.ndindex(pixels.shape[:2]):
        camera = RIG[c].colour
        y, x = np.mgrid[: camera.height, : camera.width]
        at = pixels[t, c]
        found[t, c] = [("ball", encode((x - at[0]) ** 2 + (y - at[1]) ** 2 < 12**2))]
    return found


def test_a_person_alone_is_alone(tmp_path):
    found = subject_of(detections_of(tmp_path, people_of(walking(SETS, MIDDLE, np.zeros(2)))))
    assert found.chosen_by == "alone" and not found.doubts
    assert (found.people == 0).all() and not found.others.any()


def test_person_who_touches_the_object_is_the_subject(tmp_path):
    """Both are seen alike, and the other one is nearer the middle."""
    sets = 8
    walks = [walking(sets, place, np.zeros(2)) for place in (MIDDLE, ASIDE)]
    held = walks[1][:, 25]  # the left hand's wrist
    detections = detections_of(tmp_path, people_of(*walks), ball(held))
    plain = subject_of(detections)
    assert (plain.people == 0).all() and plain.chosen_by == "middle"
    assert len(plain.doubts) == 1 and "another person" in plain.doubts[0]
    found = subject_of(detections, touches=touch_test(detections, ("ball",), min_confidence=0.3))
    assert (found.people == 1).all() and found.chosen_by == "handling"
    assert not found.doubts and (found.others == 1).all()
    of_another = touch_test(detections, ("cup",), min_confidence=0.3)
    assert of_another(0, 0, 1) is None  # no candidate has the object's label
    assert subject_of(detections, touches=of_another).chosen_by == "middle"


def with_other_in(own: list, other: list, cameras: tuple[int, ...], when: slice) -> list:
    """One person an image: ``other`` in some ``cameras`` as long as ``when`` says, else ``own``."""
    wrong = np.zeros((len(own), VIEWS), bool)
    wrong[when, list(cameras)] = True
    return [[(other if wrong[t, c] else own)[t][c] for c in range(VIEWS)] for t in range(len(own))]


@pytest.mark.parametrize(
    ("cameras", "when"),
    [
        ((2,), slice(14, 15)),
        ((2,), slice(8, 20)),
        ((2,), slice(0, 12)),
        ((2,), slice(0, SETS)),
        ((1, 4), slice(8, 20)),  # which agree on whom they see
    ],
    ids=["one frame", "a while", "from the start on", "always", "two cameras"],
)
def test_camera_loses_only_the_frames_with_another_person(tmp_path, cameras, when):
    """A detector of one person an image, which takes somebody else nearer to the camera."""
    own, other = (people_of(walking(SETS, at, np.zeros(2))) for at in (MIDDLE, ASIDE))
    found = subject_of(detections_of(tmp_path, with_other_in(own, other, cameras, when)))
    expected = np.zeros((SETS, VIEWS), int)
    expected[when, list(cameras)] = -1
    np.testing.assert_array_equal(found.people, expected)
    assert not found.doubts


def point_on(people: list, person: int, t: int, c: int, **change) -> SubjectPoint:
    x, y = people[t][c][person][8, :2]
    values = {"camera": RIG.names[c], "frame": t, "x": x + 6, "y": y - 8} | change
    return SubjectPoint.model_validate(values)


def test_named_person_is_the_subject(tmp_path):
    people = people_of(*(walking(SETS, place, np.zeros(2)) for place in (MIDDLE, ASIDE)))
    detections = detections_of(tmp_path, people)
    image_of = np.tile(np.arange(SETS)[:, None], VIEWS)
    image_of[:3, 2] = -1
    image_of[3:, 2] -= 3  # this camera is three sets late
    shown = detections.showing(image_of)
    for person in (0, 1):
        named = named_people([point_on(people, person, 12, 2)], shown, image_of, min_confidence=0.3)
        assert [(one.t, one.c, one.index) for one in named] == [(15, 2, person)]
        still = named_people(
            [point_on(people, person, 12, 1)],
            detections,
            np.tile(np.arange(SETS)[:, None], VIEWS),
            min_confidence=0.3,
        )
        found = subject_of(detections, named=still)
        assert (found.people == person).all()
        assert found.chosen_by == "named" and not found.doubts


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"camera": "k9"}, "subject[0] names camera 'k9'; the recording has"),
        ({"frame": 40}, "frame 40, which has no image"),
        ({"x": 5000.0}, "is at x 5000"),
        ({"x": 3.0, "y": 3.0}, "where nobody was detected; there are people at ("),
    ],
)
def test_point_without_a_person_reports_people_nearby(tmp_path, change, said):
    people = people_of(*(walking(SETS, place, np.zeros(2)) for place in (MIDDLE, ASIDE)))
    detections = detections_of(tmp_path, people)
    image_of = np.tile(np.arange(SETS)[:, None], VIEWS)
    with pytest.raises(UserError) as error:
        named_people(
            [point_on(people, 0, 4, 1, **change)], detections, image_of, min_confidence=0.3
        )
    assert said in str(error.value) and "sequence test" in str(error.value)


def test_points_on_two_people_at_once_are_refused(tmp_path):
    people = people_of(*(walking(SETS, place, np.zeros(2)) for place in (MIDDLE, ASIDE)))
    detections = detections_of(tmp_path, people)
    image_of = np.tile(np.arange(SETS)[:, None], VIEWS)
    points = [point_on(people, 0, 4, 1), point_on(people, 1, 20, 3)]
    named = named_people(points, detections, image_of, min_confidence=0.3)
    with pytest.raises(UserError, match=r"subject\[0\] and subject\[1\] name two people"):
        subject_of(detections, named=named)


SECONDS_AWAY = slice(30, 75)


def leaving(size: float) -> list:
    """Somebody who is away for three seconds; another person, ``size`` times as large, comes while
    they are away, stays, and is nearer the middle."""
    own = walking(105, MIDDLE, np.zeros(2))
    own[75:] += np.array([0.5, -0.6, 0])
    other = walking(105, np.array([0.5, 0.5]), np.zeros(2), size=size)
    return people_of(own, other, absent=(SECONDS_AWAY, slice(0, 50)))


@pytest.mark.parametrize("size", [0.93, 1.07])
def test_person_who_returns_is_recognised_by_build(tmp_path, size):
    found = subject_of(detections_of(tmp_path, leaving(size)))
    assert (found.people[:30] == 0).all() and (found.people[75:] == 0).all()
    assert (found.people[SECONDS_AWAY] == -1).all()


def test_person_who_leaves_is_not_one_who_stays(tmp_path):
    """Of another build, seen only while the subject is away."""
    own = walking(105, MIDDLE, np.zeros(2))
    other = walking(105, ASIDE, np.zeros(2), size=0.9)
    people = people_of(own, other, absent=(slice(60, 105), slice(0, 80)))
    found = subject_of(detections_of(tmp_path, people))
    assert (found.people[:60] == 0).all() and (found.people[60:] == -1).all()


def test_uncertain_return_is_reported(tmp_path):
    """Seen for three sets only before and after: nothing is known of the build."""
    people = people_of(walking(60, MIDDLE, np.zeros(2)), absent=(slice(4, 56),))
    found = subject_of(detections_of(tmp_path, people))
    assert (found.people[:4] == 0).all() and (found.people[56:] == 0).all()
    assert len(found.doubts) == 1 and "from frame 56 on" in found.doubts[0]
    image_of = np.tile(np.arange(60)[:, None], VIEWS)
    detections = detections_of(tmp_path, people)
    named = named_people(
        [point_on(people, 0, 2, 1), point_on(people, 0, 57, 1)],
        detections,
        image_of,
        min_confidence=0.3,
    )
    assert not subject_of(detections, named=named).doubts


def track_of(size: float, sets: int, noise_m: float, seed: int) -> PersonTrack:
    rng = np.random.default_rng(seed)
    points = walking(sets, MIDDLE, np.zeros(2), size=size)[:, :25]
    points = points + rng.normal(0, noise_m, points.shape)
    members = np.zeros(VIEWS, np.int32)
    groups = [PersonGroup(members, one, 1.0, np.zeros(VIEWS)) for one in points]
    return PersonTrack(list(range(sets)), groups)


def test_build_is_more_certain_with_more_frames():
    own = track_of(1.0, 60, 0.02, 1)
    assert same_build(own, track_of(1.0, 60, 0.02, 2)) > 1
    other = [same_build(own, track_of(0.88, sets, 0.02, 3)) for sets in (4, 10, 60)]
    assert other[0] == 0 > other[1] > other[2]
