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
        usual = f" instead of {self.usual_px:.0f}" if np.isfinite(self.usual_px) else ""
        return f"{NOT_AGREEING} (keypoints {size}{usual}): {self.cause}"


def find_disagreements(
    people: PeopleOfImages, subject: SubjectViews, image_of: np.ndarray, rig: Rig
) -> list[Disagreement]:
    """Cameras whose keypoints contradict the others at the poses of ``rig``.

    Args:
        people: people by image.
        subject: the subject's keypoints by moment.
        image_of: (T, C) set whose image of each camera shows each moment; -1 = none.
    """
    keypoints = _sample(people, subject, image_of)
    if len(rig) < 2 or not len(keypoints):
        return []
    shares = _inlier_shares(keypoints, rig)
    agrees = _agree(shares)
    parts = [_contradicting_part(own) for own in shares.T]
    bad = [c for c, part in enumerate(parts) if part is not None or not agrees[c]]
    if not bad:
        return []
    if exchanged := _exchanged(keypoints, rig, bad):
        first, second = (rig.names[c] for c in exchanged)
        words = f"poses, or images, of {first} and {second} are exchanged in the input"
        causes, parts = dict.fromkeys(exchanged, words), [None] * len(rig)
    elif len(rig) - len(bad) < max(3, len(rig) / 2):  # no majority shows which cameras are wrong
        words = (
            "too few cameras agree to identify the wrong ones: is it another session's calibration?"
        )
        seen = np.flatnonzero(np.isfinite(shares).any(0)).tolist()
        causes = dict.fromkeys(seen, words if len(rig) > 2 else UNDETERMINED)
    else:
        causes = {c: _displacement(keypoints, rig, c, parts[c]) for c in bad}
    agreeing = [c for c in range(len(rig)) if c not in (exchanged or bad)]
    errors = _errors(keypoints, rig, agreeing)
    usual = float(np.median(errors[agreeing])) if agreeing else np.inf
    found = []
    for c, cause in causes.items():
        part = parts[c]
        error = errors[c] if part is None else _errors(keypoints[part], rig, agreeing)[c]
        # a part of the recording may show someone else: a cause must explain it
        is_explained = not agrees[c] or cause != UNDETERMINED
        if is_explained and error > MAX_ERROR_PX:  # most detections are outliers to the others
            found.append(Disagreement(c, cause, float(error), usual, _metres(rig, c, error)))
    return found


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


def _sample(people: PeopleOfImages, subject: SubjectViews, image_of: np.ndarray) -> np.ndarray:
    """Body keypoints (S, C, 135, 3) of up to 40 moments; 0 = not seen.

    An image in which the subject was not found shows it if it shows only one person.
    """
    moments = sample_evenly((image_of >= 0).sum(1) >= 2, 40)
    result = np.zeros((len(moments), *subject.keypoints.shape[1:]))
    for row, t in enumerate(moments):
        for c in np.flatnonzero(image_of[t] >= 0).tolist():
            own = subject.keypoints[t, c]
            everyone = people.people(int(image_of[t, c]), c)
            if not own[BODY_POINTS, 2].any() and len(everyone) == 1:
                own = everyone[0]
            result[row, c, BODY_POINTS] = own[BODY_POINTS]
    return result


