"""The subject is found in an image that is a few frames late."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.person.groups import NOBODY
from intercap_core.scene.subject_views import add_late_views
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import DelayedPeople, seen_by, walking

RIG, UP = ring()


@pytest.mark.parametrize(("offset_px", "index"), [(0, 0), (400, NOBODY)], ids=["subject", "other"])
def test_late_view_is_the_subject_but_no_other_person(offset_px, index):
    """The images of camera 2 in sets 6 to 8 are four frames old."""
    path = walking(12, np.array([-0.4, -0.2]), np.array([0.09, 0.05]))
    keypoints = seen_by(path, RIG, UP)
    keypoints[6:9, 2] = keypoints[2:5, 2]
    keypoints[6:9, 2, :, 1] += offset_px
    people = DelayedPeople([[[own] for own in row] for row in keypoints], np.zeros(6, int))
    known = np.zeros((12, 6), np.int32)
    known[6:9, 2] = NOBODY
    joints = apply(invert(UP), path.reshape(-1, 3)).reshape(path.shape)
    result = add_late_views(known, people, joints, RIG, np.arange(12) / 15)
    assert (result[6:9, 2] == index).all() and (np.delete(result, 2, 1) == 0).all()
