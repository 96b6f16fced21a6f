"""The frames in which the object is lost, filled in as motion and images say together."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from intercap_core.object_track.bridges import Bridge, Gap, straight
from intercap_core.object_track.constants import FIT_ROUNDS, SEEN_LOG_RATIO
from intercap_core.object_track.fit import Fit, MotionPrior
from intercap_core.object_track.observer import Observer
from intercap_core.rigid.twist import step_between, twists


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
    make likeliest.
    """
    count = len(poses)
    found = Filled(
        straight(poses, ~lost),
        np.zeros((count, 6, 6)),
        np.zeros((count, 6, 6)),
        np.zeros((count, 6)),
        np.zeros(count, bool),
    )
    for a, b in pairwise(np.flatnonzero(~lost).tolist()):
        if b == a + 1:
            continue
        ways = Gap(observer.mesh, poses, times, observer.joints, a, b).bridges()
        if len(ways) == 1:
            continue
        fits = [_seen(observer, way, times) for way in ways]
        ratio = np.array(
            [way.log_ratio + share * sum(fit.log_ratio for fit in own)
             for way, own in zip(ways, fits, strict=True)]
        )  # fmt: skip
        best = int(ratio.argmax())
        found.sure[a + 1 : b] = best > 0 and ratio[best] - ratio[0] > SEEN_LOG_RATIO
        way = ways[best]
        for i, t in enumerate(way.frames):
            found.poses[t] = fits[best][i].pose
            if way.information[i].any():
                found.hand[t] = way.information[i]
                found.images[t] = np.linalg.inv(fits[best][i].covariance) - way.information[i]
                found.pull[t] = way.information[i] @ step_between(way.poses[i], found.poses[t])
    return found


def _seen(observer: Observer, way: Bridge, times: np.ndarray) -> list[Fit]:
    """How the images see the object on this way; where a hand carries it, at poses that both agree
    on."""
    motion = twists(way.poses, np.ones(len(way.frames), bool), times[way.frames])
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
