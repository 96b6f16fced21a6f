"""Detections of the subject in all views, and its joints triangulated at the poses as given.

The search for the subject requires that the views of a set agree. In an image that is some frames
late, a walking person is at an earlier position, so the search rejects the detection.
:func:`add_late_views` adds a detection if it fits the subject's position shortly before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.triangulation import pixel_scale, reproject
from intercap_core.person.groups import NOBODY, distance_to
from intercap_core.person.sides import BODY_POINTS
from intercap_core.person.subject import find_subject, subject_keypoints
from intercap_core.person.subject_joints import fill_middles, triangulate_people
from intercap_core.scene.keypoint_motion import MIN_CONFIDENCE
from intercap_core.scene.slips import longest_slip

# Error of an inlier, pixels of a 1080p image; it allows for errors of the given poses, about a
# centimetre. Tuned on the studio.
MAX_ERROR_PX = 40.0


def add_late_views(
    index: np.ndarray, detections: PeopleOfImages, joints: np.ndarray, rig: Rig, times: np.ndarray
) -> np.ndarray:
    """Add detections at earlier positions of the subject, as far back as slips reach.

    Returns ``index`` (T, C) with these detections.

    Args:
        index: (T, C) the subject's detection in each image; -1 = not seen.
        joints: (T, 135, 3) triangulated from the views with a detection, metres; NaN = unknown.
        times: (T,) seconds.
    """
    fps = 1 / float(np.median(np.diff(times)))
    reach_s = longest_slip(fps) / fps
    result = index.copy()
    body = joints[:, BODY_POINTS]
    # px at 1080p, for joint biases, unrefined poses and half a frame of motion; tuned on the studio
    limit = 45.0 * pixel_scale(rig)
    for t, c in np.argwhere(index == NOBODY).tolist():
        people = detections.people(t, c)
        if not len(people):
            continue
        before = np.arange(np.searchsorted(times, times[t] - reach_s - 1e-3), t + 1)
        expected = reproject(np.nan_to_num(body[before].reshape(-1, 3), nan=1.0), rig)[:, c]
        expected = expected.reshape(len(before), -1, 2)
        places = list(zip(expected, np.isfinite(body[before, :, 0]), strict=True))
        bodies = people[:, BODY_POINTS]
        errors = [
            min(distance_to(*place, body, body[:, 2] >= MIN_CONFIDENCE)[0] for place in places)
            for body in bodies
        ]
        if min(errors) < limit[c]:
            result[t, c] = int(np.argmin(errors))
    return result


@dataclass(frozen=True, eq=False)
class SubjectViews:
    """Keypoints of the subject in all views, and its joints."""

    keypoints: np.ndarray
    """(T, C, 135, 3) x, y, confidence with corrected sides; 0 = not seen."""
    inlier: np.ndarray
    """(T, C, 135) bool: the view agrees with the others."""
    joints: np.ndarray
    """(T, 135, 3) triangulated body, master frame, metres; NaN = unknown, as are hands and face."""
    views: np.ndarray
    """(T, 135) number of agreeing views; 0 for a neck or mid hip computed from other joints."""

    def showing(self, image_of: np.ndarray, rig: Rig) -> SubjectViews:
        """Reorder from images to moments and triangulate again.

        ``image_of``: (T, C) set whose image shows each moment; -1 = none.
        """
        shown = self.keypoints[np.maximum(image_of, 0), np.arange(image_of.shape[1])]
        shown[image_of < 0] = 0
        return triangulate_views(shown, rig)


def find_subject_views(detections: PeopleOfImages, rig: Rig, times: np.ndarray) -> SubjectViews:
    """Find the subject at the given poses.

    Keypoints are 0 and joints NaN if no two views agree on any person.
    """
    index = find_subject(detections, rig, times, min_confidence=MIN_CONFIDENCE).people
    views = triangulate_views(subject_keypoints(detections, index), rig)
    if len(times) < 2:
        return views
    late = add_late_views(index, detections, views.joints, rig, times)
    if np.array_equal(late, index):
        return views
    return triangulate_views(subject_keypoints(detections, late), rig)


def triangulate_views(keypoints: np.ndarray, rig: Rig) -> SubjectViews:
    """Triangulate the body of ``keypoints`` (T, C, 135, 3), with sides made consistent."""
    sets, views = keypoints.shape[:2]
    body = np.zeros_like(keypoints)
    body[:, :, BODY_POINTS] = keypoints[:, :, BODY_POINTS]
    body, points = triangulate_people(
        body, rig, min_confidence=MIN_CONFIDENCE, max_error_px=MAX_ERROR_PX
    )
    keypoints = keypoints.copy()
    keypoints[:, :, BODY_POINTS] = body[:, :, BODY_POINTS]
    inlier = np.swapaxes(points.inlier.reshape(sets, NUM_KEYPOINTS, views), 1, 2)
    joints = points.points.reshape(sets, NUM_KEYPOINTS, 3)
    fill_middles(joints)
    return SubjectViews(keypoints, inlier, joints, points.views.reshape(sets, NUM_KEYPOINTS))
