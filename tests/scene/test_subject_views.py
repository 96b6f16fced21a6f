"""The subject is found in an image that is a few frames late."""

from __future__ import annotations

import numpy as np

from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.person.groups import NOBODY
from intercap_core.scene.subject_views import add_late_views
from tests.helpers.synthetic_capture import ring
from tests.helpers.synthetic_people import seen_by, walking

RIG, UP = ring()
T, FPS, LATE = 12, 15.0, 4
TIMES = np.arange(T) / FPS


class OnePerson:
    """The walker in every image; camera 2's images of sets 6 to 8 are ``LATE`` frames old."""

    def __init__(self, offset: np.ndarray) -> None:
        path = walking(T, np.array([-0.4, -0.2]), np.array([0.09, 0.05]))
        self.joints = apply(invert(UP), path.reshape(-1, 3)).reshape(path.shape)
        self._keypoints = seen_by(path, RIG, UP)
        for t in (8, 7, 6):
            self._keypoints[t, 2] = self._keypoints[t - LATE, 2]
        self._keypoints[6:9, 2, :, :2] += offset

    def people(self, t: int, c: int) -> np.ndarray:
        return self._keypoints[t, c][None]


def found(offset: np.ndarray) -> np.ndarray:
    someone = OnePerson(offset)
    index = np.zeros((T, len(RIG)), np.int32)
    index[6:9, 2] = NOBODY
    return add_late_views(index, someone, someone.joints, RIG, TIMES)


def test_a_late_view_is_the_subject():
    assert (found(np.zeros(2)) == 0).all()


def test_other_person_is_not_recognised():
    assert (found(np.array([0.0, 400.0]))[6:9, 2] == NOBODY).all()
