"""Contact: the on/off chain, detection from geometry, annotated intervals."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest

from intercap_core.annotation import ContactInterval
from intercap_core.joint.contact.annotated import annotation_evidence, find_issues, hold_exactly
from intercap_core.joint.contact.chain import DwellChain
from intercap_core.joint.contact.detect import (
    RegionMotion,
    contact_probability,
    lasting_error,
)
from intercap_core.joint.contact_estimate import ContactEstimate
from intercap_core.joint.skin import SURFACE_SIGMA
from intercap_core.schemas import CONTACT_REGIONS

FPS = 15.0
TOUCH = DwellChain(0.6, (0.3, 3.0), (0.8, 0.2))

# --- chain


@pytest.mark.parametrize("chain", [DwellChain(0.2, (1.0,), (1.0,)), TOUCH])
def test_posterior_equals_enumeration_of_all_paths(chain):
    evidence = np.array([[1.0], [-2.0], [0.5], [3.0]])
    states = 1 + len(chain.durations)
    start, transition = chain.start(), chain.transition(FPS)
    total, touching = 0.0, np.zeros(4)
    for path in product(range(states), repeat=4):
        on = np.array(path) > 0
        weight = start[path[0]] * np.exp(evidence[on, 0].sum())
        for before, after in pairwise(path):
            weight *= transition[before, after]
        total += weight
        touching += weight * on
    posterior = chain.posterior(evidence, FPS)
    np.testing.assert_allclose(posterior[:, 0], touching / total, rtol=1e-9)


def test_posterior_without_evidence_is_stationary():
    transition = TOUCH.transition(FPS)
    np.testing.assert_allclose(transition.sum(axis=1), 1.0)
    assert (transition >= 0).all()
    posterior = TOUCH.posterior(np.zeros((40, 1)), FPS)
    np.testing.assert_allclose(posterior, 1 - TOUCH.start()[0], rtol=1e-9)


def test_short_dwells_count_and_long_ones_bridge_gaps():
    evidence = np.full((60, 1), -3.0)
    evidence[20:24] = 2.5
    assert (TOUCH.posterior(evidence, FPS)[20:24] > 0.5).all()
    evidence = np.full((60, 1), 3.0)
    evidence[15:45] = 0.0
    assert (TOUCH.posterior(evidence, FPS) > 0.5).all()


# --- detection


def _motion(distance, slip, speed, sigma=0.012) -> RegionMotion:
    distance = np.asarray(distance, float)
    return RegionMotion(
        distance,
        np.broadcast_to(np.asarray(slip, float), distance.shape),
        np.broadcast_to(np.asarray(speed, float), distance.shape),
        np.full_like(distance, sigma),
    )


def test_holding_hand_is_likelier_than_one_that_slides_or_is_far():
    distance, slip = np.tile([0.01, 0.01, 0.35], (30, 1)), np.tile([0.05, 0.9, 0.8], (30, 1))
    probability = contact_probability(_motion(distance, slip, 0.9), FPS)
    assert (probability[:, 0] > 0.9).all() and (probability[:, 2] < 0.1).all()
    assert (probability[:, 0] > probability[:, 1] + 0.3).all()


def test_unknown_object_position_does_not_refute_a_grasp():
    sigma = np.full((60, 1), 0.012)
    sigma[20:50] = 0.5
    motion = replace(_motion(np.zeros((60, 1)), 0.0, 0.0), sigma=sigma)
    assert (contact_probability(motion, FPS) > 0.5).all()


def test_brief_sip_is_detected():
    distance = np.full((30, 1), 0.20)
    distance[10:19, 0] = [0.09, 0.045, 0.001, 0.0, 0.0, 0.0, 0.0, 0.05, 0.12]
    probability = contact_probability(_motion(distance, 0.3, 0.05, sigma=0.009), FPS)[:, 0]
    assert (probability[12:17] > 0.5).all()
    assert (probability[:11] < 0.5).all() and (probability[18:] < 0.5).all()


@pytest.mark.parametrize("speed", [1.0, 3.0, 6.0])
def test_object_passed_to_the_other_hand_in_a_swing_is_always_held(speed):
    """Both hands hold for 0.2 s. Hands jump by 20 mm between frames, distances err by 10 mm."""
    rng, (first, last), frames = np.random.default_rng(3), (22, 25), 45
    distance, slip = np.full((frames, 2), 0.25), np.full((frames, 2), speed)
    leaves = [0.02, 0.06, 0.12, 0.18]
    distance[:last, 0], distance[last : last + 4, 0] = 0.0, leaves
    distance[first:, 1], distance[first - 4 : first, 1] = 0.0, leaves[::-1]
    true = distance == 0
    slip[true] = np.abs(rng.normal(0, 0.3, true.sum()))
    distance += np.abs(rng.normal(0, 0.010, distance.shape))
    touches = contact_probability(_motion(distance, slip, speed, sigma=0.015), FPS) > 0.5
    assert touches.any(1).all()
    assert (touches != true).sum() <= 4


def test_depth_in_a_resting_object_touches_and_a_gap_does_not():
    """30 frames 40 mm deep, a pass at 30 mm, and 45 frames three standard deviations away."""
    assert (contact_probability(_motion(np.full((30, 1), -0.04), 0.0, 0.0), FPS) > 0.9).all()
    distance = np.full((30, 1), 0.12)
    distance[14:16] = 0.03
    assert (contact_probability(_motion(distance, 0.5, 0.0), FPS) < 0.5).all()
    motion = _motion(np.full((45, 1), 0.024), 0.0, 0.0, sigma=0.008)
    assert (contact_probability(motion, FPS) < 0.5).all()


def test_lasting_error_sharpens_the_ends_of_a_contact():
    """All distances are 8 mm too small: with this error known, 6 mm are no contact."""
    true = np.concatenate([[0.05, 0.03, 0.014, 0.014], np.zeros(25), [0.014, 0.014, 0.03, 0.05]])
    motion = _motion(true[:, None] - 0.008, 0.0, 0.0, sigma=0.009)
    probability = contact_probability(motion, FPS)[:, 0]
    np.testing.assert_array_equal(probability > 0.5, true == 0.0)


def test_lasting_error_is_the_mean_of_prior_and_measurements():
    motion = _motion(np.full((10, 1), 0.004), 0.0, 0.0, sigma=0.01)
    error, sigma = lasting_error(motion, np.ones((10, 1)), 2.0)
    precision = 5 / SURFACE_SIGMA**2
    np.testing.assert_allclose(error, 0.004 * precision / (precision + 1e4), rtol=1e-9)
    np.testing.assert_allclose(sigma, np.hypot((precision + 1e4) ** -0.5, SURFACE_SIGMA), rtol=1e-9)
    untouched, sigma = lasting_error(motion, np.full((10, 1), 0.4), 2.0)
    assert untouched == 0
    np.testing.assert_allclose(sigma, np.hypot(0.01, SURFACE_SIGMA), rtol=1e-9)


def test_change_of_an_estimate_ignores_unknown_contact():
    shape = (4, len(CONTACT_REGIONS))
    labels = np.full(shape, -1, np.int8)
    unknown, half, none = (
        ContactEstimate(values, labels, values, values)
        for values in (np.full(shape, value) for value in (np.nan, 0.5, 0.0))
    )
    assert unknown.change(unknown) == 0
    assert half.change(none) == 0.5


# --- annotation

REGIONS = ("left_hand", "seat")
UNSEEN = np.zeros(60, bool)
UNSEEN[28:31] = True


def _evidence(*intervals: tuple[str, int, int], uncertainty: int = 5):
    return annotation_evidence(_intervals(intervals), REGIONS, 60, uncertainty)


def _intervals(intervals) -> list[ContactInterval]:
    return [
        ContactInterval(part=part, start=start, end=end, uncertain="both")
        for part, start, end in intervals
    ]


def test_annotation_is_certain_inside_and_undecided_at_its_ends():
    evidence, labels = _evidence(("left_hand", 20, 40))
    assert labels[:, 0].sum() == 20 and labels[:, 1].sum() == 0
    assert evidence[30, 0] > 10 and evidence[5, 0] < -10
    undecided = np.flatnonzero(evidence[:, 0] == 0)
    np.testing.assert_array_equal(undecided, [*range(15, 25), *range(35, 45)])
    assert (evidence[:, 1] < -10).all()
    evidence, _ = _evidence(("left_hand", 20, 40), uncertainty=0)
    np.testing.assert_array_equal(np.abs(evidence), np.abs(evidence[0, 1]))


def test_contact_of_any_part_leaves_unnamed_parts_open():
    evidence, labels = _evidence(("left_hand", 20, 30), ("any", 10, 40))
    assert (labels[:10] == 0).all() and (labels[40:] == 0).all()
    assert (labels[10:40, 1] == -1).all() and (evidence[10:40, 1] == 0).all()
    assert (labels[20:30, 0] == 1).all() and (labels[10:20, 0] == -1).all()
    assert evidence[0, 1] < -5 and evidence[55, 0] < -5 and evidence[25, 0] > 0


def test_middle_of_the_shortest_interval_and_gap_is_certain():
    evidence, _ = _evidence(("left_hand", 20, 21), ("left_hand", 24, 27))
    assert evidence[20, 0] > 10 and evidence[25, 0] > 10
    assert evidence[22, 0] < -10


@pytest.mark.parametrize(
    ("interval", "uncertainty", "touching", "free"),
    [
        ((20, 40), 5, range(23, 37), [*range(0, 21), *range(39, 60)]),
        ((10, 50), 5, range(15, 45), []),
        ((20, 40), 0, range(20, 40), [*range(0, 20), *range(40, 60)]),
    ],
)
def test_distance_moves_an_end_within_the_uncertainty(interval, uncertainty, touching, free):
    """The hand truly touches from frame 23 to 36."""
    distance = np.full((60, 1), 0.2)
    distance[23:37] = 0.0
    given, _ = _evidence(("left_hand", *interval), uncertainty=uncertainty)
    probability = contact_probability(_motion(distance, 0, 0), FPS, given=given[:, :1])[:, 0]
    assert (probability[list(touching)] > 0.5).all()
    assert not (probability[free] > 0.5).any()


@pytest.mark.parametrize(
    ("intervals", "near", "expected"),
    [
        ([("left_hand", 5, 15)], range(0, 60), []),
        ([("left_hand", 5, 5)], range(0, 60), [(range(5, 5), "no frame at 5", False)]),
        ([("left_hand", 5, 15), ("left_hand", 12, 20)], range(0, 60), []),
        ([("left_hand", 5, 15), ("seat", 12, 20), ("any", 0, 30)], range(0, 60), []),
        ([("left_hand", 20, 40)], range(20, 40), []),  # unseen in its interior
        ([("left_hand", 5, 20)], range(0, 12), [(range(12, 20), "left_hand annotated 2.00", True)]),
        ([("any", 33, 40)], range(0, 35), [(range(35, 40), "any annotated 2.00 m from", True)]),
        ([("left_hand", 28, 31)], range(0, 0), []),  # far, but unseen
    ],
)  # fmt: skip
def test_implausible_annotations_name_frames_and_part(intervals, near, expected):
    distance = np.full((60, 2), 2.0)
    distance[list(near)] = 0.0
    evidence, labels = _evidence(*intervals, uncertainty=0)
    # the fit agrees with what is stated free
    detected = np.where(evidence < 0, 0.0, distance < 1.0)
    issues = find_issues(_intervals(intervals), REGIONS, evidence, detected, distance, UNSEEN)
    assert np.isfinite(evidence).all() and np.isin(labels, (-1, 0, 1)).all()
    assert [(i.frames, i.distrusted) for i in issues] == [(f, d) for f, _, d in expected]
    for issue, (_, text, _) in zip(issues, expected, strict=True):
        assert text in issue.text


def _exact(*intervals: tuple[str, int, int]) -> list[ContactInterval]:
    return [ContactInterval(part=part, start=start, end=end) for part, start, end in intervals]


@pytest.mark.parametrize("interval", [(20, 40), (30, 31), (0, 60), (59, 60)])
@pytest.mark.parametrize("touching", [range(0), range(60), range(23, 37)])
def test_an_exact_statement_holds_in_every_frame(interval, touching):
    """Whatever distance and slip show, also for an interval of one frame."""
    distance = np.full((60, 2), 0.2)
    distance[list(touching)] = 0.0
    given, labels = annotation_evidence(_exact(("left_hand", *interval)), REGIONS, 60, 5)
    found = contact_probability(_motion(distance, 0, 0), FPS, given=given)
    np.testing.assert_array_equal(hold_exactly(found, given), labels)
    assert labels[:, 0].sum() == interval[1] - interval[0]


@pytest.mark.parametrize(
    ("uncertain", "open_"),
    [("start", range(15, 25)), ("end", range(35, 45)), (None, range(0))],
)
def test_only_the_marked_end_is_uncertain(uncertain, open_):
    interval = ContactInterval(part="left_hand", start=20, end=40, uncertain=uncertain)
    evidence, _ = annotation_evidence([interval], REGIONS, 60, 5)
    np.testing.assert_array_equal(np.flatnonzero(evidence[:, 0] == 0), open_)
    assert (evidence[:, 1] < 0).all()


def test_an_exact_end_prevails_over_an_uncertain_one_at_the_same_frame():
    intervals = [
        ContactInterval(part="any", start=20, end=40, uncertain="both"),
        *_exact(("left_hand", 20, 40)),
    ]
    evidence, _ = annotation_evidence(intervals, REGIONS, 60, 5)
    assert (evidence[:, 0] != 0).all()
    assert (evidence[15:45, 1] == 0).all()


def test_contradictions_are_named_by_interval_in_both_directions():
    """The hand is stated to touch where the fit is free, and to be free where the fit touches."""
    intervals = _exact(("left_hand", 10, 20), ("left_hand", 40, 50))
    evidence, _ = annotation_evidence(intervals, REGIONS, 60, 5)
    distance = np.full((60, 2), 0.04)
    distance[25:28, 0] = 0.0
    detected = np.where(distance < 0.01, 0.99, 0.01)
    detected[40:50, 0] = 0.5  # undecided: no contradiction
    issues = find_issues(intervals, REGIONS, evidence, detected, distance, np.zeros(60, bool))
    assert [(i.frames, i.distrusted) for i in issues] == [
        (range(10, 20), True),
        (range(25, 28), True),
    ]
    assert "left_hand annotated 0.04 m from the object or more" in issues[0].text
    assert "left_hand annotated as free" in issues[1].text
