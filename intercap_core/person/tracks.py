"""People followed over time, and tracks of one person joined across gaps.

A *track* is a person followed without long gaps. After a gap (occluded, out of view, missed by the
detector) a new track begins. Tracks of one person are joined by position and build, the most likely
pair first. Build means the lengths of limbs, shoulders and trunk: they differ between people by
more than the error of their median over a track.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np

from intercap_core.body.keypoints import ARM_BONES, LEG_BONES, keypoint_pairs, of_side
from intercap_core.person.groups import MIN_DISTANCE_M, PersonGroup

# Standard deviations of thigh, shank, upper arm, forearm, shoulder width and trunk among adults,
# metres, measured over the shapes of the open body.
BUILD_SPREADS_M = (0.034, 0.027, 0.015, 0.023, 0.033, 0.025)
MAX_BODY_SPEED_M_S = 4.0  # largest speed of a body's centre; people run slower indoors; untuned
# Longest gap over which position alone identifies a person: for a detection in a single view, and
# for joined tracks to be free of doubt. Tuned on the studio: with double, an uncertain return is
# not reported (tests/person/test_subject.py).
MAX_LINK_GAP_S = 2.0
# Keypoint pairs of each length, (1 or 2, 2), in the order of BUILD_SPREADS_M. A limb has one pair
# for each side, whose lengths are averaged.
_BONES = (
    *(
        keypoint_pairs([*of_side("left", [bone]), *of_side("right", [bone])])
        for bone in (*LEG_BONES, *ARM_BONES)
    ),
    keypoint_pairs([("left_shoulder", "right_shoulder")]),
    keypoint_pairs([("neck", "mid_hip")]),
)


@dataclass(eq=False)
class PersonTrack:
    """One person followed from set to set."""

    groups: dict[int, PersonGroup]
    """The person by frame set, ascending."""

    @property
    def last(self) -> int:
        """The last frame set."""
        return next(reversed(self.groups))

    @cached_property
    def build(self) -> tuple[np.ndarray, np.ndarray]:
        """Median lengths (B,) of bones, metres, and their variances, m^2.

        Lengths known in fewer than five sets are 0 with infinite variance.
        """
        points = np.stack([group.points for group in self.groups.values()])
        lengths = np.stack([_lengths(points, bone) for bone in _BONES], axis=1)  # (N, B)
        count = np.isfinite(lengths).sum(0)
        enough = count >= 5
        length, variance = np.zeros(len(_BONES)), np.full(len(_BONES), np.inf)
        known = lengths[:, enough]
        length[enough] = np.nanmedian(known, axis=0)
        # 1.48 times the median absolute deviation estimates the standard deviation
        scatter = 1.48 * np.nanmedian(np.abs(known - length[enough]), axis=0)
        # variance of a median; errors of five neighbouring sets are correlated
        independent = np.maximum(count[enough] / 5, 1)
        # the bias of a detector by pose remains, 12 mm; tuned on the studio
        variance[enough] = 0.012**2 + np.pi / 2 * scatter**2 / independent
        return length, variance


def _lengths(points: np.ndarray, bone: np.ndarray) -> np.ndarray:
    """Lengths (N,) of a bone in points (N, 25, 3), averaged over the known sides; NaN = unknown."""
    sides = np.stack([np.linalg.norm(points[:, a] - points[:, b], axis=1) for a, b in bone])
    known = np.isfinite(sides)
    total = np.where(known, sides, 0.0).sum(0)
    return np.where(known.any(0), total / np.maximum(known.sum(0), 1), np.nan)


def link_groups(groups: Sequence[Sequence[PersonGroup]], times: np.ndarray) -> list[PersonTrack]:
    """Follow people from set to set over gaps of at most 0.4 s; link the closest pairs first."""
    tracks: list[PersonTrack] = []
    for t, in_set in enumerate(groups):
        # within 0.4 s position alone identifies a person; tuned on the studio
        free = [k for k in tracks if times[t] - times[k.last] <= 0.4]
        pairs = sorted(
            (group.distance(track.groups[track.last]), g, k)
            for g, group in enumerate(in_set)
            for k, track in enumerate(free)
        )
        gaps = [float(times[t] - times[track.last]) for track in free]
        used_groups: set[int] = set()
        used_tracks: set[int] = set()
        for distance, g, k in pairs:
            reach = MIN_DISTANCE_M + MAX_BODY_SPEED_M_S * gaps[k]
            if g in used_groups or k in used_tracks or distance > reach:
                continue
            used_groups.add(g)
            used_tracks.add(k)
            free[k].groups[t] = in_set[g]
        tracks += [
            PersonTrack({t: group}) for g, group in enumerate(in_set) if g not in used_groups
        ]
    return tracks


def same_build(first: PersonTrack, second: PersonTrack) -> float:
    """Log likelihood ratio of one person against two, by the lengths of bones; 0 = unknown.

    The difference of two lengths is normal. Its variance is the sum of the tracks' variances; for
    two people, that plus twice the squared spread among adults.
    """
    (a, own), (b, theirs) = first.build, second.build
    known = np.isfinite(own + theirs)
    apart = (a - b)[known] ** 2
    same = (own + theirs)[known]
    two = same + 2 * np.array(BUILD_SPREADS_M)[known] ** 2
    return float(0.5 * (np.log(two / same) + apart / two - apart / same).sum())


NEVER = -np.inf


@dataclass(frozen=True, eq=False)
class Person:
    """Tracks of one person."""

    parts: tuple[PersonTrack, ...]
    """Tracks in order of their first sets. The sets of one may lie between those of another. A
    common set shows the person in different cameras."""
    doubts: tuple[str, ...] = ()
    """Messages on doubtful joins."""

    @cached_property
    def track(self) -> PersonTrack:
        """All parts as one track."""
        groups: dict[int, PersonGroup] = {}
        for part in self.parts:
            for t, group in part.groups.items():
                groups[t] = groups[t].merged(group) if t in groups else group
        return PersonTrack({t: groups[t] for t in sorted(groups)})

    def shared(self, other: Person) -> list[tuple[int, PersonGroup, PersonGroup]]:
        """Sets that show both, with the group of each."""
        theirs = other.track.groups
        return [(t, group, theirs[t]) for t, group in self.track.groups.items() if t in theirs]

    def meets(self, other: Person) -> bool:
        """Whether a frame set shows the two as different people."""
        return any(not group.same_person(theirs) for _, group, theirs in self.shared(other))


def join_tracks(
    tracks: Sequence[PersonTrack], times: np.ndarray, together: Sequence[PersonTrack] = ()
) -> list[Person]:
    """Join the tracks of a recording to people, by agglomerative clustering.

    The pair of greatest likelihood is joined, until all remaining pairs are :data:`NEVER`.

    Args:
        times: (T,) seconds.
        together: tracks of one person by the user's statement; the first person of the result.
    """
    rest = [track for track in tracks if track not in together]
    people = [Person(_ordered(together))] if together else []
    people += [Person((track,)) for track in rest]
    pairs = {(id(a), id(b)): (_likelihood(a, b, times), a, b) for a, b in combinations(people, 2)}
    while pairs:
        likelihood, a, b = max(pairs.values(), key=lambda pair: pair[0])
        if likelihood == NEVER:
            break
        joined = Person(
            _ordered((*a.parts, *b.parts)), (*a.doubts, *b.doubts, *_doubt(a, b, times))
        )
        people = [joined if k is a else k for k in people if k is not b]
        gone = {id(a), id(b)}
        pairs = {ids: pair for ids, pair in pairs.items() if not gone & set(ids)}
        for k in people:
            if k is not joined:
                pairs[id(joined), id(k)] = (_likelihood(joined, k, times), joined, k)
    return people


def _ordered(parts: Sequence[PersonTrack]) -> tuple[PersonTrack, ...]:
    return tuple(sorted(parts, key=lambda track: min(track.groups)))


def _likelihood(first: Person, second: Person, times: np.ndarray) -> float:
    """Log likelihood ratio of one person against two, by build and motion.

    :data:`NEVER` if they are certainly two.
    """
    if first.meets(second):
        return NEVER
    result = 0.0
    for (before, earlier), (after, later) in _seams(first, second):
        apart = later.distance(earlier)
        gap = float(times[after] - times[before])
        if apart > MIN_DISTANCE_M + MAX_BODY_SPEED_M_S * gap:
            return NEVER
        # 1.2 m/s: a usual walk
        result -= 0.5 * (apart / (MIN_DISTANCE_M + 1.2 * gap)) ** 2
    alike = same_build(first.track, second.track)
    # below a ratio of -3 the builds contradict; tuned on the studio
    return result + alike if alike > -3.0 else NEVER


_Sighting = tuple[int, PersonGroup]  # frame set, and the person in it


def _seams(first: Person, second: Person) -> list[tuple[_Sighting, _Sighting]]:
    """Pairs of successive sightings, in order of time, of which one belongs to each person."""
    sightings = [
        (t, k, group)
        for k, person in enumerate((first, second))
        for t, group in person.track.groups.items()
    ]
    sightings.sort(key=lambda sighting: sighting[:2])
    return [((s, a), (t, b)) for (s, i, a), (t, k, b) in pairwise(sightings) if i != k]


def _doubt(first: Person, second: Person, times: np.ndarray) -> tuple[str, ...]:
    """Message on joining two people after a gap of over 2 s whose builds do not clearly agree."""
    gap, start = min((float(times[b] - times[a]), b) for (a, _), (b, _) in _seams(first, second))
    if gap <= MAX_LINK_GAP_S or same_build(first.track, second.track) >= 1.0:
        return ()
    return (
        f"the subject was not seen for {gap:.1f} s, and the build does not tell whether who is "
        f"seen from frame {start} on is the same person; if not, name the subject in both parts "
        "(annotation 'subject')",
    )
