"""Which of two like things is the object, and a start with everything wrong at once."""

import numpy as np
import pytest

from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.constants import CLUTTER_LOG_RATIO
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.places import Places, Standing
from intercap_core.object_track.tracker import Tracker
from tests.geometry.rigid.conftest import catalogue
from tests.helpers.object_capture import FPS, HarshCapture

HANDLED, APART = np.array([0.0, 0.0, 2.0]), np.array([1.2, 0.0, 2.5])


@pytest.fixture(scope="module")
def bottle() -> ObjectMesh:
    return ObjectMesh.load(catalogue()["bottle"])


def _joints(place: np.ndarray, count: int) -> np.ndarray:
    joints = np.full((count, 135, 3), np.nan)
    joints[:, :25] = place + np.array([0.0, 0.0, 0.05])
    return joints


def test_what_the_person_is_at_or_what_left_is_the_object(bottle):
    standing = [Standing(HANDLED, 1.0), Standing(APART, 1.0)]
    places = Places(bottle, standing, _joints(HANDLED, 20))
    assert places.prior(3, HANDLED) == 1.0 and places.prior(3, APART) == 0.1
    elsewhere = np.array([-1.0, 0.0, 3.0])
    assert 0.1 < places.prior(3, elsewhere) < 1.0  # something new there moves
    left = Places(bottle, [Standing(HANDLED, 1.0), Standing(APART, 0.4)], None)
    assert left.prior(3, APART) > left.prior(3, HANDLED)
    places.claim(APART)
    assert places.prior(3, APART) > 0.5


def test_what_is_seen_while_the_object_is_given_elsewhere_is_another(bottle):
    places = Places(bottle, [], _joints(HANDLED, 20))
    before = places.weigh(3, HANDLED, 20.0, 0.2)
    assert before == 20.0
    places.seen_beside_given(HANDLED + 0.01)
    assert places.weigh(3, HANDLED, 20.0, 0.2) == -CLUTTER_LOG_RATIO
    assert places.weigh(3, HANDLED, -4.0, 0.2) == -4.0 - CLUTTER_LOG_RATIO
    assert places.weigh(3, HANDLED + np.array([0, 0.3, 0]), 20.0, 0.2) > 0
    places.forget_clutter()
    assert places.weigh(3, HANDLED, 20.0, 0.2) == -CLUTTER_LOG_RATIO


def test_a_brief_visit_is_not_being_handled(bottle):
    joints = _joints(HANDLED, 40)
    joints[:2, :25] = APART
    places = Places(bottle, [Standing(APART, 1.0)], joints)
    assert places.prior(3, APART) == 0.1


def test_what_stands_there_while_the_object_is_elsewhere_is_another(bottle):
    twin = Standing(APART, 0.8)
    places = Places(bottle, [twin], _joints(APART, 20))  # the person walks past it
    assert places.prior(3, APART) == 1.0
    places.seen_beside(8, APART, HANDLED, 40.0)
    places.seen_beside(8, APART, HANDLED, 40.0)  # one frame counts once
    places.seen_beside(12, APART, APART + 0.01, 40.0)  # the object itself
    places.seen_beside(14, APART, HANDLED, 5.0)  # it hardly looks like it
    assert places.prior(3, APART) == 1.0
    places.seen_beside(16, APART, HANDLED, 40.0)
    assert places.prior(3, APART) == 0.1


def test_what_is_beside_the_object_in_its_own_place_marks_nothing(bottle):
    """Object and rival on either side of one standing place, which is the object's."""
    standing = Standing(APART, 0.8)
    places = Places(bottle, [standing], _joints(APART, 20))
    aside = np.array([0.07, 0.0, 0.0])
    one, two = APART - aside, APART + aside
    for t in (3, 9, 12):
        places.seen_beside(t, two, one, 40.0)
    assert places.prior(3, APART) == 1.0


def test_what_clutter_looks_like_is_no_evidence_for_the_object_there(bottle):
    """By 6 and 10 nats a thing looks like the bottle while that is elsewhere; then 7 nats there are
    none, and 40 are the bottle, which was put there."""
    places = Places(bottle, [], _joints(APART, 20))
    assert places.weigh(3, APART, 7.0, 0.2) == 7.0
    for t, nats in ((8, 10.0), (8, 9.0), (12, 6.0)):
        places.seen_beside(t, APART, HANDLED, nats)
    assert places.weigh(3, APART + 0.01, 7.0, 0.2) == pytest.approx(7.0 - 8.0)
    assert places.weigh(3, APART, 40.0, 0.2) == pytest.approx(40.0 - 8.0)
    for t in (14, 15, 16):
        places.seen_beside(t, APART, HANDLED, 50.0)  # a twin, perhaps: it keeps most of its nats
    assert places.weigh(3, APART, 40.0, 0.2) == pytest.approx(40.0 - CLUTTER_LOG_RATIO)
    assert places.weigh(3, HANDLED, 7.0, 0.2) == pytest.approx(
        Places(bottle, [], _joints(APART, 20)).weigh(3, HANDLED, 7.0, 0.2)
    )
    places.forget_clutter()
    assert places.weigh(3, APART, 7.0, 0.2) == 7.0


@pytest.mark.parametrize("name", ["tennis_racquet"])
def test_starts_by_itself_beside_a_twin_with_all_that_detectors_do_wrong(name):
    entry = catalogue()[name]
    mesh = ObjectMesh.load(entry)
    capture = HarshCapture(mesh, 4, label=entry.labels[0], still=0.2)
    images = [capture.views(t) for t in range(capture.count)]
    labels = [[[c.label for c in view.candidates] for view in views] for views in images]
    up = capture.master_from_room[:3, 2]

    def tracker(joints):
        return Tracker(
            mesh.simplified(600), images.__getitem__, labels, ObjectTrackSettings(),
            times=np.arange(capture.count) / FPS, labels=entry.labels, up=up, joints=joints,
        )  # fmt: skip

    for frame, true in zip(tracker(capture.joints).run().frames, capture.poses, strict=True):
        pose = frame.fit.pose
        assert not frame.lost
        assert np.linalg.norm(pose[:3, 3] - true[:3, 3]) < 0.02
        assert mesh.symmetry.rotation_error_deg(pose[:3, :3], true[:3, :3]) < 10


def test_frames_with_something_that_moves_are_searched_first(bottle):
    capture = HarshCapture(bottle, 3, label="bottle", missed=(1.0, 1.0))
    observer = Observer(
        bottle, capture.views, [[[]] * 6] * 3, ObjectTrackSettings(), ("bottle",),
        joints=capture.joints,
    )  # fmt: skip
    assert sorted(observer.frames_to_search()) == [0, 1, 2]
    place_prior = [place_prior for _, place_prior in observer.places._standing]
    assert place_prior and max(place_prior) < 0.5, "only the twin is seen, and nobody is there"
