"""Cameras that contradict the others are named with the likely cause, correct ones never."""

from __future__ import annotations

import numpy as np
import pytest

from bench.evaluate.faulty_rigs import faulty_cases
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.scene.camera_agreement import (
    Disagreement,
    find_disagreements,
    widened,
)
from intercap_core.scene.subject_views import find_subject_views
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import DelayedPeople, seen_by, walking

SETS = 24
RIG, UP = ring()
WORDS = {
    "moved": "the camera was moved by about 5 degrees",
    "moved during": "moved during the recording",
    "poses exchanged": "are exchanged",
    "images exchanged": "are exchanged",
    "other session": "another session",
}


def _people(rig: Rig, up: np.ndarray) -> DelayedPeople:
    """A walker with errors of 5 px, and one detection in ten far off."""
    rng = np.random.default_rng(3)
    body = walking(SETS, np.array([-0.6, -0.4]), np.array([0.06, 0.04]), 0.1)
    keypoints = seen_by(body, rig, up).copy()
    keypoints[..., :2] += rng.normal(0, 5.0, keypoints[..., :2].shape)
    off = rng.random(keypoints.shape[:-1]) < 0.1
    keypoints[off, :2] += rng.normal(0, 150.0, (off.sum(), 2))
    people = [[[keypoints[t, c]] for c in range(len(rig))] for t in range(SETS)]
    return DelayedPeople(people, np.zeros(len(rig), int))


def _named(people, rig: Rig) -> list[Disagreement]:
    subject = find_subject_views(people, rig, np.arange(SETS) / 15)
    image_of = np.repeat(np.arange(SETS)[:, None], len(rig), 1)
    return find_disagreements(people, subject, image_of, rig)


@pytest.mark.parametrize("fault", ["none", *WORDS])
def test_faulty_cameras_are_named_with_their_cause(fault: str) -> None:
    cases = {name: rest for name, *rest in faulty_cases(_people(RIG, UP), RIG, 0, seed=1)}
    at_fault, people, rig = cases[fault]
    found = _named(people, rig)
    named = {one.camera for one in found}
    assert named >= at_fault
    if fault != "other session":  # without a majority, every camera is named
        assert named == at_fault
    for one in found:
        assert WORDS[fault] in str(one)
        if fault.startswith("moved"):
            assert one.error_px > 40 > 3 * one.usual_px / 2 and one.error_m > 0.05


def test_images_without_people_name_nobody() -> None:
    nothing = DelayedPeople([[[] for _ in range(len(RIG))] for _ in range(SETS)], np.zeros(6, int))
    assert _named(nothing, RIG) == []


def test_deviation_of_a_named_camera_grows_to_its_error() -> None:
    rng = np.random.default_rng(0)
    root = 1e-3 * rng.normal(size=(42, 60))
    covariance = (root @ root.T).reshape(6, 7, 6, 7)
    wide = widened(covariance, RIG, [Disagreement(2, "", 76.0, 10.0, 0.15)])
    assert np.linalg.eigvalsh(wide.reshape(42, 42)).min() > 0
    np.testing.assert_array_equal(wide[3, :, 4], covariance[3, :, 4])
    np.testing.assert_allclose(
        wide[2, :6, 2, :6] / covariance[2, :6, 2, :6],
        wide[2, 0, 2, 0] / covariance[2, 0, 2, 0],
    )
    draws = rng.multivariate_normal(np.zeros(6), wide[2, :6, 2, :6], 40000)
    arm = ring_centre(RIG) - RIG.master_from_colour[2, :3, 3]
    moved = np.cross(draws[:, :3], arm) + draws[:, 3:]
    assert np.sqrt((moved**2).sum(1).mean()) == pytest.approx(0.15, rel=0.02)
