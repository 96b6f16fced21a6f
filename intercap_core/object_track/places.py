"""Prior of positions in the room: which of several similar objects is the tracked one.

Another chair, a second cup: not every object of the class and size is the tracked object. The
tracked object is the one that the person handles: it moves, or the person is near it. Two kinds of
objects are others: those that stay in one place in all frames with nobody near, and those that are
visible in their place while the tracked object is elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.groups import find_groups, locate_group
from intercap_core.object_track.likelihood import DECISIVE_LOG_RATIO
from intercap_core.object_track.view import View

# A place that is occupied in less than this share of the surveyed frames belongs to a moving
# object.
SOMETIMES_PRESENT = 0.5  # tuned
MOVED_PRIOR = 0.8  # prior of an object that was not in its place all the time; tuned
MIN_PLACE_PRIOR = 0.1  # prior of an object that stands far from the person all the time; tuned
# Upper limit, in nats, of one frame's evidence against a place that probably shows another object:
# no person is near it, or a similar object was visible there while the tracked object was
# elsewhere. The evidence is limited because the track may have confused the two objects.
OTHER_OBJECT_LOG_RATIO = 10.0  # tuned


@dataclass(eq=False)
class OccupiedPlace:
    """A place where candidates were seen in several surveyed frames."""

    place: np.ndarray
    """(3,) position, metres, master frame."""
    share: float
    """Share of the surveyed frames in which it was occupied."""
    prior: float = MIN_PLACE_PRIOR
    """Prior over the recording that the tracked object is there."""
    rival_frames: set[int] = field(default_factory=set)
    """Frames in which it was occupied while the object was elsewhere."""


class Places:
    """Places where candidates were seen, with the prior that the tracked object is there."""

    def __init__(self, mesh: ObjectMesh, standing: list[OccupiedPlace], joints: np.ndarray) -> None:
        """Initialise the prior from occupied places, whose own priors are computed.

        Args:
            mesh: the object.
            standing: occupied places.
            joints: (T, K, 3) of the person, master frame, metres; NaN = unknown.
        """
        self._reach = 0.5 * mesh.radius  # from the object's centre to its surface, about
        self._same = _same_place_m(mesh)
        self._joints = joints[:, :67]  # body and hands, no face
        self._standing = [replace(s, prior=self._standing_prior(s)) for s in standing]
        # places (3,) of similar objects, each with its log-likelihood ratio by frame
        self._clutter: list[tuple[np.ndarray, dict[int, float]]] = []
        self._others: list[np.ndarray] = []  # places (3,) that annotated poses exclude

    @classmethod
    def survey(
        cls,
        mesh: ObjectMesh,
        load: Callable[[int], list[View]],
        count: int,
        labels: tuple[str, ...],
        joints: np.ndarray,
    ) -> tuple[Places, list[int]]:
        """Survey a few frames of the recording.

        Args:
            mesh: the object.
            load: returns the views of a frame.
            count: number of frames.
            labels: detector classes of the object.
            joints: (T, K, 3) of the person, as in the constructor.

        Returns:
            The places, and the surveyed frames with candidates, the most promising first.
        """
        frames = sorted({int(t) for t in np.linspace(0, count - 1, 12).round()})
        seen = []
        for t in frames:
            groups = find_groups(mesh, load(t), labels, limit=6)
            seen.append([(locate_group(g), sum(s.label_prior for s in g)) for g in groups])
        places = cls(mesh, _cluster_places(frames, seen, _same_place_m(mesh)), joints)
        best = [
            max((value * places.prior(t, place) for place, value in here), default=0.0)
            for t, here in zip(frames, seen, strict=True)
        ]
        order = np.argsort(-np.array(best), kind="stable")
        return places, [frames[i] for i in order if best[i] > 0]

    def prior(self, t: int, place: np.ndarray) -> float:
        """Return the prior, 0.1 to 1, that the tracked object is at ``place`` (3,) in frame t.

        Away from known places it is ``MOVED_PRIOR``, or more near the person. In a known place it
        is that of the whole recording, or ``MIN_PLACE_PRIOR`` if another object stands there: the
        place was occupied in at least two frames while the tracked object was elsewhere.
        """
        nearest = self._nearest(place)
        if nearest is None:
            return max(MOVED_PRIOR, _closeness(self._gaps(place, slice(t, t + 1))))
        return MIN_PLACE_PRIOR if len(nearest.rival_frames) >= 2 else nearest.prior

    def weigh(self, t: int, place: np.ndarray, ratio: float, share: float) -> float:
        """Combine the images' evidence for the object at ``place`` (3,) in frame t with its prior.

        1. In an excluded place the images count only against the object, and the place costs
           ``OTHER_OBJECT_LOG_RATIO``. Elsewhere the evidence of a similar object there is
           subtracted.
        2. In a place that is occupied for most of the recording, the result is at most the log odds
           of the prior: another object of the class looks like the tracked one.
        3. Elsewhere the object moves: up to ``OTHER_OBJECT_LOG_RATIO`` is subtracted if the person
           is not near.

        Args:
            t: frame.
            place: (3,) position, master frame.
            ratio: log-likelihood ratio of the images, nats.
            share: independent observations per frame.

        Returns:
            Log-likelihood ratio with the prior, nats.
        """
        if self._index(self._others, place) is not None:
            return min(ratio, 0.0) - OTHER_OBJECT_LOG_RATIO
        ratio -= self._clutter_ratio(place)
        nearest = self._nearest(place)
        if nearest is None or nearest.share < SOMETIMES_PRESENT:
            gaps = self._gaps(place, slice(t, t + 1))
            return ratio - (OTHER_OBJECT_LOG_RATIO * (1 - _closeness(gaps)) if len(gaps) else 0.0)
        prior = min(self.prior(t, place), 1 - 1e-6)
        return min(ratio, float(np.log(prior / (1 - prior))) / share)

    def _nearest(self, place: np.ndarray) -> OccupiedPlace | None:
        """Return the known place at ``place`` (3,), if any."""
        index = self._index([s.place for s in self._standing], place)
        return None if index is None else self._standing[index]

    def _index(self, places: list[np.ndarray], place: np.ndarray) -> int | None:
        """Return the index of the nearest of ``places`` if it is the same place as ``place``."""
        away = [float(np.linalg.norm(other - place)) for other in places]
        nearest = int(np.argmin(away)) if away else 0
        return nearest if away and away[nearest] < self._same else None

    def claim(self, place: np.ndarray) -> None:
        """Treat the object at ``place`` (3,) as the tracked one, even if nobody is near it.

        Its place is removed from the known places.
        """
        self._standing = [
            s for s in self._standing if np.linalg.norm(s.place - place) >= self._same
        ]

    def add_rival(self, t: int, place: np.ndarray, object_at: np.ndarray, ratio: float) -> None:
        """Record a similar object at ``place`` (3,) in frame t, the tracked one at ``object_at``.

        ``ratio`` is the images' log-likelihood ratio for the similar object, nats.
        """
        nearest = self._nearest(place)
        apart = nearest is not None and np.linalg.norm(nearest.place - object_at) >= self._same
        if nearest is not None and apart and ratio > DECISIVE_LOG_RATIO:
            nearest.rival_frames.add(t)
        clutter = self._clutter_at(place) or (place, {})
        if np.linalg.norm(clutter[0] - object_at) < self._same:
            return
        if not clutter[1]:
            self._clutter.append(clutter)
        clutter[1][t] = max(ratio, clutter[1].get(t, 0.0))

    def exclude(self, place: np.ndarray) -> None:
        """Exclude ``place`` (3,) in all frames.

        The images show an object there in a frame whose annotated pose is elsewhere.
        """
        if self._index(self._others, place) is None:
            self._others.append(place)

    def clear_rivals(self) -> None:
        """Clear the similar objects of :meth:`add_rival`, before they are recorded again.

        ``rival_frames`` of the occupied places stay.
        """
        self._clutter.clear()

    def _clutter_at(self, place: np.ndarray) -> tuple[np.ndarray, dict[int, float]] | None:
        """Return the recorded clutter at ``place`` (3,), if any."""
        index = self._index([seen_at for seen_at, _ in self._clutter], place)
        return None if index is None else self._clutter[index]

    def _clutter_ratio(self, place: np.ndarray) -> float:
        """Return the evidence, nats, of a similar object that stays at ``place`` (3,).

        It is no evidence for the tracked object there. An object that was seen once does not count.
        """
        clutter = self._clutter_at(place)
        if clutter is None or len(clutter[1]) < 2:
            return 0.0
        return min(float(np.mean(list(clutter[1].values()))), OTHER_OBJECT_LOG_RATIO)

    def _standing_prior(self, standing: OccupiedPlace) -> float:
        """Return the prior of a known place over the recording.

        It is high if the person comes near, or if the place was vacant for a part of the time.
        """
        handled = _closeness(self._gaps(standing.place, slice(None)))
        always = 0.85  # share of the frames in which an object is seen that never leaves; tuned
        left = MOVED_PRIOR * min((always - standing.share) / (always - SOMETIMES_PRESENT), 1.0)
        return max(handled, left, MIN_PLACE_PRIOR)

    def _gaps(self, place: np.ndarray, frames: slice) -> np.ndarray:
        """Return the person's distance from an object at ``place`` in N frames, metres.

        Frames without known joints are left out.
        """
        distance = np.linalg.norm(self._joints[frames] - place, axis=-1)
        nearest = np.where(np.isfinite(distance), distance, np.inf).min(1)
        return np.maximum(nearest[np.isfinite(nearest)] - self._reach, 0.0)


def _same_place_m(mesh: ObjectMesh) -> float:
    """Return the distance, metres, within which two positions are the same place.

    Positions of one object differ, since views see different sides of it.
    """
    return 0.3 * mesh.diameter + 0.05


def _closeness(gaps: np.ndarray) -> float:
    """Return the prior from distances (N,) to the person, metres.

    It is 1 within 0.10 m and falls to 0.1 toward 0.45 m; 0.1 if no distance is known. The 10 %
    quantile of the distances decides, because nobody is near the object all the time.
    """
    at_hand_m, out_of_reach_m = 0.10, 0.45
    gap = float(np.quantile(gaps, 0.1)) if len(gaps) else np.inf
    share = (out_of_reach_m - gap) / (out_of_reach_m - at_hand_m)
    return float(np.clip(share, MIN_PLACE_PRIOR, 1.0))


def _cluster_places(
    frames: list[int], seen: list[list[tuple[np.ndarray, float]]], same: float
) -> list[OccupiedPlace]:
    """Cluster the positions of candidates; return clusters seen in two or more of the ``frames``.

    The position with neighbours (within ``same`` metres) in most frames forms a cluster with them;
    this is repeated for the rest. ``seen`` [frames] lists positions (3,) and their label priors.
    """
    every = [(t, place) for t, here in zip(frames, seen, strict=True) for place, _ in here]
    places = np.array([place for _, place in every]).reshape(-1, 3)
    frame = np.array([t for t, _ in every], int)
    free = np.ones(len(every), bool)
    looked = sum(1 for here in seen if here)
    occupied: list[OccupiedPlace] = []
    while free.any():
        together = (np.linalg.norm(places[:, None] - places, axis=-1) < same) & free
        counts = np.array([len(set(frame[row])) for row in together])
        best = int(np.where(free, counts, -1).argmax())
        if counts[best] < 2:
            break
        members = together[best]
        occupied.append(OccupiedPlace(places[members].mean(0), counts[best] / max(looked, 1)))
        free &= ~members
    return occupied
