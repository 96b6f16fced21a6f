"""Take an object from a plinth and turn it before the eyes or chest, or pass it to another plinth.

Conventions of numbers, columns and frames: :mod:`.base`.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from intercap_core.studio.controls import PoseTrack, Step, bump, plateau
from intercap_core.studio.interactions.base import upright
from intercap_core.studio.interactions.grasps import Approach, laid_on
from intercap_core.studio.interactions.handling import HandlingScript
from intercap_core.studio.motion import LEFT, RIGHT, Trunk


class Checking(HandlingScript):
    """Pick up an object, turn it before the eyes, put it back."""

    highlight = 1.75
    centre = (0.20, 0.0)
    top_of_height = 0.52
    aside = 0.0
    # place of the object relative to the head's joint: left, up, ahead, in arm lengths
    before_eyes = (0.0, -0.35, 0.72)
    second_hand = False  # the left palm comes below an object that the right hand holds
    tip_deg = 35.0  # towards the eyes, and half of it away
    spin_deg = 25.0  # about the vertical
    roll_deg = 18.0  # to the sides
    attach_s = 0.96  # grasp, script time
    release_s = 2.52  # release, script time
    join_s = 1.56  # the second hand takes hold, script time
    part_s = 1.96  # the second hand lets go, script time
    raised_s = (1.36, 2.12)  # start and end of the turning before the eyes, script time
    # leaning to the plinth, to pick up and to put down, and looking at the object: times as
    # :func:`plateau` takes them, script time
    lean_s = ((0.35, 0.9, 1.0, 1.5), (2.0, 2.45, 2.55, 3.0))
    look_s = (1.1, 1.5, 2.0, 2.4)

    def plan(self) -> None:
        self.set_out(self.top_of_height, self.aside)
        self.size = self.rng.uniform(0.8, 1.2, 3)  # factor of each turn's angle
        self.order = self.rng.choice([-1.0, 1.0], 2)  # to which side first
        self.grasp()
        if self.second_hand:
            # the object's bottom on the left palm, fingers ahead and to the right
            pose, fingers = self.pick_pose, np.array([0.75, -0.65, -0.05])
            below = Approach(pose[:3, 3], fingers, np.array([0, 0, 1.0]))
            self.grips[LEFT] = laid_on(self.puppet, LEFT, self.prop.surface, pose, below)
            self.hold_s[LEFT] = (self.join_s, self.part_s)
            self.haste[LEFT] = 0.6

    def trunk(self, times: np.ndarray) -> Trunk:
        """Lean to the plinth, straighten up, look at the object, lean again."""
        reach = plateau(times, *self.lean_s[0]) + plateau(times, *self.lean_s[1])
        look = plateau(times, *self.look_s)
        trunk = self.leaning(times, reach, 0.30 * reach + 0.22 * look)
        trunk.bend[:, 1] -= 0.06 * self.order[0] * bump(times, 1.2, 2.2)
        return trunk

    def raised(self, times: np.ndarray, side: int) -> np.ndarray:
        """The helping arm's elbow is away from the body while its hand is before the chest."""
        return (0.4 * plateau(times, 0.9, 1.3, 2.0, 2.4), np.zeros(len(times)))[side]

    def turned(self, times: np.ndarray) -> np.ndarray:
        """Rotation vectors (N, 3) of the object in the script's axes, relative to the pick-up."""
        tip, spin, roll = np.radians((self.tip_deg, self.spin_deg, self.roll_deg)) * self.size
        first, second = self.order
        about = np.zeros((len(times), 3))
        about[:, 1] = tip * (0.5 * bump(times, 1.75, 2.3) - bump(times, 1.2, 1.85))
        about[:, 2] = spin * first * (bump(times, 1.3, 1.8) - bump(times, 1.6, 2.2))
        about[:, 0] = roll * second * bump(times, 1.45, 2.1)
        return about

    def path(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> PoseTrack:
        """From the plinth to before the eyes, turned there about three axes, and back."""
        head = self.puppet.joint(world, pelvis, "head")
        offset = self.puppet.arm * np.array(self.before_eyes)
        shown = self.before_chest(world, head, offset, self.turned(times))
        lift = np.array([0.0, 0, 0.04])
        return PoseTrack.of(self.pick_pose).through(
            times,
            (shown, self.attach_s, self.raised_s[0], lift),
            (self.place_pose, self.raised_s[1], self.release_s - 0.03, lift),
        )


class Turning(Checking):
    """Pick up an object, turn it slowly by large angles before the chest, put it back.

    The object rests visibly before and after. Its underside is turned to the cameras.
    """

    highlight = 1.7
    attach_s = 0.76  # grasp, script time
    release_s = 2.76  # release, script time
    raised_s = (1.12, 2.28)  # start and end of the turning before the chest, script time
    lean_s = ((0.15, 0.7, 0.82, 1.2), (2.15, 2.6, 2.8, 3.2))
    look_s = (0.9, 1.2, 2.2, 2.5)
    # rotation vectors that the turning passes at even intervals, degrees about the axes ahead, to
    # the left and up: positive = the left side up, the top away from the person, turned to the left
    turns_deg: tuple[tuple[float, float, float], ...] = ()

    def turned(self, times: np.ndarray) -> np.ndarray:
        """A spline through ``turns_deg`` that starts and ends at rest."""
        keys = np.radians([(0.0, 0.0, 0.0), *self.turns_deg, (0.0, 0.0, 0.0)])
        start, end = self.attach_s + 0.12, self.release_s - 0.28
        spline = CubicSpline(np.linspace(start, end, len(keys)), keys, bc_type="clamped")
        return spline(np.clip(times, start, end)) * (0.9 + 0.1 * self.size)

    def raised(self, times: np.ndarray, side: int) -> np.ndarray:
        """Both elbows are away from the body while the object is before the chest."""
        return 0.3 * plateau(times, 0.8, 1.1, 2.3, 2.65)


class LookingOn(HandlingScript):
    """Step to an object on a plinth, lean forward and look at it without touching it."""

    highlight = 1.7
    top_of_height = 0.42
    aside = 0.0

    def plan(self) -> None:
        self.set_out(self.top_of_height, self.aside)

    def trunk(self, times: np.ndarray) -> Trunk:
        look = plateau(times, 0.8, 1.3, 2.0, 2.6)
        return self.leaning(times, 0.3 * look, 0.3 * look)

    def path(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> PoseTrack:
        """At rest."""
        return PoseTrack.of(np.broadcast_to(self.pick_pose, (len(times), 4, 4)))

    def _held(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> np.ndarray:
        return self.path(world, pelvis, times).matrices


class PassingOn(HandlingScript):
    """Carry an object from one plinth to a second one on the left, and hold it out meanwhile."""

    highlight = 1.85
    centre = (0.15, 0.40)
    top_of_height = 0.52
    aside = 0.0  # of the object, to the left
    carried = (0.0, 0.20, 0.36)  # from the pelvis: left, up, ahead, metres
    offered_up_m = 0.33
    attach_s = 0.96  # grasp, script time
    release_s = 2.58  # release, script time
    # the object on the second plinth, ahead of the person who stands before it, metres
    ahead_m = 0.50

    def plan(self) -> None:
        rng, w = self.rng, self.puppet.hip_width * 1.05
        turned = np.radians(rng.uniform(62, 84))
        way = np.array([np.cos(turned), np.sin(turned)])
        left = np.array([-way[1], way[0]])
        stand = rng.uniform(0.50, 0.60) * way

        def foot(side: int, start: float, end: float, place: np.ndarray, share: float) -> Step:
            place = place + (w, -w)[side] * left
            return Step(side, start, end, (float(place[0]), float(place[1])), share * turned)

        self.set_out(
            self.top_of_height,
            self.aside,
            [
                foot(LEFT, 1.04, 1.40, 0.45 * stand, 0.7),
                foot(RIGHT, 1.30, 1.70, stand, 1.0),
                foot(LEFT, 1.62, 1.96, stand, 1.0),
            ],
        )
        top = self.top - rng.uniform(0.02, 0.10)
        table = stand + (0.40 + self.plinth_half_m) * way + self.aside * left
        self.table((table[0], table[1]), (self.plinth_half_m, self.plinth_half_m), top, turned)
        place = stand + (self.ahead_m + rng.uniform(0, 0.04)) * way
        place = place + (self.aside + rng.uniform(-0.03, 0.03)) * left
        heading = (
            np.arctan2(self.pick_pose[1, 0], self.pick_pose[0, 0]) + turned + rng.normal(0, 0.15)
        )
        self.place_pose = upright(place[0], place[1], top + self.prop.standing_height, heading)
        self.grasp()

    def trunk(self, times: np.ndarray) -> Trunk:
        """Lean to the plinth, walk upright, offer, lean to the other plinth."""
        reach = plateau(times, 0.35, 0.9, 1.0, 1.45) + plateau(times, 2.1, 2.5, 2.6, 3.0)
        trunk = self.leaning(times, reach, 0.30 * reach)
        trunk.head[:, 1] += 0.30 * plateau(times, 1.0, 1.3, 1.5, 1.9)
        return trunk

    def path(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> PoseTrack:
        """From the plinth to before the belly, held out, to the other plinth."""
        level = np.zeros((len(times), 3))
        lift = np.array([0.0, 0, 0.04])
        carried = self.before_chest(world, pelvis, np.array(self.carried), level)
        offer = np.array([self.carried[0], self.offered_up_m, 0.93 * self.puppet.arm])
        level[:, 1] = 0.20  # tipped a little to whom it is offered
        offered = self.before_chest(world, pelvis, offer, level)
        return PoseTrack.of(self.pick_pose).through(
            times,
            (carried, self.attach_s, 1.42, lift),
            (offered, 1.62, 2.05),
            (self.place_pose, 2.12, self.release_s - 0.03, lift),
        )
