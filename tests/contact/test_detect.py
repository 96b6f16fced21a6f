"""Contact without annotation."""

import numpy as np

from intercap_core.config import ContactInterval
from intercap_core.contact.constants import CHANGES_PER_SECOND, TOUCHING_PRIOR
from intercap_core.contact.detect import (
    RegionMotion,
    annotation_evidence,
    contact_probability,
    smooth,
)

FPS = 15.0


def _motion(distance, slip, speed, sigma=0.012):
    distance = np.asarray(distance, float)
    return RegionMotion(
        distance,
        np.broadcast_to(np.asarray(slip, float), distance.shape),
        np.broadcast_to(np.asarray(speed, float), distance.shape),
        np.full_like(distance, sigma),
    )


def test_a_hand_that_carries_touches_and_the_far_one_does_not():
    distance = np.stack([np.full(30, 0.01), np.full(30, 0.35)], axis=1)
    slip = np.stack([np.full(30, 0.05), np.full(30, 0.8)], axis=1)
    probability = contact_probability(_motion(distance, slip, 0.8), FPS)
    assert (probability[:, 0] > 0.9).all()
    assert (probability[:, 1] < 0.1).all()


def test_a_pass_over_a_resting_object_is_no_contact():
    distance = np.full((30, 1), 0.12)
    distance[14:16] = 0.03
    probability = contact_probability(_motion(distance, 0.5, 0.0), FPS)
    assert (probability < 0.5).all()


def test_a_near_hand_that_lets_a_moving_object_slide_past_is_less_likely_than_one_that_holds():
    distance = np.full((30, 2), 0.015)
    slip = np.stack([np.full(30, 0.05), np.full(30, 0.9)], axis=1)
    probability = contact_probability(_motion(distance, slip, 0.9), FPS)
    assert (probability[:, 0] > probability[:, 1] + 0.3).all()


def test_posterior_equals_enumeration_of_all_paths():
    evidence = np.array([[1.0], [-2.0], [0.5], [3.0]])
    got = smooth(evidence, FPS)
    change = CHANGES_PER_SECOND / FPS
    begin, end = 2 * change * TOUCHING_PRIOR, 2 * change * (1 - TOUCHING_PRIOR)
    transition = np.array([[1 - begin, begin], [end, 1 - end]])
    total, touching = 0.0, np.zeros(4)
    for code in range(16):
        path = [(code >> t) & 1 for t in range(4)]
        weight = TOUCHING_PRIOR if path[0] else 1 - TOUCHING_PRIOR
        for t in range(3):
            weight *= transition[path[t], path[t + 1]]
        weight *= np.exp(sum(evidence[t, 0] for t in range(4) if path[t]))
        total += weight
        touching += weight * np.array(path)
    np.testing.assert_allclose(got[:, 0], touching / total, rtol=1e-9)


def test_annotation_is_certain_inside_and_undecided_at_its_ends():
    intervals = [ContactInterval(part="left_hand", start=20, end=40)]
    evidence, labels = annotation_evidence(intervals, ["left_hand", "seat"], 60)
    assert labels[:, 0].sum() == 20 and labels[:, 1].sum() == 0
    assert evidence[30, 0] > 5 and evidence[5, 0] < -5
    assert abs(evidence[20, 0]) < 1 and abs(evidence[39, 0]) < 1
    assert (evidence[:, 1] < -5).all()


def test_contact_of_an_unnamed_part_rules_out_what_lies_outside_it_alone():
    intervals = [
        ContactInterval(part="left_hand", start=20, end=30),
        ContactInterval(part="any", start=10, end=40),
    ]
    evidence, labels = annotation_evidence(intervals, ["left_hand", "seat"], 60)
    assert (labels[:10] == 0).all() and (labels[40:] == 0).all()
    assert (labels[10:40, 1] == -1).all() and (evidence[10:40, 1] == 0).all()
    assert (labels[20:30, 0] == 1).all() and (labels[10:20, 0] == -1).all()
    assert evidence[0, 1] < -5 and evidence[55, 0] < -5 and evidence[25, 0] > 0


def test_not_knowing_where_the_object_is_does_not_refute_a_grasp():
    sigma = np.full((60, 1), 0.012)
    sigma[20:50] = 0.5
    motion = _motion(np.zeros((60, 1)), 0.0, 0.0)
    motion = RegionMotion(motion.distance, motion.slip, motion.object_speed, sigma)
    assert (contact_probability(motion, FPS) > 0.5).all()


def test_a_hand_deep_in_the_object_touches_it():
    assert (contact_probability(_motion(np.full((30, 1), -0.04), 0.0, 0.0), FPS) > 0.9).all()
