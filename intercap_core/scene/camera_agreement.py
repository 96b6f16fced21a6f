"""Cameras whose keypoints contradict the others at the given poses, and the likely cause.

The body is triangulated robustly from all views at once. A camera agrees if most of its detections
are inliers. One that does not is named, with a cause that a second test confirms: the hypothesis
must make the camera agree.

- Poses or keypoints of two cameras exchanged: both agree with each other's pose.
- Moved: a pose that is resected from every second frame set agrees in the other ones. A camera
  that agrees in one part of the recording alone moved in between.
- Calibration of another session: hardly any camera agrees.
- Otherwise the cause is not determined.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.geometry.camera.transforms import invert, rigid
from intercap_core.geometry.camera.triangulation import pixel_scale, reproject
from intercap_core.geometry.solve.time_series import sample_evenly
from intercap_core.person.sides import BODY_POINTS
from intercap_core.person.subject_joints import triangulate_people
from intercap_core.scene.keypoint_motion import MIN_CONFIDENCE
from intercap_core.scene.subject_views import MAX_ERROR_PX, SubjectViews

NOT_AGREEING = "does not agree with the other cameras"  # begins the note of a named camera
UNDETERMINED = "cause not determined"
AGREES = 0.8  # share of inliers of a hypothesis that holds; correct cameras of the studio: 0.9
CONTRADICTS = 0.5  # share of inliers below which a camera is named: most detections are outliers


@dataclass(frozen=True)
class Disagreement:
    """A camera that contradicts the others."""

    camera: int
    """Index of the camera."""
    cause: str
    """The likely cause, in words."""
    error_px: float
    """Median reprojection error of its detections, pixels of a 1080p image; infinite = unknown."""
    usual_px: float
    """The same of the cameras that agree."""
    error_m: float
    """Least standard deviation of its pose: ``error_px`` at the distance of the rig's centre."""

    def __str__(self) -> str:
        size = f"{self.error_px:.0f} px" if np.isfinite(self.error_px) else "no common point"
        usual = f" beside {self.usual_px:.0f}" if np.isfinite(self.usual_px) else ""
        return f"{NOT_AGREEING} (keypoints {size}{usual}): {self.cause}"


