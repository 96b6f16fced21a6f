"""Prior of places in the room over the whole recording: which of several similar things is the
object.

Another chair, a second cup: not everything of the object's class and size is the object. The object
is the one that the person handles: it moves, or the person is near it. A thing that stays in one
place from the first frame to the last with nobody near is another one, and so is a thing that is
visible in its place while the object is reliably tracked elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.constants import (
    ALWAYS_PRESENT,
    AT_HAND_M,
    BESIDE_FRAMES,
    CLUTTER_LOG_RATIO,
    MIN_PLACE_PRIOR,
    MOVED_PRIOR,
    NEAREST_QUANTILE,
    OUT_OF_REACH_M,
    SAME_PLACE_M,
    SAME_PLACE_SHARE,
    SEARCH_GOOD_LOG_RATIO,
    SOMETIMES_PRESENT,
    SUREST_PLACE,
    SURVEYED_FRAMES,
    SURVEYED_GROUPS,
    UNHANDLED_LOG_RATIO,
)
from intercap_core.object_track.groups import centre_of, find_groups
from intercap_core.object_track.view import View

_BODY_AND_HANDS = slice(0, 67)  # of the 135 keypoints; the face touches what the mouth does


@dataclass(eq=False)
class Standing:
    """A place (3,), metres, master frame, where something was in ``share`` of the surveyed frames,
    and in the frames of ``beside`` while the object was elsewhere."""

    place: np.ndarray
    share: float
    beside: set[int] = field(default_factory=set)


class Places:
    """Places where candidates were seen, each with the prior that the thing there is the object.

    ``joints`` (T, K, 3) of the person, NaN unknown, metres, master frame; None where no person is
    known.
    """

    def __init__(
        self, mesh: ObjectMesh, standing: list[Standing], joints: np.ndarray | None
    ) -> None:
        self._reach = 0.5 * mesh.radius
        self._same = SAME_PLACE_SHARE * mesh.diameter + SAME_PLACE_M
        self._joints = None if joints is None else joints[:, _BODY_AND_HANDS]
        self._standing = [(s, self._standing_prior(s)) for s in standing]
        self._clutter: list[tuple[np.ndarray, dict[int, float]]] = []
        self._others: list[np.ndarray] = []

    @classmethod
    def survey(
        cls,
        mesh: ObjectMesh,
        load: Callable[[int], list[View]],
        count: int,
        labels: tuple[str, ...],
        joints: np.ndarray | None,
    ) -> tuple[Places, list[int]]:
        """Look at a few of ``count`` frames; also those frames, the most promising first."""
        frames = sorted({int(t) for t in np.linspace(0, count - 1, SURVEYED_FRAMES).round()})
        seen = []
        for t in frames:
            groups = find_groups(mesh, load(t), labels, limit=SURVEYED_GROUPS)
            seen.append([(centre_of(g), sum(s.label_prior for s in g)) for g in groups])
        same = SAME_PLACE_SHARE * mesh.diameter + SAME_PLACE_M
        places = cls(mesh, _clusters(frames, seen, same), joints)
        best = [
            max((value * places.prior(t, place) for place, value in here), default=0.0)
            for t, here in zip(frames, seen, strict=True)
        ]
        order = np.argsort(-np.array(best), kind="stable")
        return places, [frames[i] for i in order if best[i] > 0]

    def prior(self, t: int, place: np.ndarray) -> float:
        """Prior, 0.1 to 1, that the thing at ``place`` (3,) in frame t is the object."""
        found = self._nearest(place)
        if found is None:
            return max(MOVED_PRIOR, _closeness(self._gaps(place, slice(t, t + 1))))
        standing, place_prior = found
        return MIN_PLACE_PRIOR if len(standing.beside) >= BESIDE_FRAMES else place_prior

    def weigh(self, t: int, place: np.ndarray, ratio: float, share: float) -> float:
        """What is left of ``ratio`` nats for the object at ``place`` (3,) in frame t.

        Where a thing stands for most of the recording, the images count no more than what is known
        of it: another thing of the object's class looks like the object. What is away from any
        such place moves, and mostly somebody moves it. ``share`` is how many independent
        observations a frame is.
        """
        if any(np.linalg.norm(other - place) < self._same for other in self._others):
            return min(ratio, 0.0) - CLUTTER_LOG_RATIO
        ratio -= self._like_the_object(place)
        found = self._nearest(place)
        if found is None or found[0].share < SOMETIMES_PRESENT:
            gaps = self._gaps(place, slice(t, t + 1))
            return ratio - (UNHANDLED_LOG_RATIO * (1 - _closeness(gaps)) if len(gaps) else 0.0)
        prior = min(self.prior(t, place), SUREST_PLACE)
        return min(ratio, float(np.log(prior / (1 - prior))) / share)

    def _nearest(self, place: np.ndarray) -> tuple[Standing, float] | None:
        """The known place at ``place`` (3,), if any, and its prior."""
        away = [float(np.linalg.norm(s.place - place)) for s, _ in self._standing]
        nearest = int(np.argmin(away)) if away else 0
        return self._standing[nearest] if away and away[nearest] < self._same else None

    def claim(self, place: np.ndarray) -> None:
        """Mark the thing at ``place`` (3,) as the object, wherever the person is."""
        self._standing = [
            (s, place_prior)
            for s, place_prior in self._standing
            if np.linalg.norm(s.place - place) >= self._same
        ]

    def seen_beside(self, t: int, place: np.ndarray, object_at: np.ndarray, ratio: float) -> None:
        """Record that something looks like the object at ``place`` (3,) in frame t, by ``ratio``
        nats, in which the object itself is at ``object_at`` (3,)."""
        found = self._nearest(place)
        apart = found is not None and np.linalg.norm(found[0].place - object_at) >= self._same
        if found is not None and apart and ratio > SEARCH_GOOD_LOG_RATIO:
            found[0].beside.add(t)
        likeness = self._likeness(place)
        if np.linalg.norm((place if likeness is None else likeness[0]) - object_at) < self._same:
            return
        if likeness is None:
            likeness = (place, {})
            self._clutter.append(likeness)
        likeness[1][t] = max(ratio, likeness[1].get(t, 0.0))

    def seen_beside_given(self, place: np.ndarray) -> None:
        """Record that something is seen at ``place`` (3,) in a frame in which somebody gave the
        object's pose elsewhere: it is another thing, in all frames."""
        if not any(np.linalg.norm(other - place) < self._same for other in self._others):
            self._others.append(place)

    def forget_clutter(self) -> None:
        """Forget how much the things beside the object look like it, before it is told anew."""
        self._clutter.clear()

    def _likeness(self, place: np.ndarray) -> tuple[np.ndarray, dict[int, float]] | None:
        """The clutter at ``place`` (3,), if any."""
        away = [float(np.linalg.norm(seen_at - place)) for seen_at, _ in self._clutter]
        nearest = int(np.argmin(away)) if away else 0
        return self._clutter[nearest] if away and away[nearest] < self._same else None

    def _like_the_object(self, place: np.ndarray) -> float:
        """Nats for the object of what stays at ``place`` (3,) while the object is elsewhere: no
        evidence that it is there now."""
        found = self._likeness(place)
        if found is None or len(found[1]) < BESIDE_FRAMES:
            return 0.0
        return min(float(np.mean(list(found[1].values()))), CLUTTER_LOG_RATIO)

    def _standing_prior(self, standing: Standing) -> float:
        handled = _closeness(self._gaps(standing.place, slice(None)))
        left = MOVED_PRIOR * min(
            (ALWAYS_PRESENT - standing.share) / (ALWAYS_PRESENT - SOMETIMES_PRESENT), 1.0
        )
        return max(handled, left, MIN_PLACE_PRIOR)

    def _gaps(self, place: np.ndarray, frames: slice) -> np.ndarray:
        """About how far (N,) the person is from an object there, metres, where that is known."""
        if self._joints is None:
            return np.zeros(0)
        distance = np.linalg.norm(self._joints[frames] - place, axis=-1)
        nearest = np.where(np.isfinite(distance), distance, np.inf).min(1)
        return np.maximum(nearest[np.isfinite(nearest)] - self._reach, 0.0)


