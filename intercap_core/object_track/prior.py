"""What is known of a pose beside the frame's images: its place, its standing, an annotation."""

from __future__ import annotations

import numpy as np

from intercap_core.object_track.constants import (
    ANNOTATED_LOG_RATIO,
    ANNOTATION_LOG_RATIO,
    REACH_M,
    UNSEEN_S,
    UPRIGHT_LOG_RATIO,
)
from intercap_core.object_track.fit import Fit
from intercap_core.object_track.given_poses import GivenPose
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.steps import apart


class Prior:
    """Adds to the likelihoods of hypotheses what all frames and a person say.

    ``share`` is how many independent observations a frame is: errors last longer than a frame.
    ``given`` are the poses that a person gave, by the frame that they are of.
    """

    def __init__(self, observer: Observer, share: float) -> None:
        self._observer = observer
        self._share = share
        self.given: dict[int, GivenPose] = {}

    def near_given(self, times: np.ndarray, hidden: np.ndarray) -> np.ndarray:
        """Frames (T,) bool at ``times`` (T,), seconds, nearer to a given pose than the time that an
        object is followed unseen, where that pose is near to ``hidden`` frames (T,) as well."""
        found = np.zeros(len(times), bool)
        for t in self.given:
            near = np.abs(times - times[t]) < UNSEEN_S
            if hidden[near].any():
                found |= near
        return found

    def weigh(self, t: int, fits: list[Fit]) -> np.ndarray:
        """What speaks for hypotheses (K,) of frame t, against that none of them is true, nats.

        Poses that explain one thing are worth what that thing is by its place
        (:meth:`.places.Places.weigh`), and differ by what the images say.
        """
        mesh, places = self._observer.mesh, self._observer.places
        ratio = np.array([fit.log_ratio for fit in fits])
        found = ratio.copy()
        thing = things(fits)
        for number in range(thing.max(initial=-1) + 1):
            here = thing == number
            best = int(np.where(here, ratio, -np.inf).argmax())
            own = max(float(ratio[best]), 0.0)
            place = mesh.centre_at(fits[best].pose)
            found[here] -= own - places.weigh(t, place, own, self._share)
        if self._observer.up is not None:
            up = self._observer.up / np.linalg.norm(self._observer.up)
            found += UPRIGHT_LOG_RATIO * np.array([fit.pose[:3, 2] @ up for fit in fits])
        if t in self.given and fits:
            poses = np.array([fit.pose for fit in fits])
            _, shift = apart(mesh, self.given[t].pose[None], poses)
            squared = self.given[t].squared(mesh, poses)
            near = np.maximum(ANNOTATION_LOG_RATIO - 0.5 * squared, 0.0)
            found += (ANNOTATED_LOG_RATIO * (shift[0] < REACH_M) + near) / self._share
        return found


def things(fits: list[Fit]) -> np.ndarray:
    """Number (K,) of the thing that each hypothesis of a frame explains: those that mostly keep the
    same candidates explain one thing."""
    number = np.zeros(len(fits), int)
    leaders: list[np.ndarray] = []
    for k in sorted(range(len(fits)), key=lambda k: -fits[k].log_ratio):
        kept = np.array([view.candidate for view in fits[k].views])
        same = [int(((kept == other) & (kept >= 0)).sum()) for other in leaders]
        most = int(np.argmax(same)) if same else -1
        if most >= 0 and same[most] and 2 * same[most] >= int((kept >= 0).sum()):
            number[k] = most
        else:
            number[k] = len(leaders)
            leaders.append(kept)
    return number
