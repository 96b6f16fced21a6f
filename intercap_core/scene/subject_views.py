"""The subject as all views see it, at poses that are not yet refined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.geometry.camera.rig import Rig
from intercap_core.person.groups import NOBODY
from intercap_core.person.middles import fill_middles
from intercap_core.person.sides import BODY_POINTS
from intercap_core.person.subject import find_subject
from intercap_core.person.swaps import triangulate_people
from intercap_core.scene.constants import LOOSE_PX_AT_1080P, MIN_CONFIDENCE
from intercap_core.scene.late_views import with_late_views


@dataclass(frozen=True, eq=False)
class SubjectViews:
    """``keypoints`` (T, C, 135, 3) x, y, confidence of the subject, 0 = not seen, sides put right;
    ``inlier`` (T, C, 135): the view agrees with the others; ``joints`` (T, 135, 3) triangulated
    from the body's 25 keypoints, master frame, metres, NaN = not known (hands and face always);
    ``views`` (T, 135): how many agree, 0 for a neck or mid hip between shoulders or hips."""

    keypoints: np.ndarray
    inlier: np.ndarray
    joints: np.ndarray
    views: np.ndarray

    def showing(self, image_of: np.ndarray, rig: Rig) -> SubjectViews:
        """The same by moment: set t holds the image of camera c that ``image_of`` (T, C) says."""
        shown = self.keypoints[np.maximum(image_of, 0), np.arange(image_of.shape[1])]
        shown[image_of < 0] = 0
        return triangulated(shown, rig)


def subject_views(detections: PeopleOfImages, rig: Rig, times: np.ndarray) -> SubjectViews:
    """Find the subject at the start's poses; all 0 and NaN where no two views agree on anybody."""
    index = find_subject(detections, rig, times, min_confidence=MIN_CONFIDENCE).people
    found = triangulated(_keypoints_of(detections, index), rig)
    if len(times) < 2:
        return found
    late = with_late_views(
        index,
        detections,
        found.joints,
        rig,
        times,
        fps=1 / float(np.median(np.diff(times))),
        min_confidence=MIN_CONFIDENCE,
    )
    if np.array_equal(late, index):
        return found
    return triangulated(_keypoints_of(detections, late), rig)


def _keypoints_of(detections: PeopleOfImages, index: np.ndarray) -> np.ndarray:
    keypoints = np.zeros((*index.shape, NUM_KEYPOINTS, 3))
    for t, c in np.argwhere(index != NOBODY):
        keypoints[t, c] = detections.people(t, c)[index[t, c]]
    return keypoints


def triangulated(keypoints: np.ndarray, rig: Rig) -> SubjectViews:
    """Triangulate the body of ``keypoints`` (T, C, 135, 3), sides exchanged where views say so."""
    sets, views = keypoints.shape[:2]
    body = np.zeros_like(keypoints)
    body[:, :, BODY_POINTS] = keypoints[:, :, BODY_POINTS]
    body, found = triangulate_people(
        body, rig, min_confidence=MIN_CONFIDENCE, max_error_px=LOOSE_PX_AT_1080P
    )
    keypoints = keypoints.copy()
    keypoints[:, :, BODY_POINTS] = body[:, :, BODY_POINTS]
    inlier = np.swapaxes(found.inlier.reshape(sets, NUM_KEYPOINTS, views), 1, 2)
    joints = found.points.reshape(sets, NUM_KEYPOINTS, 3)
    fill_middles(joints)
    return SubjectViews(
        keypoints,
        inlier,
        joints,
        found.views.reshape(sets, NUM_KEYPOINTS),
    )
