"""One frame of a track: its pose, and what there is to say against it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.constants import CARRIED_M, UNSURE_M, UNSURE_RAD
from intercap_core.object_track.fit import Fit


@dataclass(frozen=True)
class FrameResult:
    """One frame of the track.

    ``lost``: none of the hypotheses is believed; ``gone``: it has left the room, by all frames;
    ``ambiguous``: a quite different pose may be the
    true one; ``probability`` of the pose's hypothesis given all frames; ``spread`` (6, 6), the
    covariance of (turn on the left, shift) that the other hypotheses add to the fit's;
    ``recovered``: the first frame that is not lost after lost ones; ``free_axis`` (3,), master
    frame: a turn about it through the object's origin changes nothing that was seen, 0 = there is
    none; ``carried``: nothing shows the object, and the pose follows from given ones.
    """

    fit: Fit
    lost: bool
    gone: bool = False
    ambiguous: bool = False
    probability: float = 1.0
    spread: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    recovered: bool = False
    resting: bool = False
    free_axis: np.ndarray = field(default_factory=lambda: np.zeros(3))
    carried: bool = False


def flagged(mesh: ObjectMesh, frames: list[FrameResult]) -> list[FrameResult]:
    """The frames (T) of a final track, lost where their covariance leaves the place open and
    ambiguous where it leaves the turn; the first after lost ones is recovered.

    One that is carried from given poses is ambiguous where either is open, and lost where it is as
    good as unknown.
    """
    result: list[FrameResult] = []
    for frame in frames:
        # other hypotheses count by their probability, not by how far away they are
        shift, turn = _deviations(mesh, frame.fit.pose, frame.fit.covariance)
        lost = frame.lost or shift > (CARRIED_M if frame.carried else UNSURE_M)
        unsure = frame.ambiguous or turn > UNSURE_RAD or shift > UNSURE_M
        recovered = bool(result) and result[-1].lost and not lost
        result.append(
            replace(
                frame,
                lost=lost,
                ambiguous=unsure and not lost,
                recovered=recovered,
                carried=frame.carried and not lost,
            )
        )
    return result


def _deviations(mesh: ObjectMesh, pose: np.ndarray, covariance: np.ndarray) -> tuple[float, float]:
    """Standard deviations of the centre, metres, in its worst direction, and of the rotation,
    radians, about its worst axis, but for those of its symmetry."""
    arm = pose[:3, :3] @ mesh.centre_of_mass
    about = np.cross(np.eye(3), arm)  # row i: shift of the centre by a turn about axis i
    to_centre = np.concatenate([about.T, np.eye(3)], axis=1)
    shift = to_centre @ covariance @ to_centre.T
    turn = covariance[:3, :3]
    if mesh.symmetry.sphere:
        turn = np.zeros((3, 3))
    elif mesh.symmetry.axis is not None:
        axis = pose[:3, :3] @ mesh.symmetry.axis
        across = np.eye(3) - np.outer(axis, axis)
        turn = across @ turn @ across
    return _deviation(shift, -1), _deviation(turn, -1)


def _deviation(covariance: np.ndarray, number: int) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[number], 0.0)))
