"""Whether a detected person touches the object, as one image shows it: who handles it in most views
and frames is the subject."""

from __future__ import annotations

import numpy as np

from intercap_core.body.keypoints import BODY, LEFT_HAND, RIGHT_HAND
from intercap_core.formats.detections.instance import PERSON_LABEL
from intercap_core.formats.detections.read import Detections
from intercap_core.person.constants import TOUCH_REACH
from intercap_core.person.subject import Touches

_POINTS = np.r_[BODY, LEFT_HAND, RIGHT_HAND]
_AROUND = np.array([(0, 0), *((np.cos(a), np.sin(a)) for a in np.arange(8) * np.pi / 4)])


def touches_of(
    detections: Detections, labels: tuple[str, ...], *, min_confidence: float
) -> Touches:
    """Who touches a candidate that has one of the object's ``labels``; none = any but a person's.

    Somebody touches it whose keypoints, or places a hand's breadth beside them, lie in its mask. In
    a view from behind that is so by chance; most views tell.
    """

    def touches(t: int, c: int, person: int) -> bool | None:
        things = [
            candidate
            for candidate in detections.candidates(t, c)
            if candidate.label != PERSON_LABEL and (candidate.label in labels or not labels)
        ]
        points = detections.people(t, c)[person][_POINTS]
        points = points[points[:, 2] >= min_confidence, :2]
        if not things or not len(points):
            return None
        reach = TOUCH_REACH * float(np.ptp(points, axis=0).max())
        x, y = np.rint(points[:, None] + reach * _AROUND).astype(np.int64).reshape(-1, 2).T
        return any(bool(thing.runs.sample(x, y).any()) for thing in things)

    return touches
