"""Base class of scripts in which hands pick up an object, move it and put it down.

Conventions of numbers, columns and frames: :mod:`.base`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np

from intercap_core.geometry.camera.transforms import rotation_exp
from intercap_core.studio.controls import PoseTrack, Step, ramp
from intercap_core.studio.hands import RELAXED, HandShape
from intercap_core.studio.interactions.base import (
    Interaction,
    Performance,
    held_object,
    shifted,
    upright,
)
from intercap_core.studio.interactions.grasps import (
    Approach,
    Grip,
    around_wall,
    laid_on,
    wrapped,
)
from intercap_core.studio.motion import LEFT, RIGHT, Trunk, facing
from intercap_core.studio.room import Box

SIDES = (RIGHT, LEFT)  # order in which hands are handled here; `motion.SIDES` has their names


class HandlingScript(Interaction):
    """One object is taken by the leading hand, moved along a path, and put down.

    ``plan`` sets:

    - ``pick_pose`` and ``place_pose``: (4, 4) first and last pose of the object, script frame;
    - ``grips``: a grip for each hand that holds the object;
    - ``hold_s``: times of grasp and release of each of these hands, script time.

    The object follows the leading hand; the other hand follows the object.
    """

    lead = RIGHT
    # height of the palm above the object's origin, metres; None: held between both palms
    grip_height_m: float | None = 0.0
    # of an object between both palms: where the palms begin to move outward to its surface, ahead
    # of its origin, to the side and above it, metres
    palms_m = (0.0, 0.0, -0.01)
    attach_s: float  # grasp, script time
    release_s: float  # release, script time
    # just before and after a grip, the open hand is this far off the object, metres:
    clear_m = 0.075  # against the direction of its palm
    back_m = 0.03  # against the direction of its fingers
    rests_until_s = 0.0  # the object stays where it is until then, held or not
    pick_pose: np.ndarray
    place_pose: np.ndarray
    # an approaching or leaving hand passes this far above, metres
    over_m = np.array([0.0, 0.0, 0.10])
    plinth_half_m = 0.17  # half the side of a plinth, metres
    plinth_ahead_m = 0.38  # from where the person stands to the plinth, metres
    prop_ahead_m = 0.46  # from where the person stands to the object on the plinth, metres
    prop_heading_deg = 95.0  # of the object on the plinth
    fingers_rest_m = 0.004  # a hand stays this far above a table, metres

    def __post_init__(self) -> None:
        self.grips: dict[int, Grip] = {}
        self.hold_s: dict[int, tuple[float, float]] = {}
        self.haste: dict[int, float] = {}  # share of the usual time in which a hand comes and goes
        super().__post_init__()

    @abstractmethod
    def path(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> PoseTrack:
        """Planned poses (N) of the object, from ``pick_pose`` to ``place_pose``."""

    @abstractmethod
    def trunk(self, times: np.ndarray) -> Trunk:
        """The trunk (N), before it helps arms that are too short."""

    def needs(self, times: np.ndarray) -> dict[int, np.ndarray]:
        """Weight (N,) with which the trunk helps each hand, from before to after it holds."""
        return {
            side: ramp(times, on - 0.65, on - 0.20) - ramp(times, off + 0.20, off + 0.60)
            for side, (on, off) in self.hold_s.items()
        }

    def slide(self, times: np.ndarray) -> np.ndarray:
        """Motion (N, 4, 4) of the leading hand along the object since the grasp, object frame.

        Scripts override it for objects that slip, turn in the fingers or are grasped again.
        """
        return np.broadcast_to(np.eye(4), (len(times), 4, 4))

    def raised(self, times: np.ndarray, side: int) -> np.ndarray:
        """Outward lift of an elbow (N,), as `Puppet.arm_to` takes it."""
        return np.zeros(len(times))

    def object_from_wrist(self, side: int, times: np.ndarray) -> np.ndarray:
        """Wrist poses (N, 4, 4) relative to the object at script times."""
        grip = self.grips[side].object_from_wrist
        if side == self.lead:
            return self.slide(times) @ grip
        return np.broadcast_to(grip, (len(times), 4, 4))

    def grasp(self) -> None:
        """Plan the grips: the right hand around the object's wall, or the object between palms."""
        surface, pose, floor = self.prop.surface, self.pick_pose, self.top + self.fingers_rest_m
        if self.grip_height_m is not None:
            # above the object's origin, or higher if the plinth is in the way
            at = pose[:3, 3] + (0, 0, self.grip_height_m)
            self.grips[RIGHT] = wrapped(self.puppet, surface, pose, around_wall(at, floor))
        else:
            for side, inward in zip(SIDES, (1.0, -1.0), strict=True):
                ahead, aside, up = self.palms_m
                at = pose[:3, 3] + (ahead, -inward * aside, up)
                fingers = np.array([0.9, 0.25 * inward, -0.35])  # ahead and slightly down
                approach = Approach(at, fingers, np.array([0.15, inward, 0.18]), floor=floor)
                self.grips[side] = laid_on(self.puppet, side, surface, pose, approach)
        self.hold_s = dict.fromkeys(self.grips, (self.attach_s, self.release_s))

    def table(
        self,
        middle: tuple[float, float],
        half: tuple[float, float],
        top: float,
        heading: float = 0.0,
    ) -> None:
        """Place a block that stands on the floor.

        Args:
            middle: its middle on the floor, metres.
            half: half of its length and width, metres.
            top: height of its top, metres.
            heading: its rotation about the vertical, radians.
        """
        low = (middle[0] - half[0], middle[1] - half[1], 0.0)
        high = (middle[0] + half[0], middle[1] + half[1], top)
        self.furniture.append(Box(low, high, heading, "wood"))

    def set_out(self, top_of_height: float, aside: float, further: Sequence[Step] = ()) -> None:
        """Place a plinth with the object on it, and plan the steps to it.

        Args:
            top_of_height: height of the plinth's top, share of the person's height.
            aside: the plinth's middle, metres to the left.
            further: steps after the two that lead to the plinth.
        """
        rng, puppet = self.rng, self.puppet
        self.top = top_of_height * puppet.subject.height_m + rng.uniform(-0.03, 0.03)
        self.table(
            (self.plinth_ahead_m + self.plinth_half_m, aside),
            (self.plinth_half_m, self.plinth_half_m),
            self.top,
        )
        self.pick_pose = upright(
            self.prop_ahead_m + rng.uniform(0, 0.03), aside - 0.01 + rng.uniform(-0.03, 0.03),
            self.top + self.prop.standing_height,
            np.radians(self.prop_heading_deg) + rng.normal(0, 0.15),
        )  # fmt: skip
        self.place_pose = upright(
            self.pick_pose[0, 3] + rng.uniform(-0.01, 0.04),
            self.pick_pose[1, 3] + rng.uniform(-0.03, 0.05),
            self.pick_pose[2, 3],
            np.arctan2(self.pick_pose[1, 0], self.pick_pose[0, 0]) + rng.normal(0, 0.2),
        )
        w = puppet.hip_width * 1.05
        steps = [Step(RIGHT, 0.02, 0.40, (0.0, -w)), Step(LEFT, 0.34, 0.72, (0.02, w))]
        self.walk(np.array([[-0.24, w], [-0.22, -w]]), [*steps, *further])

    def leaning(self, times: np.ndarray, reach: np.ndarray, look: np.ndarray) -> Trunk:
        """Trunk over the feet, bent by ``reach`` (N,) in [0, 1], head pitched by ``look`` (N,)
        rad."""
        trunk = self.standing(times)
        trunk.pelvis[:, 2] -= 0.01
        trunk.bend[:, 0] += 0.03 + 0.16 * reach
        trunk.head[:, 0] += 0.10 + look
        return trunk

    def before_chest(
        self, world: np.ndarray, origin: np.ndarray, offset: np.ndarray, about: np.ndarray
    ) -> PoseTrack:
        """Poses (N) of the object held in front of the person.

        Args:
            offset: (3,) metres to the left, up and ahead of ``origin`` (N, 3).
            about: (N, 3) rotation vectors relative to the pick-up pose.
        """
        person = facing(np.arctan2(world[:, 9, 1, 2], world[:, 9, 0, 2]))
        heading = person @ facing(np.zeros(1))[0].T
        turned = heading @ rotation_exp(about)
        return PoseTrack(origin + person @ offset, turned @ self.pick_pose[:3, :3])

    def wrist(
        self, side: int, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray, prop: np.ndarray
    ) -> PoseTrack:
        """Wrist poses (N) of a hand: to the object ``prop`` (N, 4, 4), with it, away from it."""
        swing = self.arm_swing(times)[:, SIDES.index(side)]
        idle = self.puppet.idle_wrist(world, pelvis, side, swing)
        if side not in self.grips:
            return idle
        (on, end), q = self.hold_s[side], self.haste.get(side, 1.0)
        hand = self.puppet.hands[side]
        at = prop @ self.object_from_wrist(side, times)
        away = -self.clear_m * hand.palm - self.back_m * hand.out
        off = shifted(at, at[:, :3, :3] @ away)
        # a hand under the object, palm up, does not pass over it
        raised = 1 - np.clip(at[:, 2:3, :3] @ hand.palm, 0, 1)
        over = shifted(off, raised * self.over_m - 0.06 * (at[:, :3, :3] @ hand.out))
        return idle.through(
            times,
            (over, on - 0.90 * q, on - 0.38 * q),
            (off, on - 0.50 * q, on - 0.20 * q),
            (at, on - 0.26 * q, on - 0.06 * q),
            (off, end + 0.08 * q, end + 0.26 * q),
            (over, end + 0.18 * q, end + 0.44 * q),
            (idle, end + 0.30 * q, end + 0.80 * q),
        )

    def finger_keys(self, side: int, times: np.ndarray) -> list[tuple[np.ndarray, HandShape]]:
        """Hand shapes over time, as `Puppet.finger_track` takes them."""
        if side not in self.grips:
            return []
        (on, off), grip = self.hold_s[side], self.grips[side]
        return [
            (ramp(times, on - 0.76, on - 0.31), grip.open),
            (ramp(times, on - 0.12, on - 0.01), grip.closed),
            (ramp(times, off + 0.01, off + 0.10), grip.open),
            (ramp(times, off + 0.25, off + 0.60), RELAXED),
        ]

    def perform(self, times: np.ndarray) -> Performance:
        """Play the script: trunk, legs, the leading arm, the object with it, the other arm."""
        puppet, lead = self.puppet, self.lead
        trunk, feet = self.trunk(times), self.footwork.feet(times)
        world = puppet.trunk(trunk)
        needs = self.needs(times)
        for _ in range(2):  # the object's path follows the trunk, which bends for the object
            prop = self.path(world, trunk.pelvis, times).matrices
            targets = {
                side: (self.wrist(side, world, trunk.pelvis, times, prop), needs[side])
                for side in SIDES
                if side in needs
            }
            trunk = puppet.settled(puppet.assist(trunk, targets), feet[0])
            world = puppet.trunk(trunk)
        pelvis = trunk.pelvis
        puppet.legs(world, pelvis, *feet)
        prop = self.path(world, pelvis, times).matrices
        for side in (lead, 1 - lead):
            wrist = self.wrist(side, world, pelvis, times, prop)
            puppet.arm_to(world, pelvis, side, wrist, self.raised(times, side))
            if side == lead:
                prop = self._held(world, pelvis, times)
        for side in SIDES:
            track = puppet.finger_track(side, self.finger_keys(side, times))
            puppet.fingers(world, side, track)
        return Performance(world, pelvis, prop)

    def _held(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Poses (N, 4, 4) of the object: at rest, in the leading hand, at rest."""
        object_from_wrist = self.object_from_wrist(self.lead, times)
        held = held_object(self.puppet, world, pelvis, self.lead, object_from_wrist)
        on, off = self.hold_s[self.lead]
        on = max(on, self.rests_until_s)
        pose = np.where((times <= on)[:, None, None], self.pick_pose, held)
        return np.where((times >= off)[:, None, None], self.place_pose, pose)
