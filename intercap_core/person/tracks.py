"""People followed over time in space, and whether two tracks are of one person.

Who cannot be followed (hidden, out of view, missed by a detector for long) is known again by build:
the lengths of limbs, shoulders and trunk, which differ between people by more than a track's median
errs by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.person.constants import (
    BUILD_FLOOR_M,
    BUILD_SPREADS_M,
    FOLLOWED_GAP_S,
    LINK_SLACK_M,
    MAX_BODY_SPEED_M_S,
    MIN_BUILD_SETS,
)
from intercap_core.person.groups import Group

_PLACE = {name: index for index, name in enumerate(KEYPOINT_NAMES)}


def _both_sides(first: str, second: str) -> tuple[tuple[int, int], ...]:
    return tuple((_PLACE[f"{s}_{first}"], _PLACE[f"{s}_{second}"]) for s in ("left", "right"))


# In the order of BUILD_SPREADS_M; where both sides have a bone, the mean of the two is looked at.
_BONES: tuple[tuple[tuple[int, int], ...], ...] = (
    _both_sides("hip", "knee"),
    _both_sides("knee", "ankle"),
    _both_sides("shoulder", "elbow"),
    _both_sides("elbow", "wrist"),
    ((_PLACE["left_shoulder"], _PLACE["right_shoulder"]),),
    ((_PLACE["neck"], _PLACE["mid_hip"]),),
)


@dataclass(eq=False)
class Track:
    """One person from set to set: ``sets`` (N,), rising, and the ``groups`` of them."""

    sets: list[int] = field(default_factory=list)
    groups: list[Group] = field(default_factory=list)

    @cached_property
    def build(self) -> tuple[np.ndarray, np.ndarray]:
        """Lengths (B,) of the bones, metres, medians over time, and their variance; infinite where
        too few sets tell."""
        points = np.stack([group.points for group in self.groups])
        lengths = np.stack([_lengths(points, bone) for bone in _BONES], axis=1)  # (N, B)
        count = np.isfinite(lengths).sum(0)
        enough = count >= MIN_BUILD_SETS
        length, variance = np.zeros(len(_BONES)), np.full(len(_BONES), np.inf)
        known = lengths[:, enough]
        length[enough] = np.nanmedian(known, axis=0)
        scatter = 1.48 * np.nanmedian(np.abs(known - length[enough]), axis=0)
        # a median's variance; errors of neighbouring sets are alike
        independent = np.maximum(count[enough] / MIN_BUILD_SETS, 1)
        variance[enough] = BUILD_FLOOR_M**2 + np.pi / 2 * scatter**2 / independent
        return length, variance


def _lengths(points: np.ndarray, bone: tuple[tuple[int, int], ...]) -> np.ndarray:
    """Lengths (N,) of a bone in points (N, 25, 3), the mean of the sides that are known."""
    sides = np.stack([np.linalg.norm(points[:, a] - points[:, b], axis=1) for a, b in bone])
    known = np.isfinite(sides)
    total = np.where(known, sides, 0.0).sum(0)
    return np.where(known.any(0), total / np.maximum(known.sum(0), 1), np.nan)


def link(groups: Sequence[Sequence[Group]], times: np.ndarray) -> list[Track]:
    """Follow the people of each set (T lists) over short gaps, nearest first; ``times`` (T,) s."""
    tracks: list[Track] = []
    for t, in_set in enumerate(groups):
        free = [k for k in tracks if times[t] - times[k.sets[-1]] <= FOLLOWED_GAP_S]
        pairs = sorted(
            (float(np.linalg.norm(group.centre - track.groups[-1].centre)), g, k)
            for g, group in enumerate(in_set)
            for k, track in enumerate(free)
        )
        gaps = [float(times[t] - times[track.sets[-1]]) for track in free]
        used_groups: set[int] = set()
        used_tracks: set[int] = set()
        for distance, g, k in pairs:
            reach = LINK_SLACK_M + MAX_BODY_SPEED_M_S * gaps[k]
            if g in used_groups or k in used_tracks or distance > reach:
                continue
            used_groups.add(g)
            used_tracks.add(k)
            free[k].sets.append(t)
            free[k].groups.append(in_set[g])
        tracks += [Track([t], [group]) for g, group in enumerate(in_set) if g not in used_groups]
    return tracks


def same_build(one: Track, other: Track) -> float:
    """How much more likely the two tracks' bones are of one person than of two: the logarithm of
    the ratio, 0 = nothing is known. Normal errors of the tracks, normal spreads among people."""
    (a, own), (b, theirs) = one.build, other.build
    known = np.isfinite(own + theirs)
    apart = (a - b)[known] ** 2
    same = (own + theirs)[known]
    two = same + 2 * np.array(BUILD_SPREADS_M)[known] ** 2
    return float(0.5 * (np.log(two / same) + apart / two - apart / same).sum())