@dataclass(frozen=True, eq=False)
class _Views:
    """Keypoints (S, C, 135, 3) of one person in S frame sets, body only."""

    keypoints: np.ndarray
    """(S, C, 135, 3) x, y, confidence; 0 = not seen."""

    def triangulate(self, rig: Rig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Inliers (S, K, C), detections (S, K, C) and points (S, K, 3) with poses of ``rig``.

        Sides are made consistent first.
        """
        keypoints, found = triangulate_people(
            self.keypoints, rig, min_confidence=MIN_CONFIDENCE, max_error_px=MAX_ERROR_PX
        )
        sets, views = keypoints.shape[:2]
        shape = (sets, NUM_KEYPOINTS, views)
        seen = np.swapaxes(keypoints[..., 2] >= MIN_CONFIDENCE, 1, 2)
        inlier = found.inlier.reshape(shape) & seen
        points = found.points.reshape(sets, NUM_KEYPOINTS, 3)
        return inlier[:, BODY_POINTS], seen[:, BODY_POINTS], points[:, BODY_POINTS]

    def shares(self, rig: Rig) -> np.ndarray:
        """Share (S, C) of the detections that are inliers; NaN = nothing seen."""
        inlier, seen, _ = self.triangulate(rig)
        count = seen.sum(1)
        return np.where(count > 0, inlier.sum(1) / np.maximum(count, 1), np.nan)


def find_disagreements(
    people: PeopleOfImages, subject: SubjectViews, image_of: np.ndarray, rig: Rig
) -> list[Disagreement]:
    """Cameras whose keypoints contradict the others at the poses of ``rig``.

    Args:
        people: people by image.
        subject: the subject's keypoints by moment.
        image_of: (T, C) set whose image of each camera shows each moment; -1 = none.
    """
    views = _sampled(people, subject, image_of)
    if len(rig) < 2 or not len(views.keypoints):
        return []
    by_set = views.shares(rig)
    share = _mean(by_set)
    moved_at = {c: _changes(by_set[:, c]) for c in range(len(rig))}
    bad = [c for c in range(len(rig)) if share[c] < CONTRADICTS or moved_at[c] is not None]
    if not bad:
        return []
    agreeing = [c for c in range(len(rig)) if share[c] >= CONTRADICTS and c not in bad]
    causes = dict.fromkeys(bad, UNDETERMINED)
    exchanged = _exchanged(views, rig, bad)
    if exchanged is not None:
        bad = list(exchanged)
        agreeing = [c for c in range(len(rig)) if c not in bad]
        first, second = (rig.names[c] for c in exchanged)
        causes = dict.fromkeys(
            bad, f"poses, or images, of {first} and {second} are exchanged in the input"
        )
    elif len(agreeing) < max(3, len(rig) / 2):
        # no majority tells which cameras are wrong
        bad = [c for c in range(len(rig)) if np.isfinite(by_set[:, c]).any()]
        words = "too few cameras agree to tell which: the calibration may be of another session"
        causes = dict.fromkeys(bad, words if len(rig) > 2 else UNDETERMINED)
    else:
        for c in bad:
            part = moved_at[c]
            words = _displacement(views, rig, c, part)
            if words:
                causes[c] = words
    error = _errors(views, rig, agreeing)
    for c in bad:
        if (part := moved_at[c]) is not None and exchanged is None:
            error[c] = _errors(_Views(views.keypoints[part]), rig, agreeing)[c]
    usual = float(np.median(error[agreeing])) if agreeing else np.inf
    return [
        Disagreement(c, causes[c], float(error[c]), usual, _metres(rig, c, error[c]))
        for c in bad
        # A part of the recording may show someone else: a cause must explain it.
        if (share[c] < CONTRADICTS or causes[c] != UNDETERMINED)
        and error[c] > MAX_ERROR_PX  # half of its detections are outliers against the others
    ]


def widened(covariance: np.ndarray, rig: Rig, found: list[Disagreement]) -> np.ndarray:
    """Covariance (C, 7, C, 7) in which the pose of each camera of ``found`` has at least the
    deviation of its error; a fixed pose stays fixed.

    If the cause is not determined, the keypoints may be those at fault, and the deviation is kept.
    """
    result = covariance.copy()
    for one in found:
        c = one.camera
        arm = ring_centre(rig) - rig.master_from_colour[c, :3, 3]
        by_pose = np.concatenate([np.cross(np.eye(3), arm).T, np.eye(3)], axis=1)
        sigma = float(np.sqrt(np.trace(by_pose @ result[c, :6, c, :6] @ by_pose.T)))
        if sigma > 0 and one.cause != UNDETERMINED:
            factor = max(1.0, one.error_m / sigma)
            result[c, :6] *= factor
            result[:, :, c, :6] *= factor
    return result


def _sampled(people: PeopleOfImages, subject: SubjectViews, image_of: np.ndarray) -> _Views:
    """Body keypoints of up to 40 moments.

    An image in which the subject was not found shows it if it shows only one person.
    """
    seen = (image_of >= 0).sum(1) >= 2
    rows = np.array(sample_evenly(seen, 40), int)
    keypoints = np.zeros((len(rows), *subject.keypoints.shape[1:]))
    for row, t in enumerate(rows.tolist()):
        for c in np.flatnonzero(image_of[t] >= 0).tolist():
            own = subject.keypoints[t, c]
            everyone = people.people(int(image_of[t, c]), c)
            if not own[BODY_POINTS, 2].any() and len(everyone) == 1:
                own = everyone[0]
            keypoints[row, c, BODY_POINTS] = own[BODY_POINTS]
    return _Views(keypoints)


def _mean(shares: np.ndarray) -> np.ndarray:
    """Mean (C,) over the sets; 1 for cameras that see the person in fewer than 5 sets."""
    seen = np.isfinite(shares).sum(0)
    return np.where(seen < 5, 1.0, np.nansum(shares, 0) / np.maximum(seen, 1))


def _changes(share: np.ndarray) -> slice | None:
    """Part of the sets in which a camera contradicts the others, if it agrees in the rest.

    Each part has five sets with the person or more.
    """
    rows = np.flatnonzero(np.isfinite(share))
    own = share[rows]
    if len(own) < 10:
        return None
    middle = range(5, len(own) - 4)
    apart = [abs(own[:k].mean() - own[k:].mean()) for k in middle]
    k = middle[int(np.argmax(apart))]
    before, after = own[:k].mean(), own[k:].mean()
    if min(before, after) >= CONTRADICTS or max(before, after) < AGREES:
        return None
    return slice(0, int(rows[k])) if before < after else slice(int(rows[k]), len(share))


def _exchanged(views: _Views, rig: Rig, bad: list[int]) -> tuple[int, int] | None:
    """The two cameras that agree with each other's pose; all cameras must agree then."""
    best: tuple[float, tuple[int, int] | None] = (AGREES, None)
    for a, b in combinations(range(len(rig)), 2):
        if a in bad or b in bad:
            poses = rig.master_from_colour.copy()
            poses[[a, b]] = poses[[b, a]]
            worst = float(_mean(views.shares(rig.moved(poses))).min())
            if worst >= best[0]:
                best = worst, (a, b)
    return best[1]


def _displacement(views: _Views, rig: Rig, camera: int, part: slice | None) -> str:
    """Displacement of a moved camera in words; "" if no other pose explains its keypoints."""
    keypoints = views.keypoints[part or slice(None)]
    without = keypoints.copy()
    without[:, camera] = 0
    _, _, points = _Views(without).triangulate(rig)
    lens, own = rig[camera].colour, keypoints[:, camera, BODY_POINTS]
    known = np.isfinite(points[..., 0]) & (own[..., 2] >= MIN_CONFIDENCE)
    even = np.zeros(known.shape, bool)
    even[::2] = True
    fit = known & even
    if fit.sum() < 12:  # twice the six points of a resection
        return ""
    rays = lens.unproject(own[..., :2])
    limit = MAX_ERROR_PX * pixel_scale(rig)[camera]
    done, turn, shift, _ = cv2.solvePnPRansac(
        points[fit], rays[fit][:, :2], np.eye(3), None,
        iterationsCount=300, reprojectionError=limit / lens.fx, flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    if not done:
        return ""
    pose = invert(rigid(cv2.Rodrigues(turn)[0], shift.ravel()))
    poses = rig.master_from_colour.copy()
    away = poses[camera, :3, :3].T @ pose[:3, :3]
    degrees = np.degrees(Rotation.from_matrix(away).magnitude())
    metres = float(np.linalg.norm(pose[:3, 3] - poses[camera, :3, 3]))
    if metres > float(np.linalg.norm(ring_centre(rig) - poses[camera, :3, 3])):
        return ""  # beyond the person: these are the keypoints of someone else
    poses[camera] = pose
    check = _Views(keypoints[1::2])
    if _mean(check.shares(rig.moved(poses)))[camera] < AGREES:
        return ""
    when = "" if part is None else " during the recording"
    return f"the camera was moved{when} by about {degrees:.0f} degrees and {100 * metres:.0f} cm"


def _errors(views: _Views, rig: Rig, agreeing: list[int]) -> np.ndarray:
    """Median error (C,) of the detections of each camera, pixels of a 1080p image.

    Points are triangulated from the cameras that agree; infinite without such points.
    """
    without = np.zeros_like(views.keypoints)
    without[:, agreeing] = views.keypoints[:, agreeing]
    _, _, points = _Views(without).triangulate(rig)
    count = len(rig)
    pixels = reproject(np.nan_to_num(points.reshape(-1, 3), nan=1.0), rig)
    own = np.swapaxes(views.keypoints[:, :, BODY_POINTS], 1, 2).reshape(-1, count, 3)
    known = np.isfinite(points.reshape(-1, 3)[:, :1]) & (own[..., 2] >= MIN_CONFIDENCE)
    size = np.linalg.norm(pixels - own[..., :2], axis=2) / pixel_scale(rig)
    return np.array(
        [np.median(size[known[:, c], c]) if known[:, c].any() else np.inf for c in range(count)]
    )


def _metres(rig: Rig, camera: int, error_px: float) -> float:
    """Size of an error at the distance of the rig's centre, metres; that distance if unknown."""
    pose = rig.master_from_colour[camera]
    distance = float(np.linalg.norm(ring_centre(rig) - pose[:3, 3]))
    pixels = error_px * pixel_scale(rig)[camera] / rig[camera].colour.fx
    return distance * min(1.0, float(pixels))
