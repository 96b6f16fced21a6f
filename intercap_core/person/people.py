"""Tracks that are of one person: who was lost, or left and came back, known again by place and
build.

The pair of people who are likeliest one is joined first, so that a gap is filled by who fits it
best, and not by who happens to be looked at first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np

from intercap_core.person.constants import (
    LINK_SLACK_M,
    MAX_BODY_SPEED_M_S,
    MAX_LINK_GAP_S,
    OTHER_BUILD,
    SURE_BUILD,
    WALKING_SPEED_M_S,
)
from intercap_core.person.tracks import Track, same_build

NEVER = -np.inf


@dataclass(frozen=True, eq=False)
class Person:
    """``parts``: tracks that do not overlap, in order of time; ``doubts``: what speaks against that
    they are of one person, in words."""

    parts: tuple[Track, ...]
    doubts: tuple[str, ...] = field(default=())

    @cached_property
    def whole(self) -> Track:
        """All parts as one track."""
        whole = Track()
        for part in self.parts:
            whole.sets += part.sets
            whole.groups += part.groups
        return whole

    def meets(self, other: Person) -> bool:
        """Whether two people are surely two: parts of them overlap in time."""
        return any(
            a.sets[0] <= b.sets[-1] and b.sets[0] <= a.sets[-1]
            for a in self.parts
            for b in other.parts
        )


def people_of(
    tracks: Sequence[Track], times: np.ndarray, together: Sequence[Track] = ()
) -> list[Person]:
    """The people of a recording; ``times`` (T,) s. Those ``together``, some of the ``tracks`` that
    do not overlap, are one person whatever speaks against it, and that person is the first."""
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


def _ordered(parts: Sequence[Track]) -> tuple[Track, ...]:
    return tuple(sorted(parts, key=lambda track: track.sets[0]))


def _likelihood(one: Person, other: Person, times: np.ndarray) -> float:
    """Logarithm of how much more likely one person than two are, by build and by the ways between;
    :data:`NEVER` where it cannot be one."""
    if one.meets(other):
        return NEVER
    found = 0.0
    for before, after in _seams(one, other):
        apart = float(np.linalg.norm(after.groups[0].centre - before.groups[-1].centre))
        gap = float(times[after.sets[0]] - times[before.sets[-1]])
        if apart > LINK_SLACK_M + MAX_BODY_SPEED_M_S * gap:
            return NEVER
        found -= 0.5 * (apart / (LINK_SLACK_M + WALKING_SPEED_M_S * gap)) ** 2
    alike = same_build(one.whole, other.whole)
    return found + alike if alike > OTHER_BUILD else NEVER


def _seams(one: Person, other: Person) -> list[tuple[Track, Track]]:
    """Where, in order of time, a part of one person follows a part of the other."""
    own = set(map(id, one.parts))
    parts = _ordered((*one.parts, *other.parts))
    return [(a, b) for a, b in pairwise(parts) if (id(a) in own) != (id(b) in own)]


def _doubt(one: Person, other: Person, times: np.ndarray) -> tuple[str, ...]:
    """What is said of joining two after a gap over which nobody can be followed."""
    gap, start = min(
        (float(times[b.sets[0]] - times[a.sets[-1]]), b.sets[0]) for a, b in _seams(one, other)
    )
    if gap <= MAX_LINK_GAP_S or same_build(one.whole, other.whole) >= SURE_BUILD:
        return ()
    return (
        f"the subject was not seen for {gap:.1f} s, and the build does not tell whether who is "
        f"seen from frame {start} on is the same person; if not, name the subject in both parts "
        "(annotation 'subject')",
    )
