"""Grasps planned on the true object's surface, without the contact term and regions of the fits.

A hand approaches until its skin is pressed in, then its fingers close. Of several tries, the one
with the smallest gaps between fingers and object is kept.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from intercap_core.geometry.camera.transforms import invert, rigid
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.studio.controls import bisect
from intercap_core.studio.hands import THUMB, Hand, HandShape, shape
from intercap_core.studio.motion import RIGHT, Puppet
from intercap_core.studio.skeleton import unit

PALM_PRESSED_M = 0.001  # depth to which the object presses the palm
THUMB_BENDS = (1.0, 0.5, 0.15)  # of the thumb's largest flexion, in the order of tries
OPPOSITIONS_DEG = (60.0, 45.0, 30.0, 75.0, 90.0, 15.0, 0.0)  # of the thumb, in the order of tries
WRAP_OPEN = shape((10, 12, 6), (0, 4, 6), 45)
LAID = shape((2, 4, 3), (0, 2, 4), 8, 4)
LAID_LIMITS = {"finger": (45.0, 45.0, 30.0), "thumb": (30.0, 30.0, 30.0)}
WRAP_LIMITS = {"finger": (75.0, 95.0, 60.0), "thumb": (40.0, 50.0, 60.0)}


@dataclass(frozen=True)
class Grip:
    """A planned grasp."""

    open: HandShape
    """Shape before the grasp."""
    closed: HandShape
    object_from_wrist: np.ndarray
    """(4, 4) pose of the wrist in the object's frame."""
    gaps: np.ndarray
    """(5,) least signed distance of each finger to the object, metres."""


def backed_off(
    hand: Hand,
    hand_shape: HandShape,
    surface: DistanceField,
    script_from_object: np.ndarray,
    wrist: np.ndarray,
    away: np.ndarray,
    gap: float,
    ids: np.ndarray | slice = slice(None),
    *,
    reach_m: tuple[float, float] = (0.0, 0.25),
    steps: int = 16,
) -> np.ndarray:
    """Move a wrist away from the object until the hand has a gap.

    Args:
        wrist: (4, 4) first pose, script frame.
        away: (3,) unit direction, script frame.
        gap: distance of the object from the hand's vertices ``ids``, metres; negative: pressed in.
        reach_m: least and largest motion of the wrist, metres.
        steps: number of bisections.

    Returns:
        (4, 4) pose of the wrist, script frame.
    """
    object_from_script = invert(script_from_object)

    def moved(way: float) -> np.ndarray:
        return rigid(wrist[:3, :3], wrist[:3, 3] + way * away)

    def is_too_near(way: float) -> bool:
        return hand.gap(hand_shape, surface, object_from_script @ moved(way), ids) < gap

    return moved(bisect(*reach_m, steps, is_too_near)[1])


class Hollow:
    """Test whether points are inside the hollow of an object, such as a vessel.

    A point is in a hollow if most of the rays from it, evenly over all directions, hit the object.
    """

    off_wall_m = 0.0015  # points nearer to the surface are not tested, metres
    # share of directions that meet the object from inside a hollow: 0.5 before a flat wall, 0.6 a
    # few millimetres below a cup's rim, nearly 1 at its bottom
    hollow_share = 0.60
    directions = 128  # rays from each point

    def __init__(self, surface: DistanceField) -> None:
        self._surface = surface
        steps = np.arange(self.directions) + 0.5
        height, angle = 1 - 2 * steps / self.directions, np.pi * (1 + np.sqrt(5)) * steps
        around = np.sqrt(1 - height**2)
        self._directions = np.stack(
            [around * np.cos(angle), around * np.sin(angle), height], 1
        )  # even over the sphere (Fibonacci's spiral)

    def share(self, points: np.ndarray) -> np.ndarray:
        """Share (n,) of the rays from points (n, 3), object frame, that hit the object."""
        start = np.repeat(points, self.directions, 0)
        hit = self._surface.met(start, np.tile(self._directions, (len(points), 1)))
        return hit.reshape(len(points), self.directions).mean(1)

    def holds(self, points: np.ndarray) -> bool:
        """Whether any of the points (n, 3), object frame, is in a hollow."""
        off = points[self._surface.signed_distance(points) > self.off_wall_m]
        return bool(len(off) and self.share(off).max() > self.hollow_share)


