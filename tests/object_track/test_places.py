"""Prior of places and hypotheses, and a start next to a twin of the object."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.decoder import JUMP_COST
from intercap_core.object_track.fit import FittedPose
from intercap_core.object_track.given_poses import GivenPose
from intercap_core.object_track.hypotheses import (
    UPRIGHT_LOG_RATIO,
    Prior,
    group_by_candidates,
)
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.places import (
    OTHER_OBJECT_LOG_RATIO,
    OccupiedPlace,
    Places,
)
from intercap_core.object_track.tracker import Tracker
from intercap_core.object_track.view_report import ViewReport
from tests.geometry.rigid.conftest import catalogue
from tests.helpers.object_capture import ObjectCapture
from tests.object_track.scenes import (
    FIVE_DEGREES,
    errors_of,
    frames_with,
    mesh_of,
    observer_of,
)

SHARE = 0.25
HANDLED, APART, AWAY = (np.array(p) for p in ([0.0, 0, 2], [1.2, 0, 2.5], [-1.5, 0, 2]))
REPORT = ViewReport(0, 0.9, 500)


@pytest.fixture(scope="module")
def bottle() -> ObjectMesh:
    return ObjectMesh.load(catalogue()["bottle"])


@pytest.fixture(scope="module")
def cup() -> ObjectMesh:
    return ObjectMesh.load(catalogue()["cup"])


def joints_at(place: np.ndarray, count: int = 20) -> np.ndarray:
    joints = np.full((count, 135, 3), np.nan)
    joints[:, :25] = place + np.array([0.0, 0.0, 0.05])
    return joints


def test_the_handled_or_moved_object_is_the_tracked_one(bottle):
    occupied = [OccupiedPlace(HANDLED, 1.0), OccupiedPlace(APART, 1.0)]
    places = Places(bottle, occupied, joints_at(HANDLED))
    assert places.prior(3, HANDLED) == 1.0 and places.prior(3, APART) == 0.1
    assert 0.1 < places.prior(3, np.array([-1.0, 0.0, 3.0])) < 1.0  # a new place: it moved
    unknown = np.full((20, 135, 3), np.nan)
    moved = Places(bottle, [OccupiedPlace(HANDLED, 1.0), OccupiedPlace(APART, 0.4)], unknown)
    assert moved.prior(3, APART) > moved.prior(3, HANDLED)
    places.claim(APART)
    assert places.prior(3, APART) > 0.5
    visit = joints_at(HANDLED, 40)
    visit[:2, :25] = APART  # too brief to be handling
    assert Places(bottle, [OccupiedPlace(APART, 1.0)], visit).prior(3, APART) == 0.1


def test_an_excluded_place_is_never_the_object(bottle):
    places = Places(bottle, [], joints_at(HANDLED))
    assert places.weigh(3, HANDLED, 20.0, 0.2) == 20.0
    places.exclude(HANDLED + 0.01)
    assert places.weigh(3, HANDLED, 20.0, 0.2) == -OTHER_OBJECT_LOG_RATIO
    assert places.weigh(3, HANDLED, -4.0, 0.2) == -4.0 - OTHER_OBJECT_LOG_RATIO
    assert places.weigh(3, HANDLED + np.array([0, 0.3, 0]), 20.0, 0.2) > 0
    places.clear_rivals()
    assert places.weigh(3, HANDLED, 20.0, 0.2) == -OTHER_OBJECT_LOG_RATIO


def test_a_place_occupied_meanwhile_is_another_object(bottle):
    places = Places(bottle, [OccupiedPlace(APART, 0.8)], joints_at(APART))
    assert places.prior(3, APART) == 1.0
    places.add_rival(8, APART, HANDLED, 40.0)
    places.add_rival(8, APART, HANDLED, 40.0)  # one frame counts once
    places.add_rival(12, APART, APART + 0.01, 40.0)  # the object itself
    places.add_rival(14, APART, HANDLED, 5.0)  # little evidence
    aside = np.array([0.07, 0.0, 0.0])
    for t in (15, 17):
        places.add_rival(t, APART + aside, APART - aside, 40.0)  # in its own place
    assert places.prior(3, APART) == 1.0
    places.add_rival(16, APART, HANDLED, 40.0)
    assert places.prior(3, APART) == 0.1


def test_evidence_of_clutter_is_subtracted(bottle):
    """By 6 and 10 nats clutter looks like the bottle while that is elsewhere."""
    places = Places(bottle, [], joints_at(APART))
    elsewhere = places.weigh(3, HANDLED, 7.0, 0.2)
    assert places.weigh(3, APART, 7.0, 0.2) == 7.0
    for t, nats in ((8, 10.0), (8, 9.0), (12, 6.0)):
        places.add_rival(t, APART, HANDLED, nats)
    assert places.weigh(3, APART + 0.01, 7.0, 0.2) == pytest.approx(7.0 - 8.0)
    assert places.weigh(3, APART, 40.0, 0.2) == pytest.approx(40.0 - 8.0)
    for t in (14, 15, 16):
        places.add_rival(t, APART, HANDLED, 50.0)  # may be a twin: it keeps most of its evidence
    assert places.weigh(3, APART, 40.0, 0.2) == pytest.approx(40.0 - OTHER_OBJECT_LOG_RATIO)
    assert places.weigh(3, HANDLED, 7.0, 0.2) == pytest.approx(elsewhere)
    places.clear_rivals()
    assert places.weigh(3, APART, 7.0, 0.2) == 7.0


def fit_of(mesh, place: np.ndarray, ratio: float, candidate: int, up: int = 1) -> FittedPose:
    pose = np.diag([1.0, up, up, 1.0])
    pose[:3, 3] = place - pose[:3, :3] @ mesh.centre_of_mass
    view = replace(REPORT, candidate=candidate, log_ratio=ratio / 4)
    return FittedPose(pose, np.eye(6), (view,) * 4)


def prior_of(mesh: ObjectMesh, up: np.ndarray | None = None) -> Prior:
    occupied = [OccupiedPlace(HANDLED, 1.0), OccupiedPlace(APART, 1.0)]
    places = Places(mesh, occupied, joints_at(HANDLED - [0, 0, 0.05]))
    times = np.arange(20) / 4
    observer = SimpleNamespace(mesh=mesh, places=places, up=up, share=SHARE, times=times)
    return Prior(observer)  # type: ignore[arg-type]


def test_a_twin_weighs_no_more_than_its_place(cup):
    handled, twin = fit_of(cup, HANDLED, 12.0, 0), fit_of(cup, APART, 60.0, 1)
    found = prior_of(cup).weigh(3, [handled, twin])
    assert found[0] == pytest.approx(12.0)  # the person is at it
    assert found[1] == pytest.approx(np.log(0.1 / 0.9) / SHARE)


def test_poses_of_one_candidate_differ_by_their_evidence(cup):
    twin, neighbour = (
        fit_of(cup, APART, 60.0, 1),
        fit_of(cup, APART + np.array([0.4, 0, 0]), 20.0, 1),
    )
    found = prior_of(cup).weigh(3, [twin, neighbour])
    assert found[1] == pytest.approx(found[0] - 40.0)


def test_objects_that_move_far_from_everybody_need_evidence(cup):
    found = prior_of(cup).weigh(3, [fit_of(cup, AWAY, 30.0, 2)])
    assert found[0] == pytest.approx(30.0 - 0.9 * OTHER_OBJECT_LOG_RATIO)


def test_upright_and_annotated_poses_weigh_more(cup):
    stands, hangs = (fit_of(cup, HANDLED, 12.0, n, up=u) for n, u in ((0, 1), (1, -1)))
    prior = prior_of(cup, np.array([0.0, 0.0, 2.0]))
    plain = prior.weigh(3, [stands, hangs])
    assert plain[0] - plain[1] == pytest.approx(2 * UPRIGHT_LOG_RATIO)
    prior.given[3] = GivenPose(3, hangs.pose, 0.01, FIVE_DEGREES)
    annotated = prior.weigh(3, [stands, hangs])
    most = 4 * JUMP_COST
    assert annotated[1] - plain[1] == pytest.approx(most / SHARE)
    assert annotated[0] - plain[0] <= 3 * JUMP_COST / SHARE  # turned over: within reach only
    np.testing.assert_allclose(prior.weigh(4, [stands, hangs]), plain)


def test_hypotheses_are_grouped_by_candidates(cup):
    fits = [fit_of(cup, HANDLED, r, c) for r, c in ((10.0, 0), (30.0, 1), (20.0, 0), (5.0, -1))]
    number = group_by_candidates(fits)
    assert number[0] == number[2] and len(set(number)) == 3
    assert group_by_candidates([]).shape == (0,)


def test_frames_near_annotated_and_hidden_frames(cup):
    prior = prior_of(cup)
    hidden = np.isin(np.arange(20), [2, 9])
    assert not prior.near_annotated(hidden).any()
    prior.given[4] = prior.given[15] = GivenPose(4, np.eye(4), 0.01, 0.1)
    assert np.flatnonzero(prior.near_annotated(hidden)).tolist() == [*range(1, 8)]
    hidden[18] = True
    near = [*range(1, 8), *range(12, 19)]
    assert np.flatnonzero(prior.near_annotated(hidden)).tolist() == near


def twins_of(name: str, missed: Collection[int]) -> tuple[ObjectCapture, Observer]:
    """Three frames of an object at a person's hands, and of its copy a metre away. Detections of
    the object are missing in the views ``missed`` and have wrong labels; those of the copy are
    right."""
    capture = ObjectCapture.make(mesh_of(name), 3, cameras=6, label=catalogue()[name].labels[0])
    capture.twin = capture.poses[0].copy()
    capture.twin[:3, 3] += capture.master_from_room[:3, :3] @ [-0.8, -0.7, 0.0]
    capture.missed = {(t, c) for t in range(3) for c in missed}
    joints = np.full((3, 135, 3), np.nan)
    joints[:, :25] = capture.master_from_room[:3, 3]
    joints[:, [4, 7, *range(25, 67)]] = capture.poses[:, None, :3, 3]
    return capture, observer_of(capture, joints=joints)


def test_a_track_starts_next_to_a_twin_with_better_detections():
    capture, observer = twins_of("tennis_racquet", missed=(1, 4))
    track = Tracker(observer).run()
    assert not frames_with(track, "lost")
    shift, turn = errors_of(capture.mesh, track, capture.poses)
    assert shift.max() < 0.02 and turn.max() < 10


def test_a_twin_with_nobody_near_has_a_low_prior():
    _, observer = twins_of("bottle", missed=range(6))
    assert sorted(observer.frames_to_search()) == [0, 1, 2]
    priors = [place.prior for place in observer.places._standing]
    assert priors and max(priors) < 0.5
