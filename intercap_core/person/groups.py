"""The people of one frame set, matched over its views by geometry.

Detections of two views whose rays meet belong to one person. The order of people in a detector's
file carries no information.

1. Each pair of detections of two views is a proposal if their rays meet within
   :data:`SAME_PERSON_GAP_M`. The midpoints are the points of the proposed person.
2. A proposal is extended by the closest detection of each other view.
3. The best supported proposals are kept. A detection belongs to one person only.

In a set without intersecting rays, depth locates the people of each single view.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from intercap_core.body.keypoints import PARTNER
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.triangulation import (
    midpoints,
    pixel_scale,
    reproject,
    view_pairs,
)
from intercap_core.person.sides import BODY_POINTS

# Body points that two detections must share. Tuned on the studio: the subject is the same with 1 to
# 15, the number of other people is not.
MIN_COMMON_POINTS = 5
# Largest median distance of a detection from the reprojected points of its person, px. Detector
# biases and calibration errors are much smaller; a person half a metre away is 160 px off at 2.6 m.
# Tuned on the studio. With half of it, the subject is missed in some images. With double, people
# who pass each other 25 cm apart are exchanged (tests/person/test_subject.py).
SAME_PERSON_PX_AT_1080P = 60.0
# Largest median distance between the rays of two views to one person, metres. Tuned on the studio.
# With a quarter of it, the subject is missed in recordings of two views. With double, the demo's
# person beside a stool is split into two people in 17 instead of 8 of 45 frames.
SAME_PERSON_GAP_M = 0.12

# Two people are at least as far apart. The centre of one person moves less by noise from set to
# set. A twelfth splits the subject's track of cup_drink_s04 (config/field/no_depth.yaml).
MIN_DISTANCE_M = 0.3
NOBODY = -1  # index of a person in a view that does not see it

_MIRRORED = PARTNER[BODY_POINTS]  # the body's points with left and right exchanged
_Proposal = tuple[float, np.ndarray, tuple[int, int], tuple[int, int]]
Lift = Callable[[int, int, np.ndarray], np.ndarray]
"""Function that locates the people of one view by its depth.

