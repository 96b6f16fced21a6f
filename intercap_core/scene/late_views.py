"""Finds the subject in images that are whole frames late, by where the other views saw it before.

The search for the subject asks that views agree within a set. In an image a quarter of a second
late somebody who walks is a step behind, and the search takes them for another person.
"""

from __future__ import annotations

import numpy as np

from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.triangulation import pixel_scale, reproject
from intercap_core.person.constants import MIN_COMMON_POINTS
from intercap_core.person.groups import NOBODY
from intercap_core.person.sides import BODY_POINTS, swapped
from intercap_core.scene.constants import SAME_PERSON_PX_AT_1080P
from intercap_core.scene.slips import longest_slip


def with_late_views(
    index: np.ndarray,
    detections: PeopleOfImages,
    joints: np.ndarray,
    rig: Rig,
    times: np.ndarray,
    *,
    fps: float,
    min_confidence: float,
) -> np.ndarray:
    """Add to the subject's ``index`` (T, C), -1 = not seen, people who are where it was shortly
    before.

    ``joints`` (T, 135, 3) m, triangulated from the views that do see it, NaN = not known; ``times``
    (T,) s. Looks back as far as slips are sought.
    """
    reach_s = longest_slip(fps) / fps
    result = index.copy()
    body = joints[:, BODY_POINTS]
    limit = SAME_PERSON_PX_AT_1080P * pixel_scale(rig)
    for t, c in np.argwhere(index == NOBODY):
        found = detections.people(int(t), int(c))
        if not len(found):
            continue
        before = _sets_before(times, int(t), reach_s)
        expected = reproject(np.nan_to_num(body[before].reshape(-1, 3), nan=1.0), rig)[:, c]
        expected = expected.reshape(len(before), -1, 2)
        known = np.isfinite(body[before, :, 0])
        errors = [_distance(person, expected, known, min_confidence) for person in found]
        if min(errors, default=np.inf) < limit[c]:
            result[t, c] = int(np.argmin(errors))
    return result


def _sets_before(times: np.ndarray, t: int, reach_s: float) -> np.ndarray:
    """Sets up to ``reach_s`` before set ``t``, itself included."""
    first = np.searchsorted(times, times[t] - reach_s - 1e-3)
    return np.arange(first, t + 1)


def _distance(
    person: np.ndarray, expected: np.ndarray, known: np.ndarray, min_confidence: float
) -> float:
    """The least median distance, px, of a person (135, 3) to any of N bodies (N, 25, 2); either as
    found or with the sides exchanged."""
    best = np.inf
    for body in (person[BODY_POINTS], swapped(person)[BODY_POINTS]):
        common = known & (body[:, 2] >= min_confidence)
        away = np.linalg.norm(expected - body[:, :2], axis=-1)
        for row, both in zip(away, common, strict=True):
            if both.sum() >= MIN_COMMON_POINTS:
                best = min(best, float(np.median(row[both])))
    return best
