"""Take an object that stands on the floor by its handle, carry it two steps, put it down.

Conventions of numbers, columns and frames: :mod:`.base`.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from intercap_core.geometry.camera.transforms import rigid, rotation_exp
from intercap_core.studio.controls import PoseTrack, Step, bump, plateau, ramp
from intercap_core.studio.hands import RELAXED, HandShape, shape
from intercap_core.studio.interactions.base import (
    Interaction,
    Performance,
    held_object,
    shifted,
    upright,
)
from intercap_core.studio.motion import LEFT, RIGHT, Trunk


class HandleCarry(Interaction):
    """The object stands to the right of the person's way, its handle along the way."""

    highlight = 1.5
    centre = (0.22, -0.15)
    bar_half: float  # half the thickness of the handle's bar, metres
    distance_m: float  # from the hip to the object's middle, metres
    # places of the knuckles next to and below the bar that are tried, metres
    knuckles_aside: tuple[float, ...] = (0.020, 0.025, 0.030)
    knuckles_below: tuple[float, ...] = (0.020, 0.024, 0.028, 0.032)
    above: float  # height above the grip from which the hand goes down to it, metres
    # range of the height above the floor at which it is carried, metres; None: the arm hangs
    lift_m: tuple[float, float] | None = None
    lifted_s: float  # end of the lift, script time
    lower_s: float  # start of putting it down, script time
    stoop_from: float  # start of the stoop, script time
    stoop_down: float  # how far the pelvis goes down, in leg lengths
    stoop_back: float  # how far the pelvis goes back, metres
    stoop_bend: float  # additional bend of the trunk, rad
    attach_s = 1.08  # grasp, script time
    release_s = 2.46  # release, script time
    knuckles_deg = (36, 44, 52, 60)  # knuckle flexions of the hands that are tried
    tilts_deg = (10, 20, 30, 40)  # wrist tilts that are tried
    strain_m = 0.0005  # clearance that 10 degrees less wrist tilt are worth, metres
    sparse = 3  # every n-th skin point is enough to try a hand
    # the hand also passes this far from the grasp on its way in, metres
    withdrawn_m = np.array([0.0, 0.03, 0.0])

    def plan(self) -> None:
        rng, puppet = self.rng, self.puppet
        side_way = -(puppet.hip_width + self.distance_m + rng.uniform(0, 0.02))
        height = self.prop.standing_height
        ahead, turned = 0.02 + rng.normal(0, 0.01), np.pi + rng.normal(0, 0.03, 2)
        self.pick_pose = upright(ahead, side_way, height, turned[0])
        stride = 0.43 + 0.05 * rng.random()
        self.place_pose = upright(2 * stride - 0.02, side_way - 0.02, height, turned[1])
        w = puppet.hip_width * 0.95
        start = np.array([[-0.62, w], [-0.68, -w]])
        steps = [
            Step(RIGHT, 0.05, 0.46, (-0.20, -w)),
            Step(LEFT, 0.44, 0.86, (0.10, w)),
            Step(RIGHT, 1.20, 1.62, (stride - 0.05, -w)),
            Step(LEFT, 1.60, 2.02, (2 * stride - 0.04, w)),
            Step(RIGHT, 2.00, 2.34, (2 * stride - 0.22, -w)),
        ]
        self.walk(start, steps)
        self._grasp()
        self.lift = self.lifted()

    def lifted(self) -> float:
        """How high the object is carried, from the floor, metres."""
        if self.lift_m is not None:
            return self.rng.uniform(*self.lift_m)
        # the arm hangs almost straight; a standing person's shoulder is at 0.81 of the height
        puppet = self.puppet
        shoulder = 0.81 * puppet.subject.height_m
        wrist = shoulder - self.rng.uniform(0.83, 0.89) * puppet.arm
        return wrist - float((self.pick_pose @ self.object_from_wrist)[2, 3])

    def _grasp(self) -> None:
        """Put the fingers level under the handle's bar where they have most room, and curl them up.

        All combinations of knuckle flexion, wrist tilt and place are tried. The best one has the
        largest clearance at the grasp and on the way in, less ``strain_m`` for each 10 degrees of
        tilt. The hand comes from the object's +y, its thumb towards -x.
        """
        hand, surface = self.puppet.hands[RIGHT], self.prop.surface
        near = (np.abs(self.prop.vertices[:, :2]) < (0.04, 0.02)).all(1)
        bar_height = self.prop.vertices[near, 2].max() - self.bar_half
        best = (-np.inf, RELAXED, np.eye(4))
        for knuckle_deg in self.knuckles_deg:
            hook = shape((knuckle_deg, 4, 3), (0, -10, 0), 15, 0)
            skin = hand.skin(hand.local(hook)[None])[0, :: self.sparse]
            for tilt_deg in self.tilts_deg:
                sin, cos = np.sin(np.radians(tilt_deg)), np.cos(np.radians(tilt_deg))
                rotation = self.puppet.wrist_rotation(
                    RIGHT, np.array([0, -sin, -cos]), np.array([0, -cos, sin])
                )
                turned = skin @ rotation.T
                knuckle = rotation @ hand.knuckles.mean(0)
                for aside, below in product(self.knuckles_aside, self.knuckles_below):
                    place = np.array([0.0, aside, bar_height - below]) - knuckle
                    on_the_way = np.concatenate([turned + place, turned + place + self.withdrawn_m])
                    room = float(surface.signed_distance(on_the_way).min())
                    room -= self.strain_m * tilt_deg / 10
                    if room > best[0]:
                        best = (room, hook, rigid(rotation, place))
        _, self.hook, self.object_from_wrist = best
        knuckle_limit = float(self.hook.flexion[0, 0]) + 5
        limits = {"finger": (knuckle_limit, 98.0, 62.0), "thumb": (40.0, 55.0, 60.0)}
        self.grip_shape, self.grip_gaps = hand.close(
            self.hook, limits, surface, self.object_from_wrist
        )

    def _trunk(self, times: np.ndarray) -> Trunk:
        """Stoop to the object, walk upright, and stoop to put it down; the head looks at it."""
        trunk = self.standing(times, head=1.5)
        pelvis, bend, head = trunk.pelvis, trunk.bend, trunk.head
        stoop = plateau(times, self.stoop_from, 1.02, 1.10, self.lifted_s - 0.05)
        stoop = stoop + plateau(times, self.lower_s, 2.40, 2.54, 3.30)
        carry = plateau(times, 1.15, 1.6, 1.85, 2.3)
        pelvis[:, 2] -= self.stoop_down * self.puppet.leg * stoop
        pelvis[:, 0] -= self.stoop_back * stoop
        bend[:, 0] += 0.04 + self.stoop_bend * stoop
        bend[:, 2] += 0.10 * stoop - 0.10 * carry
        bend[:, 1] -= 0.10 * stoop
        head[:, 0] += 0.12 + 0.45 * stoop
        head[:, 1] -= 0.35 * plateau(times, 0.2, 0.7, 1.2, 1.6) + 0.25 * plateau(
            times, 1.8, 2.2, 2.5, 2.9
        )
        return trunk

    def _right_wrist(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> PoseTrack:
        """Wrist (N): hanging, over and beside the handle, on it, carrying, and back the same way.

        ``first`` and ``last`` are the wrist's poses on the handle at pick-up and put-down.
        """
        count = len(times)
        swing = 0.10 * bump(times, 0.35, 0.9) + self.arm_swing(times)[:, 0]
        idle = self.puppet.idle_wrist(world, pelvis, RIGHT, swing)
        first, last = (p @ self.object_from_wrist for p in (self.pick_pose, self.place_pose))
        before, after = (shifted(pose, (0.0, -0.085, 0.0)) for pose in (first, last))
        over = shifted(before, (-0.03, -0.03, self.above))
        off = shifted(after, (-0.02, -0.04, self.above))
        held = np.array([0.0, first[1, 3], first[2, 3] + self.lift])
        position = np.broadcast_to(held, (count, 3)).copy()
        share = ramp(times, 1.2, 2.3)
        position[:, 0] = pelvis[:, 0] + (first[0, 3] - self.pick_pose[0, 3]) - 0.02
        position[:, 1] += share * (last[1, 3] - first[1, 3])
        position[:, 2] += 0.006 * np.sin(2 * np.pi * times / 0.41)
        tilt = np.zeros((count, 3))
        tilt[:, 1] = (
            0.05 * np.sin(2 * np.pi * (times - 1.2) / 0.82) * plateau(times, 1.2, 1.5, 1.9, 2.2)
        )
        between = PoseTrack.of(first).towards(PoseTrack.of(last), share)
        carried = PoseTrack(position, rotation_exp(tilt) @ between.rotation)
        return idle.through(
            times,
            (over, 0.25, 0.90),
            (before, 0.62, 0.95),
            (first, 0.94, 1.04),
            (carried, self.attach_s, self.lifted_s),
            (last, self.lower_s, self.release_s - 0.02),
            (after, 2.53, 2.65),
            (off, 2.62, 2.86),
            (idle, 2.80, 3.40),
        )

    def perform(self, times: np.ndarray) -> Performance:
        puppet = self.puppet
        trunk, feet = self._trunk(times), self.footwork.feet(times)
        world = puppet.trunk(trunk)
        needs = plateau(times, 0.2, 1.0, 2.6, 3.4)
        for _ in range(2):  # the wrist's path follows the trunk, which bends for the wrist
            right = self._right_wrist(world, trunk.pelvis, times)
            trunk = puppet.assist(trunk, {RIGHT: (right, needs)})
            trunk = puppet.settled(trunk, feet[0])
            world = puppet.trunk(trunk)
        pelvis = trunk.pelvis
        right = self._right_wrist(world, pelvis, times)
        puppet.legs(world, pelvis, *feet)
        puppet.arm_to(world, pelvis, RIGHT, right)
        swing = -0.10 * bump(times, 0.0, 0.5) + 0.14 * bump(times, 1.2, 1.7)
        left = puppet.idle_wrist(world, pelvis, LEFT, swing + self.arm_swing(times)[:, 1])
        balance = plateau(times, 0.7, 1.0, 2.5, 2.9)[:, None]
        left = PoseTrack(left.position + balance * np.array([0.06, 0.10, 0.05]), left.rotation)
        puppet.arm_to(world, pelvis, LEFT, left)
        stages: list[tuple[np.ndarray, HandShape]] = [
            (ramp(times, 0.5, 0.88), self.hook),
            (ramp(times, 0.98, 1.075), self.grip_shape),
            (ramp(times, 2.46, 2.53), self.hook),
            (ramp(times, 2.63, 2.9), RELAXED),
        ]
        puppet.fingers(world, RIGHT, puppet.finger_track(RIGHT, stages))
        puppet.fingers(world, LEFT, puppet.finger_track(LEFT, []))
        carried = held_object(puppet, world, pelvis, RIGHT, self.object_from_wrist)
        pose = np.where((times <= self.attach_s)[:, None, None], self.pick_pose, carried)
        pose = np.where((times >= self.release_s)[:, None, None], self.place_pose, pose)
        return Performance(world, pelvis, pose)
