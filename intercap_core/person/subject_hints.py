"""Which detections are the subject: points named by the user, and contact with the object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.annotation import SubjectPoint
from intercap_core.body.keypoints import BODY, LEFT_HAND, RIGHT_HAND
from intercap_core.errors import UserError
from intercap_core.formats.detections.instance import PERSON_LABEL
from intercap_core.formats.detections.read import Detections
from intercap_core.person.masks import BONES
from intercap_core.person.sides import BODY_POINTS
from intercap_core.person.subject import NamedDetection, Touches


def named_people(
    points: Sequence[SubjectPoint],
    detections: Detections,
    image_of: np.ndarray,
    *,
    min_confidence: float,
) -> list[NamedDetection]:
    """Find the detection at each point that the user set in an image.

    It is the person whose bones are closest to the point, relative to the person's size in pixels.

    Args:
        points: entries of the annotation ``subject``; they count recorded frames.
        detections: by moment.
        image_of: (T, C) recorded frame whose image shows each moment; -1 = none.
        min_confidence: keypoints of lower confidence are ignored.

    Raises:
        UserError: unknown camera, frame without an image, point outside the image, or nobody there.
    """
    names = detections.camera_names
    sizes = {
        name: (int(w), int(h)) for name, (w, h) in zip(names, detections.image_sizes, strict=True)
    }
    named = []
    for k, point in enumerate(points):
        words = f"sequence {detections.sequence}: the annotation's subject[{k}]"
        if fault := point.fault(sizes):
            raise UserError(f"{words} {fault}")
        c = names.index(point.camera)
        where = f"camera {point.camera}, frame {point.frame}"
        shows = np.flatnonzero(image_of[:, c] == point.frame)
        if not len(shows):
            raise UserError(
                f"{words} names {where}, which has no image, or one that is not in step; name the "
                "person in another frame or camera"
            )
        t, at = int(shows[0]), np.array([point.x, point.y])
        people = detections.people(t, c)[:, BODY_POINTS]
        away = [_distance(person, at, min_confidence) for person in people]
        nearest = int(np.argmin(away)) if away else -1
        if nearest < 0 or away[nearest] > 0.15:  # share of the person's size; untuned
            seen = [person[person[:, 2] >= min_confidence, :2] for person in people]
            places = ", ".join(
                f"({x:.0f}, {y:.0f})" for x, y in (np.median(body, 0) for body in seen if len(body))
            )
            raise UserError(
                f"{words} is at x {point.x:g}, y {point.y:g} of {where}, where nobody was "
                f"detected; there are people at {places or 'no place of it'}"
            )
        named.append(NamedDetection(t, c, nearest, f"subject[{k}]"))
    return named


def _distance(person: np.ndarray, point: np.ndarray, min_confidence: float) -> float:
    """Distance of a point (2,) px from the bones of a person (25, 3), over the person's size.

    The size is the longer side of the box around the visible keypoints. inf without a bone.
    """
    seen = person[:, 2] >= min_confidence
    bones = BONES[seen[BONES].all(1)]
    if not len(bones):
        return np.inf
    start, end = person[bones[:, 0], :2], person[bones[:, 1], :2]
    along = end - start
    length = np.maximum((along**2).sum(1), 1e-9)
    share = np.clip(((point - start) * along).sum(1) / length, 0, 1)
    away = np.linalg.norm(start + share[:, None] * along - point, axis=1).min()
    return float(away / max(np.ptp(person[seen, :2], axis=0).max(), 1.0))


def touch_test(
    detections: Detections, labels: tuple[str, ...], *, min_confidence: float
) -> Touches:
    """Return a function that tests a person for contact with the object in one image.

    The object is any candidate with one of the ``labels``; without labels, any candidate that is
    not a person. A person touches it if a keypoint, or a pixel a hand's breadth from it, lies in
    the candidate's mask. Occlusion also causes such overlaps, but in few views only.
    """
    parts = np.r_[BODY, LEFT_HAND, RIGHT_HAND]
    # offsets (9, 2) of the tested pixels: the keypoint itself, and eight on a circle around it
    around = np.array([(0, 0), *((np.cos(a), np.sin(a)) for a in np.arange(8) * np.pi / 4)])

    def touches(t: int, c: int, person: int) -> bool | None:
        """See :data:`.subject.Touches`."""
        objects = [
            candidate
            for candidate in detections.candidates(t, c)
            if candidate.label != PERSON_LABEL and (candidate.label in labels or not labels)
        ]
        points = detections.people(t, c)[person][parts]
        points = points[points[:, 2] >= min_confidence, :2]
        if not objects or not len(points):
            return None
        reach = 0.03 * float(np.ptp(points, axis=0).max())  # a hand's breadth (anatomy)
        x, y = np.rint(points[:, None] + reach * around).astype(np.int64).reshape(-1, 2).T
        return any(bool(candidate.runs.sample(x, y).any()) for candidate in objects)

    return touches
