"""What is known beside the images: the place, the upright, an annotation."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.constants import (
    ANNOTATED_LOG_RATIO,
    ANNOTATION_LOG_RATIO,
    UNHANDLED_LOG_RATIO,
    UPRIGHT_LOG_RATIO,
)
from intercap_core.object_track.fit import Fit
from intercap_core.object_track.given_poses import GivenPose
from intercap_core.object_track.places import Places, Standing
from intercap_core.object_track.prior import Prior, things
from intercap_core.object_track.view_report import ViewReport
from tests.geometry.rigid.conftest import catalogue

SHARE = 0.25
HANDLED, TWIN, AWAY = (np.array(p) for p in ([0.0, 0, 2], [1.2, 0, 2.5], [-1.5, 0, 2]))
REPORT = ViewReport(0, 0.9, 0.002, 1.0, 500, 0.95)


@pytest.fixture(scope="module")
def mesh() -> ObjectMesh:
    return ObjectMesh.load(catalogue()["cup"])


def fit(mesh: ObjectMesh, place: np.ndarray, ratio: float, candidate: int, up: int = 1) -> Fit:
    pose = np.diag([1.0, up, up, 1.0])
    pose[:3, 3] = place - pose[:3, :3] @ mesh.centre_of_mass
    view = replace(REPORT, candidate=candidate, log_ratio=ratio / 4)
    return Fit(pose, np.eye(6), (view,) * 4)


def prior_of(mesh: ObjectMesh, up: np.ndarray | None = None) -> Prior:
    joints = np.full((20, 135, 3), np.nan)
    joints[:, :25] = HANDLED
    places = Places(mesh, [Standing(HANDLED, 1.0), Standing(TWIN, 1.0)], joints)
    observer = SimpleNamespace(mesh=mesh, places=places, up=up)
    return Prior(observer, SHARE)  # type: ignore[arg-type]


def test_a_twin_is_worth_its_place_however_well_it_is_seen(mesh: ObjectMesh) -> None:
    held, twin = fit(mesh, HANDLED, 12.0, 0), fit(mesh, TWIN, 60.0, 1)
    found = prior_of(mesh).weigh(3, [held, twin])
    assert found[0] == pytest.approx(12.0)  # the person is at it
    assert found[1] == pytest.approx(np.log(0.1 / 0.9) / SHARE)


def test_what_overlaps_the_twin_is_worth_less_than_the_twin(mesh: ObjectMesh) -> None:
    twin, beside = fit(mesh, TWIN, 60.0, 1), fit(mesh, TWIN + np.array([0.4, 0, 0]), 20.0, 1)
    found = prior_of(mesh).weigh(3, [twin, beside])
    assert found[1] == pytest.approx(found[0] - 40.0)


def test_what_moves_far_from_everybody_needs_more_evidence(mesh: ObjectMesh) -> None:
    found = prior_of(mesh).weigh(3, [fit(mesh, AWAY, 30.0, 2)])
    assert found[0] == pytest.approx(30.0 - 0.9 * UNHANDLED_LOG_RATIO)


def test_upright_and_annotated(mesh: ObjectMesh) -> None:
    up = np.array([0.0, 0.0, 2.0])
    stands, hangs = (fit(mesh, HANDLED, 12.0, n, up=u) for n, u in ((0, 1), (1, -1)))
    prior = prior_of(mesh, up)
    found = prior.weigh(3, [stands, hangs])
    assert found[0] - found[1] == pytest.approx(2 * UPRIGHT_LOG_RATIO)
    prior.given[3] = GivenPose(3, hangs.pose, 0.01, np.radians(5))
    told = prior.weigh(3, [stands, hangs])
    most = ANNOTATED_LOG_RATIO + ANNOTATION_LOG_RATIO
    assert told[1] - found[1] == pytest.approx(most / SHARE)
    assert told[0] - found[0] <= ANNOTATED_LOG_RATIO / SHARE  # turned over: within reach at most
    np.testing.assert_allclose(prior.weigh(4, [stands, hangs]), found)


def test_poses_that_keep_the_same_candidates_are_one_thing(mesh: ObjectMesh) -> None:
    fits = [fit(mesh, HANDLED, r, c) for r, c in ((10.0, 0), (30.0, 1), (20.0, 0), (5.0, -1))]
    number = things(fits)
    assert number[0] == number[2] and len(set(number)) == 3
    assert things([]).shape == (0,)


def test_frames_near_given_poses(mesh):
    prior = prior_of(mesh)
    times = np.arange(20) / 4
    hidden = np.isin(np.arange(20), [2, 9])
    assert not prior.near_given(times, hidden).any()
    prior.given[4] = prior.given[15] = GivenPose(4, np.eye(4), 0.01, 0.1)
    assert np.flatnonzero(prior.near_given(times, hidden)).tolist() == [*range(1, 8)]
    hidden[18] = True
    near = [*range(1, 8), *range(12, 19)]
    assert np.flatnonzero(prior.near_given(times, hidden)).tolist() == near
