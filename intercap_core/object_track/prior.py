"""What is known of a pose beside the frame's images: its place, its standing, an annotation."""

from __future__ import annotations

import numpy as np

from intercap_core.object_track.constants import ANNOTATION_LOG_RATIO, UPRIGHT_LOG_RATIO
from intercap_core.object_track.fit import Fit
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.search import same_pose


class Prior:
    """Adds to the likelihoods of hypotheses what all frames and a person say.

    ``share`` is how many independent observations a frame is: errors last longer than a frame.
    ``annotated`` is the frame and the pose (4, 4) that a person gave, fitted.
    """

    def __init__(self, observer: Observer, share: float) -> None:
        self._observer = observer
        self._share = share
        self.annotated: tuple[int, np.ndarray] | None = None

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
        if self.annotated is not None and self.annotated[0] == t:
            given = [same_pose(mesh, fit.pose, self.annotated[1]) for fit in fits]
            found += ANNOTATION_LOG_RATIO / self._share * np.array(given, bool)
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
