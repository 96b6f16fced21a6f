"""Which poses are not to be believed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from intercap_core.config import ObjectTrackSettings
from intercap_core.tracking.fit import Fit

LOST_SCORE = 0.20
# By how much the mean score of one pose has to be better than another's, over all frames of a run
# and over one: errors of masks last several frames and agree over views.
DECIDED, DECIDED_ONE = 0.01, 0.03
UNNAMED_FRAMES, UNNAMED_M = 4, 0.05  # that the object is followed without any candidate


@dataclass(frozen=True)
class FrameResult:
    """One frame of the track.

    ``leapt``: a search found its pose, away from where tracking had it; ``recovered``: the first
    frame that is not lost after lost ones or a leap; ``disagree``: the passes ended in different
    poses and the images do not decide between them; ``ambiguous``: a quite different pose explains
    the images nearly as well; ``free_axis`` (3,), master frame: a turn about it through the
    object's origin changes nothing that was seen, 0 = there is none.
    """

    fit: Fit
    lost: bool
    leapt: bool = False
    recovered: bool = False
    disagree: bool = False
    ambiguous: bool = False
    resting: bool = False
    free_axis: np.ndarray = field(default_factory=lambda: np.zeros(3))


def judged(fit: Fit, settings: ObjectTrackSettings) -> FrameResult:
    """A fit, lost where the images do not bear it out."""
    lost = fit.support == 0 or fit.score < LOST_SCORE
    lost |= 0 < fit.mean_overlap < settings.lost_overlap
    return FrameResult(fit, lost)


def decided(gain: np.ndarray) -> bool:
    """Whether the images decide between two poses by the differences (N,) of their scores."""
    return bool(
        len(gain) and abs(gain.mean()) > DECIDED + (DECIDED_ONE - DECIDED) / np.sqrt(len(gain))
    )


class Named:
    """Where a candidate last bore the track out: depth alone fits the floor as well as a box.

    ``place`` (3,), metres, is where the track starts.
    """

    def __init__(self, place: np.ndarray) -> None:
        self._place = place
        self._frames = 0

    def believes(self, place: np.ndarray, fit: Fit) -> bool:
        """Whether the object may be at ``place`` (3,): some view's candidate shows it, or one did
        a few frames ago, or there; where no detector looked, always."""
        looked = any(view.detected for view in fit.views)
        if not looked or any(view.candidate >= 0 for view in fit.views):
            self._place, self._frames = place, 0
            return True
        self._frames += 1
        stayed = float(np.linalg.norm(place - self._place)) < UNNAMED_M
        return self._frames <= UNNAMED_FRAMES or stayed
