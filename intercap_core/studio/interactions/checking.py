"""Take a thing from a plinth, turn it about before the eyes with two hands, put it back."""

from __future__ import annotations

import numpy as np

from intercap_core.studio.controls import Pose, bump, plateau, ramp
from intercap_core.studio.interactions.handling import LEFT, RIGHT, SIDES, Handling
from intercap_core.studio.interactions.taking import between_palms, by_the_wall, palm_below
from intercap_core.studio.motion import Trunk

ATTACH_S, RELEASE_S = 0.96, 2.52
JOIN_S, PART_S = 1.56, 1.96  # while a second hand helps
RAISED_S = (1.36, 2.12)


class Checking(Handling):
    """What the two ways of checking share: the path and the trunk."""

    highlight = 1.75
    centre = (0.20, 0.0)
    top_of_height = 0.52
    aside = 0.0
    before_eyes = (0.0, -0.35, 0.72)  # from the head's joint: left, up, ahead, arm lengths
    tip_deg = 35.0  # towards the eyes, and half of it away
    spin_deg = 25.0  # about the vertical
    roll_deg = 18.0  # to the sides

    def plan(self) -> None:
        self.set_out(self.top_of_height, self.aside)
        self.size = self.rng.uniform(0.8, 1.2, 3)  # of each turn
        self.order = self.rng.choice([-1.0, 1.0], 2)  # to which side first
        self.grasp()

    def grasp(self) -> None:
        """Plan the grips."""
        raise NotImplementedError

    def trunk(self, times: np.ndarray) -> Trunk:
        """Lean to the plinth, straighten up, look at the thing, lean again."""
        reach = plateau(times, 0.35, 0.9, 1.0, 1.5) + plateau(times, 2.0, 2.45, 2.55, 3.0)
        look = plateau(times, 1.1, 1.5, 2.0, 2.4)
        trunk = self.leaning(times, reach, 0.30 * reach + 0.22 * look)
        trunk.bend[:, 1] -= 0.06 * self.order[0] * bump(times, 1.2, 2.2)
        return trunk

    def raised(self, times: np.ndarray, side: int) -> np.ndarray:
        """The helping arm's elbow is away from the body while its hand is before the chest."""
        return (0.4 * plateau(times, 0.9, 1.3, 2.0, 2.4), np.zeros(len(times)))[side]

    def path(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> Pose:
        """From the plinth to before the eyes, turned there about three axes, and back."""
        count = len(times)
        head = self.puppet.joint_on_trunk(world, pelvis, "head")
        tip, spin, roll = np.radians((self.tip_deg, self.spin_deg, self.roll_deg)) * self.size
        first, second = self.order
        about = np.zeros((count, 3))
        about[:, 1] = tip * (0.5 * bump(times, 1.75, 2.3) - bump(times, 1.2, 1.85))
        about[:, 2] = spin * first * (bump(times, 1.3, 1.8) - bump(times, 1.6, 2.2))
        about[:, 0] = roll * second * bump(times, 1.45, 2.1)
        offset = self.puppet.arm * np.array(self.before_eyes)
        shown = self.before_chest(world, head, offset, about)
        lift = np.array([0.0, 0, 0.04])
        thing = Pose.still(self.taken, count)
        thing = thing.towards(shown, ramp(times, ATTACH_S, RAISED_S[0]), lift)
        return thing.towards(
            Pose.still(self.put, count), ramp(times, RAISED_S[1], RELEASE_S - 0.03), lift
        )


class FootballCheck(Checking):
    """The ball between both palms."""

    object_class = "football"
    tip_deg = 40.0

    def grasp(self) -> None:
        """Both palms from the start."""
        self.grips = between_palms(self)
        self.hold_s = dict.fromkeys(SIDES, (ATTACH_S, RELEASE_S))


class CheckingByTheWall(Checking):
    """The right hand around its wall; the left comes under it while it is turned."""

    top_of_height = 0.555
    aside = -0.10
    grip_height_m = 0.0

    def grasp(self) -> None:
        """The wall as one drinks, then the bottom on the left palm."""
        self.grips = {RIGHT: by_the_wall(self, self.grip_height_m), LEFT: palm_below(self)}
        self.hold_s = {RIGHT: (ATTACH_S, RELEASE_S), LEFT: (JOIN_S, PART_S)}
        self.haste[LEFT] = 0.6


class BottleCheck(CheckingByTheWall):
    """The bottle by its body, its bottom on the other palm."""

    object_class = "bottle"
    grip_height_m = 0.01
    before_eyes = (0.06, -0.42, 0.64)
    tip_deg = 20.0


class CupCheck(CheckingByTheWall):
    """The cup by its wall, its bottom on the other palm; one looks into it."""

    object_class = "cup"
    tip_deg = 38.0
