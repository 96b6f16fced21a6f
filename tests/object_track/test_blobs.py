"""Blobs of person and object taken apart."""

import cv2
import numpy as np
import pytest

from intercap_core.object_track.blobs import without_person
from intercap_core.object_track.reduced_mask import ReducedMask

PERSON = np.zeros((300, 200), np.uint8)
cv2.ellipse(PERSON, (90, 150), (40, 130), 0, 0, 360, 1, -1)
OBJECT = np.zeros_like(PERSON)
OBJECT[140:180, 125:160] = 1


def _reduced(mask: np.ndarray) -> ReducedMask:
    return ReducedMask(0, 0, mask.astype(bool))


@pytest.mark.parametrize("border", [0, 3])
def test_the_object_is_what_is_left_of_a_blob(border):
    size = np.ones((2 * border + 1, 2 * border + 1), np.uint8)
    blob = cv2.dilate(PERSON, size) | OBJECT
    part = without_person(_reduced(blob), _reduced(PERSON), 1)
    assert part is not None
    found = part.window(0, 0, *PERSON.shape)
    off = (OBJECT > 0) & (PERSON == 0)
    assert (found & off).sum() > 0.9 * off.sum()
    assert (found & ~off).sum() < 0.35 * off.sum()


def test_the_person_alone_and_the_object_alone_are_no_blobs():
    wider = cv2.dilate(PERSON, np.ones((7, 7), np.uint8))
    assert without_person(_reduced(wider), _reduced(PERSON), 1) is None
    assert without_person(_reduced(OBJECT), _reduced(PERSON), 1) is None
    assert without_person(_reduced(OBJECT), _reduced(np.zeros_like(PERSON)), 1) is None
