"""What annotated intervals say, and what is odd about them."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.annotation import ContactInterval
from intercap_core.joint.contact.annotated import annotation_evidence, find_issues
from intercap_core.joint.contact.detect import RegionMotion, contact_probability

FPS = 15.0
REGIONS = ("left_hand", "seat")


def _interval(part: str, start: int, end: int) -> ContactInterval:
    return ContactInterval(part=part, start=start, end=end)


def _probability(distance: np.ndarray, interval: ContactInterval, uncertainty: int) -> np.ndarray:
    given, _ = annotation_evidence([interval], ["left_hand"], len(distance), uncertainty)
    still = np.zeros((len(distance), 1))
    motion = RegionMotion(distance[:, None], still, still, still + 0.012)
    return contact_probability(motion, FPS, given=given)[:, 0]


def test_annotation_is_certain_inside_and_undecided_at_its_ends():
    evidence, labels = annotation_evidence([_interval("left_hand", 20, 40)], REGIONS, 60, 5)
    assert labels[:, 0].sum() == 20 and labels[:, 1].sum() == 0
    assert evidence[30, 0] > 10 and evidence[5, 0] < -10
    undecided = np.flatnonzero(evidence[:, 0] == 0)
    np.testing.assert_array_equal(undecided, [*range(15, 25), *range(35, 45)])
    assert (evidence[:, 1] < -10).all()


def test_contact_of_an_unnamed_part_rules_out_what_lies_outside_it_alone():
    intervals = [_interval("left_hand", 20, 30), _interval("any", 10, 40)]
    evidence, labels = annotation_evidence(intervals, REGIONS, 60, 5)
    assert (labels[:10] == 0).all() and (labels[40:] == 0).all()
    assert (labels[10:40, 1] == -1).all() and (evidence[10:40, 1] == 0).all()
    assert (labels[20:30, 0] == 1).all() and (labels[10:20, 0] == -1).all()
    assert evidence[0, 1] < -5 and evidence[55, 0] < -5 and evidence[25, 0] > 0


def test_the_middle_of_the_shortest_interval_and_gap_is_certain():
    intervals = [_interval("left_hand", 20, 21), _interval("left_hand", 24, 27)]
    evidence, _ = annotation_evidence(intervals, REGIONS, 60, 5)
    assert evidence[20, 0] > 10 and evidence[25, 0] > 10
    assert evidence[22, 0] < -10


def test_without_uncertainty_every_frame_is_certain():
    evidence, _ = annotation_evidence([_interval("left_hand", 20, 40)], REGIONS, 60, 0)
    np.testing.assert_array_equal(np.abs(evidence), np.abs(evidence[0, 1]))


def test_what_is_seen_moves_an_end_within_the_uncertainty_and_no_further():
    """The hand truly touches from frame 23 to 36; the annotator says 20 to 40, or 10 to 50."""
    distance = np.full(60, 0.2)
    distance[23:37] = 0.0
    touches = _probability(distance, _interval("left_hand", 20, 40), 5) > 0.5
    assert touches[23:37].all() and not touches[:21].any() and not touches[39:].any()
    touches = _probability(distance, _interval("left_hand", 10, 50), 5) > 0.5
    assert touches[15:45].all()
    touches = _probability(distance, _interval("left_hand", 20, 40), 0) > 0.5
    assert touches[20:40].all() and touches.sum() == 20


UNSEEN = np.zeros(60, bool)
UNSEEN[28:31] = True


@pytest.mark.parametrize(
    ("intervals", "near", "expected"),
    [
        ([("left_hand", 5, 15)], range(0, 60), []),
        ([("left_hand", 5, 5)], range(0, 60), [(range(5, 5), "no frame at 5", False)]),
        (
            [("left_hand", 5, 15), ("left_hand", 12, 20)],
            range(0, 60),
            [(range(12, 15), "left_hand annotated twice", False)],
        ),
        (
            [("left_hand", 5, 20), ("left_hand", 7, 9)],
            range(0, 60),
            [(range(7, 9), "left_hand annotated twice", False)],
        ),
        ([("left_hand", 5, 15), ("seat", 12, 20), ("any", 0, 30)], range(0, 60), None),
        (
            [("left_hand", 5, 28)],
            range(0, 60),
            [(range(27, 29), "left_hand ends unseen", False)],
        ),
        (
            [("left_hand", 31, 40)],
            range(0, 60),
            [(range(30, 32), "left_hand begins unseen", False)],
        ),
        ([("left_hand", 20, 40)], range(20, 40), []),  # unseen in its interior
        (
            [("left_hand", 5, 20)],
            range(0, 12),
            [(range(12, 20), "left_hand annotated 2.00 m from", True)],
        ),
        (
            [("any", 33, 40)],
            range(0, 35),
            [(range(35, 40), "any annotated 2.00 m from", True)],
        ),
        ([("left_hand", 28, 31)], range(0, 0), None),  # far, and nobody saw it
    ],
)
def test_oddities_name_frames_and_part(intervals, near, expected):
    distance = np.full((60, 2), 2.0)
    distance[list(near)] = 0.0
    given = [_interval(*interval) for interval in intervals]
    found = find_issues(given, REGIONS, distance, UNSEEN)
    evidence, labels = annotation_evidence(given, REGIONS, 60, 5)
    assert np.isfinite(evidence).all() and np.isin(labels, (-1, 0, 1)).all()
    if expected is None:
        assert not any(odd.distrusted or "twice" in odd.text for odd in found)
        return
    assert [(odd.frames, odd.distrusted) for odd in found] == [(f, d) for f, _, d in expected]
    for odd, (_, text, _) in zip(found, expected, strict=True):
        assert text in odd.text