Called with set t, camera c and the body keypoints (P, 25, 3) of its people; returns their points
(P, 25, 3), master frame, metres, NaN = unknown."""


@dataclass(frozen=True, eq=False)
class PersonGroup:
    """One person in one frame set."""

    members: np.ndarray
    """(C,) index of the person in each view; -1 = not seen."""
    points: np.ndarray
    """(25, 3) body points, metres; NaN = unknown."""
    support: float
    """Number of visible points, summed over views with the weight 1 - ``errors``."""
    errors: np.ndarray
    """(C,) median distance of each view's detection from the reprojected points, divided by the
    limit :data:`SAME_PERSON_PX_AT_1080P`; inf = no detection within the limit."""

    @property
    def views(self) -> int:
        """Number of views that see the person."""
        return int((self.members != NOBODY).sum())

    @cached_property
    def centre(self) -> np.ndarray:
        """Coordinate-wise median (3,) of the known points, metres."""
        return np.nanmedian(self.points, 0)

    def shared_distance(self, other: PersonGroup) -> float:
        """Median distance of the points that both groups know, metres; NaN with less than three.

        Left and right may be exchanged in one of the groups. The median of three points, such as
        the hips and their middle, tolerates one wrong point.
        """
        apart = np.linalg.norm(
            self.points - np.stack([other.points, other.points[_MIRRORED]]), axis=-1
        )
        enough = np.isfinite(apart).sum(1) >= 3
        return float(np.nanmedian(apart[enough], axis=1).min()) if enough.any() else float("nan")

    def distance(self, other: PersonGroup) -> float:
        """:meth:`shared_distance`, or else the distance of the centres.

        The centre is that of the known points, which differ from set to set.
        """
        apart = self.shared_distance(other)
        return apart if np.isfinite(apart) else float(np.linalg.norm(self.centre - other.centre))

    def shares_view(self, other: PersonGroup) -> bool:
        """Whether a view shows both groups, as two detections."""
        return bool(((self.members != NOBODY) & (other.members != NOBODY)).any())

    def same_person(self, other: PersonGroup) -> bool:
        """Whether two groups of one set may be one person, seen by different cameras."""
        return not self.shares_view(other) and self.distance(other) < MIN_DISTANCE_M

    def merged(self, other: PersonGroup) -> PersonGroup:
        """One person from two groups of one set; the group with more support takes precedence."""
        if other.support > self.support:
            return other.merged(self)
        free = self.members == NOBODY
        return PersonGroup(
            np.where(free, other.members, self.members),
            np.where(np.isfinite(self.points), self.points, other.points),
            self.support + other.support,
            np.where(free, other.errors, self.errors),
        )

    def without(self, views: np.ndarray) -> PersonGroup:
        """The same person without the detections of ``views`` (C,) bool."""
        return replace(self, members=np.where(views, NOBODY, self.members))


def group_set(people: list[np.ndarray], rig: Rig, min_confidence: float) -> list[PersonGroup]:
    """Group the people of one set; the person with most support first.

    Args:
        people: (P, 25, 3) x, y, confidence of the P people of each view.
        min_confidence: keypoints of lower confidence are ignored.
    """
    rays, seen = [], []
    for c, own in enumerate(people):
        directions = rig[c].colour.unproject(own[..., :2]) if len(own) else np.zeros((0, 25, 3))
        rays.append(directions @ rig[c].master_from_colour[:3, :3].T)
        seen.append(own[..., 2] >= min_confidence)
    pairs, rest = view_pairs(rig)
    proposals = _pair_proposals(pairs, rays, seen, rig) or _pair_proposals(rest, rays, seen, rig)
    grown: list[PersonGroup] = []
    for _, points, first, second in sorted(proposals, key=lambda p: p[0]):
        (a, i), (b, j) = first, second
        if any(group.members[a] == i and group.members[b] == j for group in grown):
            continue  # a proposal with a smaller gap was already extended by both detections
        group = _grow(points, first, second, people, seen, rig)
        if group is not None:
            grown.append(group)
    grown.sort(key=lambda group: -group.support)
    result: list[PersonGroup] = []
    for group in grown:
        result = _with_another(result, group)
    return result


def _with_another(groups: list[PersonGroup], group: PersonGroup) -> list[PersonGroup]:
    """Add a person, if at least two of the detections belong to no other person.

    A detection shared by two people is assigned to the person it fits better. The new person is
    dropped if someone is then left with a single detection.
    """
    shared = [(group.members == g.members) & (group.members != NOBODY) for g in groups]
    if group.views - int(np.any(shared, axis=0).sum() if shared else 0) < 2:
        return groups
    result = []
    for other, both in zip(groups, shared, strict=True):
        if both.any() and group.distance(other) < MIN_DISTANCE_M:
            return groups  # the same person again
        worse = group.errors >= other.errors
        group = group.without(both & worse)
        result.append(other.without(both & ~worse))
    return [*result, group] if all(g.views > 1 for g in result) else groups


def lifted_groups(t: int, people: list[np.ndarray], lift: Lift) -> list[PersonGroup]:
    """Groups of single detections, located by depth; the person with most support first.

    Detections of one person in several views are not merged. Arguments as in :data:`Lift`, with
    the people of each view.
    """
    result = []
    for c, detections in enumerate(people):
        for i, points in enumerate(lift(t, c, detections) if len(detections) else ()):
            count = int(np.isfinite(points[:, 0]).sum())
            if count >= MIN_COMMON_POINTS:
                members = np.full(len(people), NOBODY, np.int32)
                members[c] = i
                support = 0.5 * count  # less than half of a triangulated point, seen by two views
                result.append(PersonGroup(members, points, support, np.zeros(len(people))))
    return sorted(result, key=lambda group: -group.support)


def _pair_proposals(
    pairs: list[tuple[int, int]], rays: list[np.ndarray], seen: list[np.ndarray], rig: Rig
) -> list[_Proposal]:
    """Find pairs of detections of two views whose rays meet.

    Args:
        pairs: pairs of views.
        rays: (P, 25, 3) directions of the people of each view, master frame.
        seen: (P, 25) bool, visible points of the people of each view.

    Returns:
        For each proposal the median gap of the rays, metres, points (25, 3), and (view, person) of
        both detections.
    """
    centres = rig.master_from_colour[:, :3, 3]
    result = []
    for a, b in pairs:
        if not len(rays[a]) or not len(rays[b]):
            continue
        # a detector may take a back for a front: one view is also tried with the sides exchanged
        other = np.stack([rays[b], rays[b][:, _MIRRORED]])
        other_seen = np.stack([seen[b], seen[b][:, _MIRRORED]])
        points, gap = midpoints(rays[a][:, None], other[:, None], centres[a], centres[b])
        common = seen[a][:, None] & other_seen[:, None] & np.isfinite(gap)  # (2, Pa, Pb, 25)
        enough = common.sum(-1) >= MIN_COMMON_POINTS
        for i, j in np.argwhere(enough.any(0)):
            for side in np.flatnonzero(enough[:, i, j]):
                at = (side, i, j)
                middle_gap = float(np.median(gap[at][common[at]]))
                if middle_gap < SAME_PERSON_GAP_M:
                    known = np.where(common[at][:, None], points[at], np.nan)
                    result.append((middle_gap, known, (a, int(i)), (b, int(j))))
                    break
    return result


def _grow(
    points: np.ndarray,
    first: tuple[int, int],
    second: tuple[int, int],
    people: list[np.ndarray],
    seen: list[np.ndarray],
    rig: Rig,
) -> PersonGroup | None:
    """Extend a proposal by the detection of each view that is closest to its reprojected points.

    ``first``, ``second``: (view, person) of the proposal. None if no detection is close enough.
    """
    members = np.full(len(rig), NOBODY, np.int32)
    members[first[0]], members[second[0]] = first[1], second[1]
    pixels = reproject(np.nan_to_num(points), rig)
    known = np.isfinite(points[:, 0])
    limits = SAME_PERSON_PX_AT_1080P * pixel_scale(rig)
    support, errors = 0.0, np.full(len(rig), np.inf)
    for c in range(len(rig)):
        best = limits[c]
        options = [int(members[c])] if members[c] != NOBODY else range(len(people[c]))
        for i in options:
            error, count = distance_to(pixels[:, c], known, people[c][i], seen[c][i])
            if count >= MIN_COMMON_POINTS and error < best:
                best, members[c] = error, i
        if members[c] != NOBODY and best < limits[c]:
            errors[c] = best / limits[c]
            support += float((known & seen[c][members[c]]).sum()) * (1 - errors[c])
    return PersonGroup(members, points, support, errors) if support > 0 else None


def distance_to(
    pixels: np.ndarray, known: np.ndarray, person: np.ndarray, seen: np.ndarray
) -> tuple[float, int]:
    """Median distance, px, of reprojected points from a detection, and the number of common points.

    The detection is also tried with left and right exchanged. (inf, 0) with too few common points.

    Args:
        pixels: (25, 2) reprojected points.
        known: (25,) bool, known points.
        person: (25, 3) detection.
        seen: (25,) bool, visible points of the detection.
    """
    best, count = np.inf, 0
    for candidate, visible in ((person, seen), (person[_MIRRORED], seen[_MIRRORED])):
        common = known & visible
        if common.sum() >= MIN_COMMON_POINTS:
            error = float(np.median(np.linalg.norm(pixels - candidate[:, :2], axis=-1)[common]))
            if error < best:
                best, count = error, int(common.sum())
    return best, count
