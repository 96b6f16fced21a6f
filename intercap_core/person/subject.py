"""PeopleOfImages matched over views by geometry, followed over time, and the subject among them.

The order of people in a detector's file says nothing: each frame set's detections are grouped by
whether their rays meet, groups are linked over time in space, and the subject is the track that
most views and sets support, near the middle of the ring. In a set where no rays meet, depth tells
where the people of each single view are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from intercap_core.camera.rig import Rig, ring_centre
from intercap_core.camera.triangulation import midpoints, pixel_scale, reproject, view_pairs
from intercap_core.detections.read import PeopleOfImages
from intercap_core.person.constants import (
    CENTRE_RANGE_M,
    LIFTED_SUPPORT,
    LINK_SLACK_M,
    MAX_BODY_SPEED_M_S,
    MAX_LINK_GAP_S,
    MIN_COMMON_POINTS,
    MOVED_PX_FACTOR,
    SAME_PERSON_GAP_M,
    SAME_PERSON_PX_AT_1080P,
)
from intercap_core.person.sides import BODY_POINTS, PARTNER

NOBODY = -1

_MIRRORED = PARTNER[BODY_POINTS]  # the body's points with left and right exchanged
_Proposal = tuple[float, np.ndarray, tuple[int, int], tuple[int, int]]
Lift = Callable[[int, int, np.ndarray], np.ndarray]
"""Points (P, 25, 3), master frame, NaN = not known, of the people (P, 25, 3) that view c sees in
set t, by its depth alone: called with t, c and the people."""


@dataclass(frozen=True)
class Group:
    """One person in one frame set: ``members`` (C,) index of the view's person or -1, ``points``
    (25, 3) metres, NaN = not known, and ``support``, the number of points seen, over views."""

    members: np.ndarray
    points: np.ndarray
    support: float

    @property
    def centre(self) -> np.ndarray:
        """Median of the known points (3,)."""
        return np.nanmedian(self.points, 0)


@dataclass
class _Track:
    sets: list[int] = field(default_factory=list)
    groups: list[Group] = field(default_factory=list)


def find_subject(
    detections: PeopleOfImages,
    rig: Rig,
    times: np.ndarray,
    *,
    min_confidence: float,
    lift: Lift | None = None,
) -> np.ndarray:
    """Find the subject: the index of its detection in every image (T, C) int32, -1 = not seen.

    ``times`` (T,) seconds. ``lift`` places the people of single views in sets where no two views
    agree on anybody. All -1 where nobody can be placed in any set.
    """
    groups = []
    for t in range(detections.num_sets):
        seen = [detections.people(t, c)[:, BODY_POINTS] for c in range(len(rig))]
        found = _groups_of_set(seen, rig, min_confidence)
        if not found and lift is not None:
            found = _lifted_groups(t, seen, lift)
        groups.append(found)
    chosen = _subject_track(groups, times, ring_centre(rig))
    people = np.full((detections.num_sets, len(rig)), NOBODY, np.int32)
    for t, group in chosen.items():
        people[t] = group.members
    _add_single_views(people, chosen, detections, rig, times, min_confidence)
    return people


def _groups_of_set(people: list[np.ndarray], rig: Rig, min_confidence: float) -> list[Group]:
    """Group one set's people (P, 25, 3) of each view; best supported first."""
    rays, seen = [], []
    for c, found in enumerate(people):
        directions = rig[c].colour.unproject(found[..., :2]) if len(found) else np.zeros((0, 25, 3))
        rays.append(directions @ rig[c].master_from_colour[:3, :3].T)
        seen.append(found[..., 2] >= min_confidence)
    pairs, rest = view_pairs(rig)
    proposals = _pair_proposals(pairs, rays, seen, rig) or _pair_proposals(rest, rays, seen, rig)
    grown: list[Group] = []
    for _, points, first, second in sorted(proposals, key=lambda p: p[0]):
        if any(
            g.members[first[0]] == first[1] and g.members[second[0]] == second[1] for g in grown
        ):
            continue  # a better pair of views has led to these two already
        group = _grow(points, first, second, people, seen, rig)
        if group is not None:
            grown.append(group)
    grown.sort(key=lambda group: -group.support)
    taken: set[tuple[int, int]] = set()
    result = []
    for group in grown:
        members = {(c, int(i)) for c, i in enumerate(group.members) if i != NOBODY}
        if not members & taken:
            taken |= members
            result.append(group)
    return result


def _lifted_groups(t: int, people: list[np.ndarray], lift: Lift) -> list[Group]:
    """Every person (P, 25, 3) of each view as a group of its own; best supported first."""
    result = []
    for c, found in enumerate(people):
        for i, points in enumerate(lift(t, c, found) if len(found) else ()):
            count = int(np.isfinite(points[:, 0]).sum())
            if count >= MIN_COMMON_POINTS:
                members = np.full(len(people), NOBODY, np.int32)
                members[c] = i
                result.append(Group(members, points, LIFTED_SUPPORT * count))
    return sorted(result, key=lambda group: -group.support)


def _pair_proposals(
    pairs: list[tuple[int, int]], rays: list[np.ndarray], seen: list[np.ndarray], rig: Rig
) -> list[_Proposal]:
    """Two views' people whose rays meet: the median gap, metres, points (25, 3) and (view, person)
    of both."""
    centres = rig.master_from_colour[:, :3, 3]
    result = []
    for a, b in pairs:
        if not len(rays[a]) or not len(rays[b]):
            continue
        # A detector may take a back for a front: also try one view mirrored.
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