@dataclass(frozen=True)
class Approach:
    """Straight approach of a palm to an object, script frame."""

    at: np.ndarray
    """Goal (3,) of the palm."""
    fingers: np.ndarray
    """Direction (3,) of the fingers."""
    palm: np.ndarray
    """Direction (3,) in which the palm faces and moves."""
    along: float = 0.030
    """The goal lies this far from the palm's middle towards the fingers, metres."""
    floor: float = -np.inf
    """The hand stays above this height, metres."""

    def wrist(
        self,
        puppet: Puppet,
        side: int,
        hand_shape: HandShape,
        surface: DistanceField,
        script_from_object: np.ndarray,
        *,
        thumb: bool = False,
    ) -> np.ndarray:
        """The wrist (4, 4), script frame, at which the hand is pressed against the object.

        The palm or a finger touches the object first; the thumb counts only with ``thumb``.
        """
        hand = puppet.hands[side]
        fingers, palm = unit(np.asarray(self.fingers)), unit(np.asarray(self.palm))
        rotation = puppet.wrist_rotation(side, fingers, palm)
        skin = hand.skin(hand.local(hand_shape)[None])[0] @ rotation.T
        place = np.asarray(self.at) - skin[hand.palm_ids].mean(0) - self.along * fingers
        place[2] = max(place[2], self.floor - skin[:, 2].min())
        ids = slice(None) if thumb else hand.but_thumb_ids
        return backed_off(hand, hand_shape, surface, script_from_object,
                          rigid(rotation, place), -palm, -PALM_PRESSED_M, ids)  # fmt: skip


def around_wall(at: np.ndarray, floor: float) -> Iterator[Approach]:
    """Approaches of a right hand to an upright wall: the palm faces left, fingers point ahead.

    ``at``: (3,) goal of the palm; ``floor``: lowest height of the hand, metres; script frame.
    """
    for along, azimuth in product((0.030, 0.040, 0.022), np.radians((65.0, 80.0))):
        sin, cos = np.sin(azimuth), np.cos(azimuth)
        yield Approach(at, np.array([sin, cos, -0.10]), np.array([-cos, sin, 0.0]), along, floor)


def laid_on(
    puppet: Puppet,
    side: int,
    surface: DistanceField,
    script_from_object: np.ndarray,
    approach: Approach,
) -> Grip:
    """A flat hand laid on the object, the thumb along it, fingers bent until they meet it."""
    hand = puppet.hands[side]
    wrist = approach.wrist(puppet, side, LAID, surface, script_from_object, thumb=True)
    pose = invert(script_from_object) @ wrist
    closed, gaps = hand.close(LAID, LAID_LIMITS, surface, pose)
    return Grip(LAID, closed, pose, gaps)


def wrapped(
    puppet: Puppet,
    surface: DistanceField,
    script_from_object: np.ndarray,
    approaches: Iterable[Approach],
) -> Grip:
    """Plan a grip of the right palm against the object, the fingers around it, then the thumb.

    For each approach, several bends and oppositions of the thumb are tried. A try is dropped if the
    open thumb penetrates the object, or if part of the hand, open or closed, is in a hollow. The
    score is the negative sum of the gaps of all fingers. The search ends at a try in which every
    finger meets the object, or after an approach with a nearly closed grip.
    """
    hand, hollow = puppet.hands[RIGHT], Hollow(surface)
    four = (1, 3, 0, 2)  # middle, ring, index, little finger
    best: tuple[float, Grip] | None = None
    for approach in approaches:
        wrist = approach.wrist(puppet, RIGHT, WRAP_OPEN, surface, script_from_object)
        pose = invert(script_from_object) @ wrist
        around, _ = hand.close(WRAP_OPEN, WRAP_LIMITS, surface, pose, fingers=four)
        for bend, opposition in product(THUMB_BENDS, OPPOSITIONS_DEG):
            opened = replace(WRAP_OPEN, opposition=opposition)
            if hand.gap(opened, surface, pose, hand.thumb_ids) < -1.5 * PALM_PRESSED_M:
                continue
            base, middle, end = WRAP_LIMITS["thumb"]
            limits = {"thumb": (bend * base, bend * middle, bend * end)}
            closed, gaps = hand.close(replace(around, opposition=opposition), limits, surface,
                                      pose, fingers=(THUMB,))  # fmt: skip
            score = -float(np.clip(gaps, 0, 0.03).sum())
            if best is not None and score <= best[0]:
                continue
            skin = hand.skin(np.stack([hand.local(opened), hand.local(closed)]))
            if hollow.holds(skin.reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]):
                continue
            best = score, Grip(opened, closed, pose, gaps)
            if gaps.max() < 0.002:  # metres: every finger meets the object
                return best[1]
        if best is not None and best[0] > -0.008:  # metres: sum of the remaining gaps
            break
    if best is None:
        raise ValueError("no approach leaves the thumb room outside the object")
    return best[1]