def _closeness(gaps: np.ndarray) -> float:
    """Prior from the smallest of the distances (N,), metres: 1 within reach, 0.1 far away or
    unknown."""
    gap = float(np.quantile(gaps, NEAREST_QUANTILE)) if len(gaps) else np.inf
    return float(
        np.clip((OUT_OF_REACH_M - gap) / (OUT_OF_REACH_M - AT_HAND_M), MIN_PLACE_PRIOR, 1.0)
    )


def _clusters(
    frames: list[int], seen: list[list[tuple[np.ndarray, float]]], same: float
) -> list[Standing]:
    """Places in which something was ``seen`` in more than one of the ``frames``."""
    every = [(t, place) for t, here in zip(frames, seen, strict=True) for place, _ in here]
    places = np.array([place for _, place in every]).reshape(-1, 3)
    frame = np.array([t for t, _ in every], int)
    free = np.ones(len(every), bool)
    looked = sum(1 for here in seen if here)
    found: list[Standing] = []
    while free.any():
        together = (np.linalg.norm(places[:, None] - places, axis=-1) < same) & free
        counts = np.array([len(set(frame[row])) for row in together])
        best = int(np.where(free, counts, -1).argmax())
        if counts[best] < 2:
            break
        members = together[best]
        found.append(Standing(places[members].mean(0), counts[best] / max(looked, 1)))
        free &= ~members
    return found
