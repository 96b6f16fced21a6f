"""Which poses count as lost."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from intercap_core.config import ObjectTrackSettings
from intercap_core.object_track.constants import (
    DECIDED_FRAME,
    DECIDED_RUN,
    LOST_SCORE,
    UNNAMED_FRAMES,
    UNNAMED_M,
    UNSURE_M,
    UNSURE_RAD,
)
from intercap_core.object_track.fit import Fit
from intercap_core.rigid.mesh import ObjectMesh


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

    @property
    def score(self) -> float:
        """The fit's agreement with the images, 0 where it is not believed."""
        return 0.0 if self.lost else self.fit.score


def judged(fit: Fit, settings: ObjectTrackSettings) -> FrameResult:
    """A fit, lost where the images do not support it."""
    lost = fit.support == 0 or fit.score < LOST_SCORE
    lost |= 0 < fit.mean_overlap < settings.lost_overlap
    return FrameResult(fit, lost)


def decided(gain: np.ndarray) -> bool:
    """Whether the images decide between two poses by the differences (N,) of their scores."""
    return bool(
        len(gain)
        and abs(gain.mean()) > DECIDED_RUN + (DECIDED_FRAME - DECIDED_RUN) / np.sqrt(len(gain))
    )


class DetectionSupport:
    """The last place where a detection supported the track: depth alone also matches a floor.

    ``place`` (3,), metres, is where the track starts.
    """

    def __init__(self, place: np.ndarray) -> None:
        self._place = place
        self._frames = 0

    def believes(self, place: np.ndarray, fit: Fit) -> bool:
        """Whether the object may be at ``place`` (3,): a candidate of some view supports it, or one
        did a few frames ago or near this place. Always true where no detector ran."""
        looked = any(view.detected for view in fit.views)
        if not looked or any(view.candidate >= 0 for view in fit.views):
            self._place, self._frames = place, 0
            return True
        self._frames += 1
        stayed = float(np.linalg.norm(place - self._place)) < UNNAMED_M
        return self._frames <= UNNAMED_FRAMES or stayed


def doubted(mesh: ObjectMesh, frames: list[FrameResult]) -> list[FrameResult]:
    """The frames (T) of a final track, those flagged that nothing supports for long or that may be
    elsewhere by their covariance: lost where the place is not known, ambiguous where the turn is
    not."""
    later = _unnamed(mesh, frames)
    sooner = _unnamed(mesh, frames[::-1])[::-1]
    result = []
    for frame, unnamed in zip(frames, later & sooner, strict=True):
        shift, turn = _deviations(mesh, frame.fit)
        lost = frame.lost or bool(unnamed) or shift > UNSURE_M
        unsure = frame.ambiguous or turn > UNSURE_RAD
        result.append(replace(frame, lost=lost, ambiguous=unsure and not lost))
    return result


def _unnamed(mesh: ObjectMesh, frames: list[FrameResult]) -> np.ndarray:
    """Which frames (T) no candidate supports, seen from those before."""
    places = [mesh.centre_at(frame.fit.pose) for frame in frames]
    named = DetectionSupport(places[0])
    believed = [named.believes(at, frame.fit) for at, frame in zip(places, frames, strict=True)]
    return ~np.array(believed)


def _deviations(mesh: ObjectMesh, fit: Fit) -> tuple[float, float]:
    """Standard deviations of the centre, metres, in its worst direction, and of the rotation,
    radians, about its second worst axis: the ambiguity about a single axis (on which side a handle
    is) is resolved in :mod:`.turns`."""
    arm = fit.pose[:3, :3] @ mesh.centre_of_mass
    about = np.cross(np.eye(3), arm)  # row i: shift of the centre by a turn about axis i
    to_centre = np.concatenate([about.T, np.eye(3)], axis=1)
    shift = to_centre @ fit.covariance @ to_centre.T
    turn = fit.covariance[:3, :3]
    if mesh.symmetry.sphere:
        turn = np.zeros((3, 3))
    elif mesh.symmetry.axis is not None:
        axis = fit.pose[:3, :3] @ mesh.symmetry.axis
        across = np.eye(3) - np.outer(axis, axis)
        turn = across @ turn @ across
    return _deviation(shift, -1), _deviation(turn, -2)


def _deviation(covariance: np.ndarray, number: int) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[number], 0.0)))
