"""Which sequences train and which test, so that no subject, or no object, is in both."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

TRAIN, TEST = "train", "test"


@dataclass(frozen=True)
class Split:
    """``test``: the groups (subjects or objects) that are held out; ``train``: the others. ``why``
    it is none, "" = it is one."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    why: str = ""

    def of(self, group: str) -> str:
        """Where a group's sequences belong; "" of a sequence that has none."""
        if not group:
            return ""
        return TEST if group in self.test else TRAIN


def split(frames: Mapping[str, int], *, share: float, named: Sequence[str] = ()) -> Split:
    """Hold out groups whose ``frames`` come near to ``share`` of all.

    Groups are taken in the order of a digest of their names, so that the choice has nothing to do
    with how they are named or numbered, and the same groups give the same split. Those ``named``
    are held out instead, where any are; names that no group has are let be.
    """
    groups = sorted(frames, key=lambda name: hashlib.sha256(name.encode()).digest())
    if named:
        test = {name for name in named if name in frames}
        why = "" if test else f"none of {', '.join(named)} has a sequence"
        if test == set(frames):
            test, why = set(), "all there are would be held out"
        return _of(frames, test, why)
    if len(groups) < 2 or share <= 0:
        why = "there is only one" if len(groups) == 1 else "there is none"
        return _of(frames, set(), why if share > 0 else "none is asked for")
    goal, taken, test = share * sum(frames.values()), 0, set()
    for name in groups:
        left = len(groups) - len(test) > 1
        if left and abs(taken + frames[name] - goal) < abs(taken - goal):
            test.add(name)
            taken += frames[name]
    return _of(frames, test or {min(groups, key=frames.__getitem__)}, "")


def _of(frames: Mapping[str, int], test: set[str], why: str) -> Split:
    return Split(tuple(sorted(set(frames) - test)), tuple(sorted(test)), why)
