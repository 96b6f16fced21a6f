"""What was detected beside the person, and what is the person again."""

from __future__ import annotations

import numpy as np

from intercap_core.formats.detections.read import Candidate
from intercap_core.geometry.camera import masks
from intercap_core.person.masks import merge_other_candidates

HEIGHT, WIDTH = 120, 160


def _box(x: slice, y: slice) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[y, x] = True
    return mask


def _candidates(*drawn: np.ndarray) -> list[Candidate]:
    return [
        Candidate(i, "thing", 0.9, masks.encode(mask), (WIDTH, HEIGHT))
        for i, mask in enumerate(drawn)
    ]


PERSON = _box(slice(50, 90), slice(20, 110))
CUP, CHAIR = _box(slice(90, 100), slice(50, 60)), _box(slice(20, 60), slice(80, 115))
AGAIN = _box(slice(52, 88), slice(20, 70))  # the same person's trunk


def test_all_else_is_one_mask() -> None:
    found = merge_other_candidates(_candidates(PERSON, CUP, CHAIR), masks.encode(PERSON))
    np.testing.assert_array_equal(masks.decode(found, HEIGHT, WIDTH), CUP | CHAIR)


def test_second_mask_of_the_person_is_no_other_candidate() -> None:
    found = merge_other_candidates(_candidates(PERSON, AGAIN, CUP), masks.encode(PERSON))
    np.testing.assert_array_equal(masks.decode(found, HEIGHT, WIDTH), CUP)


def test_no_other_candidates_without_a_person_or_alone() -> None:
    assert merge_other_candidates(_candidates(CUP), b"") == b""
    assert merge_other_candidates(_candidates(PERSON, AGAIN), masks.encode(PERSON)) == b""
    assert merge_other_candidates([], masks.encode(PERSON)) == b""
