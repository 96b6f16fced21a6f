"""Whole bodies and limbs with left and right exchanged, in some or in all views."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.body.keypoints import PARTNER
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.person.left_right import find_mirrored, make_views_agree
from intercap_core.person.sides import ARMS, HANDS, LEGS, LIMBS, swap_sides
from intercap_core.person.subject_joints import triangulate_people
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import seen_by, stick_person, walking

RIG, UP = ring()
SETS = 14
TIMES = np.arange(SETS) / 15
TRUTH = walking(SETS, np.array([-0.2, 0.1]), np.array([0.01, 0.0]))
ALL = np.concatenate(LIMBS)


@pytest.fixture(scope="module")
def clean() -> np.ndarray:
    keypoints = seen_by(TRUTH, RIG, UP)
    keypoints[..., :2] += np.random.default_rng(0).normal(0, 2, keypoints[..., :2].shape)
    return keypoints


def corrected(damaged: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints with corrected sides, and errors (T * 135,) of the points, metres."""
    fixed, points = triangulate_people(damaged, RIG, TIMES, min_confidence=0.3, max_error_px=20)
    true = apply(invert(UP), TRUTH.reshape(-1, 3))
    return fixed, np.linalg.norm(points.points - true, axis=1)


SIX = slice(4, 10)


@pytest.mark.parametrize(
    "exchanges",
    [
        [(SIX, (0, 2, 4), ALL)],  # three views against three
        [(SIX, (0, 2, 3, 4), ALL)],
        [(slice(None), (0, 2, 3, 4), ALL)],  # the person is seen from behind by most cameras
        [(SIX, range(6), ALL)],
        [(slice(0, 5), range(6), ALL)],  # from the beginning on
        [(slice(0, 11), range(6), ALL)],  # most of the time
        [(SIX, range(6), LEGS)],
        [(SIX, range(6), HANDS)],
        [(SIX, (2,), np.r_[ARMS, LEGS]), (slice(3, 9), (4,), LEGS), (slice(8, 12), (0,), HANDS)],
    ],
)
def test_exchanged_people_and_limbs_are_put_back(clean, exchanges):
    damaged = clean.copy()
    for sets, views, limb in exchanges:
        for c in views:
            damaged[sets, c, limb] = swap_sides(damaged[sets, c])[:, limb]
    fixed, error = corrected(damaged)
    np.testing.assert_array_equal(fixed[:, :, ALL], clean[:, :, ALL])
    assert error.max() < 0.03


@pytest.mark.parametrize("views", [(0, 2, 3, 4), (0, 1, 2, 3, 4), range(6)])
def test_views_from_behind_have_the_right_sides_without_a_face(clean, views):
    """The detector takes backs for fronts, and reports no face in these views."""
    damaged = clean.copy()
    for c in views:
        damaged[:, c, ALL] = swap_sides(damaged[:, c])[:, ALL]
        damaged[:, c, 67:, 2] = damaged[:, c, [0, 15, 16], 2] = 0
    _, error = corrected(damaged)
    limbs = np.r_[ARMS, LEGS, HANDS]  # the ears alone do not tell their sides
    assert np.nanmax(error.reshape(SETS, 135)[:, limbs]) < 0.03


def test_partners_are_an_involution():
    np.testing.assert_array_equal(PARTNER[PARTNER], np.arange(135))
    for limb in LIMBS:
        np.testing.assert_array_equal(np.sort(PARTNER[limb]), np.sort(limb))
        assert (PARTNER[limb] != limb).all()


def test_two_contradicting_views_are_corrected(clean):
    damaged = np.zeros_like(clean)
    damaged[:, :2] = clean[:, :2]
    damaged[4:10, 1] = swap_sides(damaged[4:10, 1])
    fixed, _ = corrected(damaged)
    limbs = np.r_[ARMS, LEGS, HANDS]  # two views cannot tell four points of a head apart
    np.testing.assert_array_equal(fixed[:, :2][:, :, limbs], clean[:, :2][:, :, limbs])


def test_consistent_views_are_unchanged(clean):
    keypoints = clean.copy()
    assert not make_views_agree(keypoints, RIG, min_confidence=0.3).any()
    np.testing.assert_array_equal(keypoints, clean)
    unseen = np.zeros_like(clean)
    assert not make_views_agree(unseen, RIG, min_confidence=0.3).any()


def test_kneeling_person_does_not_face_backwards():
    """Feet that point backwards are no contradiction: the shin does too."""
    body = stick_person()
    knee = body[[10, 13]].copy()
    ahead = np.array([1.0, 0, 0])
    body[[11, 14]] = knee - 0.42 * ahead
    for heel, big, small, k in ((24, 22, 23, 0), (21, 19, 20, 1)):
        body[heel] = knee[k] - 0.45 * ahead + [0, 0, 0.03]
        body[[big, small]] = knee[k] - 0.6 * ahead - [0, 0, 0.08]
    still = np.repeat(body[None], 3, 0)
    share = np.zeros((3, 3))
    assert not find_mirrored(still, share, np.arange(3) / 15).any()
    turned = still[:, PARTNER]
    assert find_mirrored(turned, share, None).all()


def test_unknown_points_exchange_nothing():
    assert not find_mirrored(np.full((4, 135, 3), np.nan), np.zeros((4, 3)), TIMES[:4]).any()
    assert find_mirrored(np.zeros((0, 135, 3)), np.zeros((0, 3)), TIMES[:0]).shape == (0, 4)
