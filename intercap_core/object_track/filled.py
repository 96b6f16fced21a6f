"""The frames in which the object is lost, filled in as motion and images say together."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from intercap_core.geometry.camera.transforms import step_between
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.time_series import rigid_velocity
from intercap_core.object_track.bridges import Bridge, Gap
from intercap_core.object_track.constants import (
    CARRIED_LOG_RATIO,
    CONTRADICTED_LOG_RATIO,
    FIT_ROUNDS,
    UNSEEN_S,
    UNSURE_M,
    UNSURE_RAD,
)
from intercap_core.object_track.fit import Fit, MotionPrior
from intercap_core.object_track.motion import unwrapped
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.steps import apart


@dataclass(frozen=True)
class Filled:
    """``poses`` (T, 4, 4) of all frames; what a ``hand`` and the ``images`` (T, 6, 6) tell of those
    lost ones that a hand carries the object through, where both agree, and how the hand's motion
    ``pull`` s there (T, 6), as much as the images the other way; and in which frames it is ``sure``
    (T,) that a hand does."""

    poses: np.ndarray
    hand: np.ndarray
    images: np.ndarray
    pull: np.ndarray
    sure: np.ndarray


def fill(
    observer: Observer, poses: np.ndarray, lost: np.ndarray, times: np.ndarray, share: float
) -> Filled:
    """Fill in the frames of a track (T, 4, 4) that are ``lost`` (T,); ``times`` (T,) seconds,
    ``share`` of an independent observation that a frame is.

    Of the ways from one known frame to the next, the one is taken that motion and images together
    make likeliest. It is sure that a hand carried the object where no way that leads elsewhere is
    nearly as likely, the images do not speak against it, and it was out of sight for no longer than
    an object is followed unseen. Known frames become equivalent poses that follow each other.
    """
    count, symmetry, known = len(poses), observer.mesh.symmetry, ~lost
    track = unwrapped(symmetry, poses, known)
    hand, images = np.zeros((count, 6, 6)), np.zeros((count, 6, 6))
    pull, sure = np.zeros((count, 6)), np.zeros(count, bool)
    for a, b in pairwise(np.flatnonzero(known).tolist()):
        if b == a + 1:
            continue
        ways = Gap(observer.mesh, track, times, observer.joints, a, b).bridges()
        fits = [_seen(observer, way, times) for way in ways] if len(ways) > 1 else []
        seen = np.array([share * sum(map(_worth, way.poses, way.information, own))
                         for way, own in zip(ways, fits, strict=False)])  # fmt: skip
        total = seen + [way.log_ratio for way in ways] if len(ways) > 1 else np.zeros(1)
        best = int(total.argmax())
        way = ways[best]
        track[a + 1 : b] = [fit.pose for fit in fits[best]] if fits else way.poses
        track[b] = way.end
        track[b:] = unwrapped(symmetry, track[b:], known[b:])
        held = np.any(way.information, axis=(1, 2))
        for i, t in enumerate(way.frames):
            if held[i]:
                hand[t] = way.information[i]
                images[t] = np.linalg.inv(fits[best][i].covariance) - way.information[i]
                pull[t] = way.information[i] @ step_between(way.poses[i], track[t])
        rivals = [total[i] for i, other in enumerate(ways) if _apart(observer.mesh, way, other)]
        if (
            held.any()
            and total[best] - max(rivals, default=-np.inf) > CARRIED_LOG_RATIO
            and seen[best] > CONTRADICTED_LOG_RATIO
            and times[b] - times[a] < UNSEEN_S
        ):
            sure[way.frames] = held
    first, last = np.flatnonzero(known)[[0, -1]] if known.any() else (0, count - 1)
    track[:first], track[last + 1 :] = track[first], track[last]
    return Filled(track, hand, images, pull, sure)


def _worth(pose: np.ndarray, information: np.ndarray, fit: Fit) -> float:
    """What the images say for a fit, less what it takes from the ``pose`` (4, 4) that the hand's
    ``information`` (6, 6) states: the straight way is not fitted."""
    step = step_between(pose, fit.pose)
    return fit.log_ratio - 0.5 * float(step @ information @ step)


def _apart(mesh: ObjectMesh, one: Bridge, two: Bridge) -> bool:
    """Whether two ways lead to quite different poses in some frame."""
    found = [apart(mesh, p[None], q[None]) for p, q in zip(one.poses, two.poses, strict=True)]
    return any(turn[0, 0] > UNSURE_RAD or shift[0, 0] > UNSURE_M for turn, shift in found)


def _seen(observer: Observer, way: Bridge, times: np.ndarray) -> list[Fit]:
    """How the images see the object on this way; where a hand carries it, at poses that both agree
    on."""
    motion = rigid_velocity(way.poses, np.ones(len(way.frames), bool), times[way.frames])
    result = []
    for t, pose, information, twist in zip(
        way.frames.tolist(), way.poses, way.information, motion, strict=True
    ):
        if information.any():
            turn, shift = information.diagonal()[[0, 3]] ** -0.5
            prior = MotionPrior(pose, sigma_m=float(shift), sigma_rad=float(turn))
            result.append(observer.fit(t, pose, prior, FIT_ROUNDS, twist=twist))
        else:
            result.append(observer.assess(t, pose, twist=twist))
    return result
