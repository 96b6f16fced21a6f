"""Step back to a stool, feel for its edge, sit down, rest, rise."""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.camera.transforms import invert
from intercap_core.studio.controls import Footwork, Pose, Step, bump, plateau, ramp
from intercap_core.studio.hands import FLAT, RELAXED, HandShape, part_of
from intercap_core.studio.interactions.base import (
    SCRIPT_S,
    Interaction,
    Performance,
    transform,
    upright,
)
from intercap_core.studio.motion import LEG_REACH, Trunk
from intercap_core.studio.skeleton import local_rotations, unit

RIGHT, LEFT = 1, 0
SIT_S, SEATED_S, RISE_S, RISEN_S = 0.72, 1.42, 2.10, 2.86
PRESSED_M = 0.014  # flesh gives way by this much on the seat
HOVER_M = (0.006, 0.016)
TOUCH_M = 0.0006  # how deep the palm presses the seat


class StoolSit(Interaction):
    """The person stands before the stool with the back to it."""

    object_class = "stool"
    highlight = 1.75
    centre = (0.15, 0.0)

    def plan(self) -> None:
        rng, puppet = self.rng, self.puppet
        thigh = puppet.skeleton.length("left_hip", "left_knee")
        self.seat = upright(0.0, 0.0, self.thing.standing_height, rng.uniform(0, np.pi / 2))
        self.seat_top = self.seat[2, 3] + self.thing.vertices[:, 2].max()
        self.ahead = thigh * rng.uniform(0.90, 0.98)  # feet before the seat's middle
        w = puppet.hip_width * 1.15
        before = 0.16
        start = np.array([[self.ahead + before, w], [self.ahead + before - 0.03, -w]])
        steps = [
            Step(RIGHT, 0.02, 0.40, (self.ahead - 0.01, -w)),
            Step(LEFT, 0.32, 0.70, (self.ahead + 0.01, w)),
        ]
        self.footwork = Footwork(start, 0.0, steps, puppet.ankle_height, SCRIPT_S)
        self.pelvis_track = self.footwork.pelvis(
            LEG_REACH * puppet.leg, puppet.hip_width, puppet.hip_drop, puppet.stand
        )
        self.hover = rng.uniform(*HOVER_M)
        self.seated_height = self.seat_top + 0.12
        self._sit()
        self.palm_place = self._palm_on_seat(RIGHT, -TOUCH_M)
        self.hover_place = self._palm_on_seat(LEFT, self.hover)

    def _sit(self) -> None:
        """Lower the pelvis until the flesh is pressed in by ``PRESSED_M``."""
        puppet, subject = self.puppet, self.puppet.subject
        low_part = [JOINT_INDEX[n] for n in ("pelvis", "left_hip", "right_hip", "spine1")]
        share = np.asarray(subject.weights[:, low_part].sum(1)).ravel()
        seat = part_of(subject, np.flatnonzero(share > 0.5))
        when = np.array([(SEATED_S + RISE_S) / 2])
        low, high = self.seat_top + 0.02, self.seat_top + 0.22
        for _ in range(14):
            middle = (low + high) / 2
            self.seated_height = middle
            trunk = self._trunk(when, still=True)
            world = puppet.trunk(trunk)
            puppet.legs(world, trunk.pelvis, *self.footwork.feet(when))
            posed = seat.skin(local_rotations(world), trunk.pelvis - subject.rest_joints[0])
            local = (posed.vertices[0] - self.seat[:3, 3]) @ self.seat[:3, :3]
            if self.thing.surface.signed_distance(local).min() < -PRESSED_M:
                low = middle
            else:
                high = middle
        self.seated_height = high

    def _palm_on_seat(self, side: int, gap: float) -> np.ndarray:
        """A flat hand above the edge of the seat, ``gap`` away (negative: pressed)."""
        hand, sign = self.puppet.hands[side], (1.0, -1.0)[side]
        fingers = unit(np.array([0.12, sign * 0.62, -0.55]))
        palm = unit(np.array([0.08, sign * 0.38, -0.90]))
        rotation = self.puppet.wrist_rotation(side, fingers, palm)
        knuckles = rotation @ hand.knuckles.mean(0)
        place = np.array([-0.05, sign * 0.152, self.seat_top + 0.10]) - knuckles
        low, high = -0.15, 0.10
        for _ in range(18):
            middle = (low + high) / 2
            pose = invert(self.seat) @ transform(rotation, place + np.array([0, 0, middle]))
            if hand.gap(FLAT, self.thing.surface, pose) < gap:
                low = middle
            else:
                high = middle
        return transform(rotation, place + np.array([0, 0, high]))

    def _trunk(self, times: np.ndarray, *, still: bool = False) -> Trunk:
        track = self.pelvis_track(times)
        sway = self.sway(times) * (0.0 if still else 1.0)
        shift = self.weight_shift(times) * (0.0 if still else 1.0)
        # the hips go back before they go down, and up before they come forward
        down = ramp(times, SIT_S, SEATED_S) - ramp(times, RISE_S, RISEN_S)
        back = ramp(times, SIT_S - 0.05, SEATED_S - 0.22)
        back -= ramp(times, RISE_S + 0.16, RISEN_S + 0.05)
        lean = plateau(times, SIT_S - 0.05, SIT_S + 0.38, SEATED_S - 0.15, SEATED_S + 0.15)
        lean = lean + plateau(times, RISE_S - 0.30, RISE_S + 0.05, RISE_S + 0.30, RISEN_S)
        feel = plateau(times, 0.75, 1.1, 1.2, 1.45)
        pelvis = track[:, :3] + shift * (1 - down)[:, None]
        pelvis[:, 0] += back * (0.005 - pelvis[:, 0])
        pelvis[:, 1] *= 1 - 0.7 * down
        pelvis[:, 2] += down * (self.seated_height - pelvis[:, 2])
        bend = 0.6 * sway[:, :3] * (1 - 0.7 * down)[:, None]
        bend[:, 0] += 0.05 + 0.62 * lean - 0.10 * down
        head = 1.3 * sway[:, 3:]
        head[:, 0] += 0.10 + 0.25 * lean + 0.15 * feel
        head[:, 1] -= 0.3 * feel
        return Trunk(pelvis, track[:, 3], bend, head)

    def _on_thigh(self, world: np.ndarray, pelvis: np.ndarray, side: int) -> Pose:
        """The wrist over the thigh of its side, the palm down."""
        puppet, sign = self.puppet, (1.0, -1.0)[side]
        name = ("left", "right")[side]
        hip = pelvis + world[:, 0] @ puppet.skeleton.bone("pelvis", f"{name}_hip")
        thigh = world[:, JOINT_INDEX[f"{name}_hip"]]
        bone = puppet.skeleton.bone(f"{name}_hip", f"{name}_knee")
        along = unit(thigh @ bone)
        above = unit(thigh @ np.array([0, 0, 1.0]))
        position = hip + 0.52 * (thigh @ bone) + 0.105 * above
        position[:, 1] += 0.012 * sign
        fingers = unit(along + np.array([0.0, -0.15 * sign, 0.0]) + 0.10 * above)
        return Pose(position, puppet.wrist_rotation(side, fingers, -above))

    def _wrist(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray, side: int) -> Pose:
        count = len(times)
        swing = 0.06 * bump(times, 0, 0.5) * (1, -1)[side] + self.arm_swing(times)[:, side]
        idle = self.puppet.idle_wrist(world, pelvis, side, swing)
        place = (self.hover_place, self.palm_place)[side]
        start, touch, leave = ((0.90, 1.16, 1.22), (0.88, 1.14, 1.24))[side]
        above = place.copy()
        above[:3, 3] += (0.02, (0.06, -0.06)[side], 0.12)
        wrist = idle.towards(Pose.still(above, count), ramp(times, start - 0.2, touch - 0.10))
        wrist = wrist.towards(Pose.still(place, count), ramp(times, touch - 0.22, touch))
        wrist = wrist.towards(Pose.still(above, count), ramp(times, leave, leave + 0.16))
        thigh = self._on_thigh(world, pelvis, side)
        wrist = wrist.towards(thigh, ramp(times, leave + 0.08, SEATED_S + 0.20))
        return wrist.towards(idle, ramp(times, RISE_S + 0.10, RISEN_S + 0.05))

    def perform(self, times: np.ndarray) -> Performance:
        puppet = self.puppet
        trunk = self._trunk(times)
        world = puppet.trunk(trunk)
        puppet.legs(world, trunk.pelvis, *self.footwork.feet(times))
        feel = plateau(times, 0.98, 1.14, 1.24, 1.42)
        for _ in range(2):
            targets = {
                side: (self._wrist(world, trunk.pelvis, times, side), feel)
                for side in (LEFT, RIGHT)
            }
            trunk = puppet.assist(trunk, targets)
            world = puppet.trunk(trunk)
            puppet.legs(world, trunk.pelvis, *self.footwork.feet(times))
        pelvis = trunk.pelvis
        for side in (LEFT, RIGHT):
            puppet.arm_to(world, pelvis, side, self._wrist(world, pelvis, times, side), 0.15)
            keys: list[tuple[np.ndarray, HandShape]] = [
                (ramp(times, 0.6, 0.9), FLAT),
                (ramp(times, 1.3, 1.7), RELAXED),
            ]
            puppet.fingers(world, side, puppet.finger_track(side, RELAXED, keys))
        pose = np.broadcast_to(self.seat, (len(times), 4, 4)).copy()
        return Performance(world, pelvis, pose)