def _mirror(body: np.ndarray) -> np.ndarray:
    """Exchange left and right of body points (25, n)."""
    return body[_MIRRORED]


def _grow(
    points: np.ndarray,
    first: tuple[int, int],
    second: tuple[int, int],
    people: list[np.ndarray],
    seen: list[np.ndarray],
    rig: Rig,
) -> Group | None:
    """Add to a proposal the person of every view that it reprojects onto."""
    members = np.full(len(rig), NOBODY, np.int32)
    members[first[0]], members[second[0]] = first[1], second[1]
    pixels = reproject(np.nan_to_num(points), rig)
    known = np.isfinite(points[:, 0])
    limits = SAME_PERSON_PX_AT_1080P * pixel_scale(rig)
    support = 0.0
    for c in range(len(rig)):
        best = limits[c]
        options = [int(members[c])] if members[c] != NOBODY else range(len(people[c]))
        for i in options:
            error, count = _distance(pixels[:, c], known, people[c][i], seen[c][i])
            if count >= MIN_COMMON_POINTS and error < best:
                best, members[c] = error, i
        if members[c] != NOBODY and best < limits[c]:
            support += float((known & seen[c][members[c]]).sum()) * (1 - best / limits[c])
    return Group(members, points, support) if support > 0 else None


def _distance(
    pixels: np.ndarray, known: np.ndarray, person: np.ndarray, seen: np.ndarray
) -> tuple[float, int]:
    """Median distance, px, of reprojected points (25, 2) to a person, sides exchanged if better."""
    best, count = np.inf, 0
    for candidate, visible in (
        (person, seen),
        (_mirror(person), _mirror(seen[:, None])[:, 0]),
    ):
        common = known & visible
        if common.sum() >= MIN_COMMON_POINTS:
            error = float(np.median(np.linalg.norm(pixels - candidate[:, :2], axis=-1)[common]))
            if error < best:
                best, count = error, int(common.sum())
    return best, count


def _subject_track(
    groups: list[list[Group]], times: np.ndarray, middle: np.ndarray
) -> dict[int, Group]:
    """Link groups over time; return the subject's group of every set that has one."""
    tracks: list[_Track] = []
    for t, in_set in enumerate(groups):
        free = [
            k for k in tracks if k.sets[-1] < t and times[t] - times[k.sets[-1]] <= MAX_LINK_GAP_S
        ]
        pairs = sorted(
            (float(np.linalg.norm(group.centre - track.groups[-1].centre)), g, k)
            for g, group in enumerate(in_set)
            for k, track in enumerate(free)
        )
        used_groups: set[int] = set()
        used_tracks: set[int] = set()
        for distance, g, k in pairs:
            reach = LINK_SLACK_M + MAX_BODY_SPEED_M_S * (times[t] - times[free[k].sets[-1]])
            if g in used_groups or k in used_tracks or distance > reach:
                continue
            used_groups.add(g)
            used_tracks.add(k)
            free[k].sets.append(t)
            free[k].groups.append(in_set[g])
        tracks += [_Track([t], [group]) for g, group in enumerate(in_set) if g not in used_groups]
    scored = sorted(tracks, key=lambda track: -_score(track, middle))
    result: dict[int, Group] = {}
    for track in scored:
        # Later tracks fill gaps of the best one: the same person after having been lost.
        if _compatible(track, result, times):
            result.update(zip(track.sets, track.groups, strict=True))
    return dict(sorted(result.items()))


def _score(track: _Track, middle: np.ndarray) -> float:
    away = [float(np.linalg.norm(group.centre - middle)) for group in track.groups]
    return sum(
        group.support / (1 + (d / CENTRE_RANGE_M) ** 2)
        for group, d in zip(track.groups, away, strict=True)
    )


def _compatible(track: _Track, chosen: dict[int, Group], times: np.ndarray) -> bool:
    """Whether the track overlaps no chosen set, and starts and ends where the subject can be."""
    if not chosen:
        return True
    if chosen.keys() & set(track.sets):
        return False
    known = np.array(sorted(chosen))
    for t, group in ((track.sets[0], track.groups[0]), (track.sets[-1], track.groups[-1])):
        for neighbour in (known[known < t][-1:], known[known > t][:1]):
            for other in neighbour:
                reach = LINK_SLACK_M + MAX_BODY_SPEED_M_S * abs(times[t] - times[other])
                if np.linalg.norm(group.centre - chosen[int(other)].centre) > reach:
                    return False
    return True


def _add_single_views(
    people: np.ndarray,
    chosen: dict[int, Group],
    detections: PeopleOfImages,
    rig: Rig,
    times: np.ndarray,
    min_confidence: float,
) -> None:
    """Where only one view sees the subject, take the person nearest to the last known points."""
    if not chosen:
        return
    known = np.array(list(chosen))
    limits = SAME_PERSON_PX_AT_1080P * pixel_scale(rig)
    for t in range(len(people)):
        if t in chosen:
            continue
        nearest = int(known[np.argmin(np.abs(known - t))])
        if abs(times[t] - times[nearest]) > MAX_LINK_GAP_S:
            continue
        points = chosen[nearest].points
        pixels = reproject(np.nan_to_num(points), rig)
        for c in range(len(rig)):
            best = MOVED_PX_FACTOR * limits[c]  # the subject has moved since
            for i, person in enumerate(detections.people(t, c)):
                body = person[BODY_POINTS]
                seen = body[:, 2] >= min_confidence
                error, _ = _distance(pixels[:, c], np.isfinite(points[:, 0]), body, seen)
                if error < best:
                    best, people[t, c] = error, i