def _triangulate(keypoints: np.ndarray, rig: Rig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inliers (S, K, C), detections (S, K, C) and body points (S, K, 3) of (S, C, 135, 3)."""
    keypoints, found = triangulate_people(
        keypoints, rig, min_confidence=MIN_CONFIDENCE, max_error_px=MAX_ERROR_PX
    )
    sets, views = keypoints.shape[:2]
    seen = np.swapaxes(keypoints[..., 2] >= MIN_CONFIDENCE, 1, 2)
    inlier = found.inlier.reshape(sets, NUM_KEYPOINTS, views) & seen
    points = found.points.reshape(sets, NUM_KEYPOINTS, 3)
    return inlier[:, BODY_POINTS], seen[:, BODY_POINTS], points[:, BODY_POINTS]


def _inlier_shares(keypoints: np.ndarray, rig: Rig) -> np.ndarray:
    """Share (S, C) of the detections that are inliers; NaN = nothing seen."""
    inlier, seen, _ = _triangulate(keypoints, rig)
    count = seen.sum(1)
    return np.where(count > 0, inlier.sum(1) / np.maximum(count, 1), np.nan)


def _agree(shares: np.ndarray) -> np.ndarray:
    """Mask (C,) of the cameras most of whose detections are inliers, by ``shares`` (S, C).

    Cameras that see the person in fewer than five sets agree.
    """
    seen = np.isfinite(shares).sum(0)
    return (seen < 5) | (np.nansum(shares, 0) >= 0.5 * seen)


def _contradicting_part(share: np.ndarray) -> slice | None:
    """Part of the sets in which a camera contradicts the others, if it agrees in the rest.

    Each part has five sets with the person or more. ``share``: (S,) of inliers.
    """
    rows = np.flatnonzero(np.isfinite(share))
    own = share[rows]
    splits = range(5, len(own) - 4)
    if not splits:
        return None
    k = max(splits, key=lambda k: abs(own[:k].mean() - own[k:].mean()))
    before, after = own[:k].mean() >= 0.5, own[k:].mean() >= 0.5
    if before == after:
        return None
    return slice(int(rows[k]), len(share)) if before else slice(0, int(rows[k]))


def _exchanged(keypoints: np.ndarray, rig: Rig, bad: list[int]) -> tuple[int, int] | None:
    """The two cameras that agree with each other's pose; all cameras must agree then."""
    best: tuple[float, tuple[int, int] | None] = (0.0, None)
    for a, b in combinations(range(len(rig)), 2):
        if a in bad or b in bad:
            poses = rig.master_from_colour.copy()
            poses[[a, b]] = poses[[b, a]]
            shares = _inlier_shares(keypoints, rig.moved(poses))
            if _agree(shares).all() and (mean := float(np.nanmean(shares))) > best[0]:
                best = mean, (a, b)
    return best[1]


def _displacement(keypoints: np.ndarray, rig: Rig, camera: int, part: slice | None) -> str:
    """Displacement of a moved camera in words; UNDETERMINED if no pose explains its keypoints."""
    keypoints = keypoints[part or slice(None)]
    without = keypoints.copy()
    without[:, camera] = 0
    _, _, points = _triangulate(without, rig)
    lens, own = rig[camera].colour, keypoints[:, camera, BODY_POINTS]
    fit = np.isfinite(points[..., 0]) & (own[..., 2] >= MIN_CONFIDENCE)
    fit[1::2] = False
    if fit.sum() < 12:  # twice the six points of a resection
        return UNDETERMINED
    rays = lens.unproject(own[..., :2])
    limit = MAX_ERROR_PX * pixel_scale(rig)[camera]
    done, turn, shift, _ = cv2.solvePnPRansac(
        points[fit], rays[fit][:, :2], np.eye(3), None,
        iterationsCount=300, reprojectionError=limit / lens.fx, flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    if not done:
        return UNDETERMINED
    pose = invert(rigid(cv2.Rodrigues(turn)[0], shift.ravel()))
    poses = rig.master_from_colour.copy()
    degrees = np.degrees(Rotation.from_matrix(poses[camera, :3, :3].T @ pose[:3, :3]).magnitude())
    metres = float(np.linalg.norm(pose[:3, 3] - poses[camera, :3, 3]))
    if metres > float(np.linalg.norm(ring_centre(rig) - poses[camera, :3, 3])):
        return UNDETERMINED  # beyond the person: these are the keypoints of someone else
    poses[camera] = pose
    if not _agree(_inlier_shares(keypoints[1::2], rig.moved(poses)))[camera]:
        return UNDETERMINED
    when = "" if part is None else " during the recording"
    return f"the camera was moved{when} by about {degrees:.0f} degrees and {100 * metres:.0f} cm"


def _errors(keypoints: np.ndarray, rig: Rig, agreeing: list[int]) -> np.ndarray:
    """Median error (C,) of the detections of each camera, pixels of a 1080p image.

    Points are triangulated from the cameras that agree; infinite without such points.
    """
    others = np.zeros_like(keypoints)
    others[:, agreeing] = keypoints[:, agreeing]
    points = _triangulate(others, rig)[2].reshape(-1, 3)
    pixels = reproject(np.nan_to_num(points, nan=1.0), rig)
    own = np.swapaxes(keypoints[:, :, BODY_POINTS], 1, 2).reshape(*pixels.shape[:2], 3)
    known = np.isfinite(points[:, :1]) & (own[..., 2] >= MIN_CONFIDENCE)
    size = np.linalg.norm(pixels - own[..., :2], axis=2) / pixel_scale(rig)
    return np.array(
        [np.median(e[k]) if k.any() else np.inf for e, k in zip(size.T, known.T, strict=True)]
    )


def _metres(rig: Rig, camera: int, error_px: float) -> float:
    """Size of an error at the distance of the rig's centre, metres; that distance if unknown."""
    pose = rig.master_from_colour[camera]
    distance = float(np.linalg.norm(ring_centre(rig) - pose[:3, 3]))
    pixels = error_px * pixel_scale(rig)[camera] / rig[camera].colour.fx
    return distance * min(1.0, float(pixels))
