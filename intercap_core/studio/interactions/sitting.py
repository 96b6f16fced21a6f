"""Step back to a seat, feel for its edge, sit down, rest, rise.

Conventions of numbers, columns and frames: :mod:`.base`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.studio.controls import (
    Footwork,
    Guide,
    PoseTrack,
    Step,
    bisect,
    bump,
    plateau,
    ramp,
)
from intercap_core.studio.hands import FLAT, RELAXED, HandShape, part_of
from intercap_core.studio.interactions.base import Interaction, Performance, shifted, upright
from intercap_core.studio.interactions.grasps import backed_off
from intercap_core.studio.motion import LEFT, RIGHT, Foot, Trunk, still
from intercap_core.studio.skeleton import local_rotations, unit


class Sitting(Interaction):
    """The person stands before the seat with the back to it; the seat's middle is at the origin."""

    highlight = 1.75
    centre = (0.15, 0.0)
    rise_s, risen_s = 2.10, 2.90  # start and end of rising, script time
    palm_at: tuple[float, float]  # x, y where the right palm feels for the edge, metres
    hanging = 0.0  # weight from 0 to 1 with which the trunk helps the left hand of a sitting person
    sat_back = 0.005  # where the pelvis sits, metres ahead of the seat's middle
    recline = 0.10  # rad
    front_edge = 0.0  # the seat's front from its middle, metres; 0 where the legs may spread
    back_by_s = 0.30  # the pelvis is above its place this long before the person sits, seconds
    on_thigh_s = 1.74  # the hands lie on the thighs from then on, script time
    sit_s = 0.68  # start of sitting down, script time
    seated_s = 1.50  # end of sitting down, script time
    calf_m = 0.055  # half the calf's thickness at the knee, metres
    thigh_m = 0.065  # half the thigh's thickness at the knee, metres
    around_m = 0.14  # sideways detour of a hand between lap and hanging, metres
    palm_m = 0.056  # from the wrist to the surface below a level palm with trousers, metres
    steepest_rad = 0.75  # largest pitch of a foot that stands on its ball
    pressed_m = 0.014  # depth to which the seat presses the flesh, metres
    touch_m = 0.0006  # depth to which the palm presses the seat, metres

    def plan(self) -> None:
        rng, puppet = self.rng, self.puppet
        thigh = puppet.skeleton.length("left_hip", "left_knee")
        self.seat = upright(0.0, 0.0, self.prop.standing_height, self.turned())
        middle = (np.abs(self.prop.vertices[:, :2]) < 0.10).all(1)
        self.seat_top = self.seat[2, 3] + self.prop.vertices[middle, 2].max()
        # feet before the seat's middle, the calves clear of its front
        self.sat_back = max(self.sat_back, self.front_edge + self.calf_m - thigh)
        self.ahead = thigh * rng.uniform(0.90, 0.98) + self.sat_back
        self.ahead = max(self.ahead, self.front_edge + 2 * self.calf_m + rng.uniform(0.0, 0.02))
        w = puppet.hip_width * 1.15
        before = 0.16
        start = np.array([[self.ahead + before, w], [self.ahead + before - 0.03, -w]])
        steps = [
            Step(RIGHT, 0.02, 0.40, (self.ahead - 0.01, -w)),
            Step(LEFT, 0.32, 0.70, (self.ahead + 0.01, w)),
        ]
        self.walk(start, steps, guides=self._heels(steps))
        self.seated_height = self.seat_top + 0.12
        self.sit()
        self.palm_place = self._palm_on_seat()

    def _heels(self, steps: Sequence[Step]) -> list[Guide]:
        """Guides that lift the heels of people whose knees are lower than the seat.

        Their feet stand on the balls while they sit. The pitch lifts the knee by the missing
        height, at most to ``steepest_rad``.
        """
        puppet, guides = self.puppet, []
        knee = puppet.skeleton.length("left_knee", "left_ankle") + float(puppet.ankle_height[0])
        missing = self.seat_top + self.thigh_m - knee if self.front_edge else 0.0
        pitch = float(np.clip(missing / Footwork.sole_front_m, 0.0, self.steepest_rad))
        for step in steps:
            place = np.array([*step.place, 0.0, pitch, step.heading])
            place[2] = -Foot(puppet, step.foot).skin(place[None])[0, :, 2].min()
            on_ball = still(place)
            guides.append(Guide(step.foot, self.sit_s + 0.1, self.seated_s - 0.2, on_ball))
            guides.append(Guide(step.foot, self.rise_s + 0.1, self.risen_s - 0.1))
        return guides if pitch else []

    @abstractmethod
    def turned(self) -> float:
        """The seat's heading, rad."""

    def sit(self) -> None:
        """Find ``seated_height``: lower the pelvis until the seat presses the flesh in.

        The depth is ``pressed_m``.
        """
        puppet, subject = self.puppet, self.puppet.subject
        low_part = [JOINT_INDEX[n] for n in ("pelvis", "left_hip", "right_hip", "spine1")]
        share = np.asarray(subject.weights[:, low_part].sum(1)).ravel()
        seat = part_of(subject, np.flatnonzero(share > 0.5))
        when = np.array([(self.seated_s + self.rise_s) / 2])

        def is_too_low(height: float) -> bool:
            self.seated_height = height
            trunk = self.trunk(when, still=True)
            world = puppet.trunk(trunk)
            puppet.legs(world, trunk.pelvis, *self.footwork.feet(when))
            posed = seat.skin(local_rotations(world), trunk.pelvis - subject.rest_joints[0])
            local = (posed.vertices[0] - self.seat[:3, 3]) @ self.seat[:3, :3]
            return bool(self.prop.surface.signed_distance(local).min() < -self.pressed_m)

        _, self.seated_height = bisect(self.seat_top + 0.02, self.seat_top + 0.22, 14, is_too_low)

    def _palm_on_seat(self) -> np.ndarray:
        """The right hand flat on the edge of the seat, lightly pressed."""
        hand = self.puppet.hands[RIGHT]
        fingers = unit(np.array([0.12, -0.62, -0.55]))
        palm = unit(np.array([0.08, -0.38, -0.90]))
        rotation = self.puppet.wrist_rotation(RIGHT, fingers, palm)
        place = np.array([*self.palm_at, self.seat_top + 0.10]) - rotation @ hand.knuckles.mean(0)
        return backed_off(
            hand, FLAT, self.prop.surface, self.seat, rigid(rotation, place),
            np.array([0, 0, 1.0]), -self.touch_m, reach_m=(-0.15, 0.12), steps=18,
        )  # fmt: skip

    def trunk(self, times: np.ndarray, *, still: bool = False) -> Trunk:
        """Trunk (N) of sitting down and rising; ``still`` leaves out sway and weight shift."""
        track = self.pelvis_track(times)
        sway = self.sway(times) * (0.0 if still else 1.0)
        shift = self.weight_shift(times) * (0.0 if still else 1.0)
        # the hips go back before they go down, and up before they come forward
        down = ramp(times, self.sit_s, self.seated_s) - ramp(times, self.rise_s, self.risen_s)
        back = ramp(times, self.sit_s - 0.12, self.seated_s - self.back_by_s)
        back -= ramp(times, self.rise_s + 0.16, self.risen_s + 0.05)
        lean = plateau(
            times, self.sit_s - 0.12, self.sit_s + 0.36, self.seated_s - 0.20, self.seated_s + 0.20
        )
        up = self.rise_s
        lean = lean + plateau(times, up - 0.30, up + 0.05, up + 0.30, self.risen_s)
        feel = plateau(times, 0.72, 1.16, 1.30, 1.75)
        pelvis = track[:, :3] + shift * (1 - down)[:, None]
        pelvis[:, 0] += back * (self.sat_back - pelvis[:, 0])
        pelvis[:, 1] *= 1 - 0.7 * down
        pelvis[:, 2] += down * (self.seated_height - pelvis[:, 2])
        bend = 0.6 * sway[:, :3] * (1 - 0.7 * down)[:, None]
        bend[:, 0] += 0.05 + 0.60 * lean + 0.10 * feel - self.recline * down
        bend[:, 2] += 0.30 * feel
        bend[:, 1] -= 0.12 * feel
        head = 1.3 * sway[:, 3:]
        head[:, 0] += 0.10 + 0.25 * lean + 0.15 * feel
        head[:, 1] -= 0.3 * feel
        return Trunk(pelvis, track[:, 3], bend, head)

    def on_thigh(self, world: np.ndarray, pelvis: np.ndarray, side: int) -> PoseTrack:
        """The wrist over the thigh of its side, the palm down."""
        puppet, sign = self.puppet, (1.0, -1.0)[side]
        name = ("left", "right")[side]
        hip = pelvis + world[:, 0] @ puppet.skeleton.bone("pelvis", f"{name}_hip")
        thigh = world[:, JOINT_INDEX[f"{name}_hip"]]
        bone = puppet.skeleton.bone(f"{name}_hip", f"{name}_knee")
        along = unit(thigh @ bone)
        above = unit(thigh @ np.array([0, 0, 1.0]))
        position = hip + 0.52 * (thigh @ bone) + (puppet.thigh_height[side] + self.palm_m) * above
        position[:, 1] += 0.012 * sign
        fingers = unit(along + np.array([0.0, -0.15 * sign, 0.0]) + 0.10 * above)
        return PoseTrack(position, puppet.wrist_rotation(side, fingers, -above))

    def _wrist(
        self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray, side: int
    ) -> PoseTrack:
        """Wrist (N): hanging, at the seat's edge (right hand), on the thigh, hanging."""
        swing = 0.06 * bump(times, 0, 0.5) * (1, -1)[side] + self.arm_swing(times)[:, side]
        idle = self.puppet.idle_wrist(world, pelvis, side, swing)
        rising = ramp(times, self.rise_s + 0.10, self.risen_s + 0.05)
        if side == LEFT:
            wrist = self.left_wrist(idle, world, pelvis, times).towards(idle, rising)
            return self._around_thigh(wrist, rising, LEFT)
        thigh = self.on_thigh(world, pelvis, side)
        place = self.palm_place
        aside = shifted(place, (0.0, -0.05, 0.11))
        off = shifted(aside, (0.0, -0.10, 0.0))  # out of the way of the hips
        wrist = idle.through(times, (aside, 0.54, 1.00), (place, 0.86, 1.12), (off, 1.12, 1.34))
        lifting = ramp(times, 1.36, self.on_thigh_s)
        wrist = self._around_thigh(wrist.towards(thigh, lifting), lifting, RIGHT)
        return self._around_thigh(wrist.towards(idle, rising), rising, RIGHT)

    def _around_thigh(self, wrist: PoseTrack, share: np.ndarray, side: int) -> PoseTrack:
        """The wrist led outwards while it is on its way (``share`` (N,)) past the thigh."""
        out = self.around_m * 4 * share * (1 - share) * (1, -1)[side]
        return PoseTrack(wrist.position + out[:, None] * np.array([0.0, 1.0, 0.0]), wrist.rotation)

    def left_wrist(
        self, idle: PoseTrack, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray
    ) -> PoseTrack:
        """The left wrist (N) until the person rises."""
        return idle.towards(self.on_thigh(world, pelvis, LEFT), ramp(times, 0.50, 1.10))

    def perform(self, times: np.ndarray) -> Performance:
        puppet = self.puppet
        feet = self.footwork.feet(times)
        trunk = puppet.settled(self.trunk(times), feet[0])
        world = puppet.trunk(trunk)
        puppet.legs(world, trunk.pelvis, *feet)
        feel = plateau(times, 0.90, 1.20, 1.30, 1.60)
        hanging = self.hanging * plateau(times, 1.3, 1.6, 1.95, 2.25)
        for _ in range(2):  # the wrists' paths follow the trunk, which bends for the wrists
            right = self._wrist(world, trunk.pelvis, times, RIGHT)
            left = self._wrist(world, trunk.pelvis, times, LEFT)
            trunk = puppet.assist(trunk, {RIGHT: (right, feel), LEFT: (left, hanging)})
            trunk = puppet.settled(trunk, feet[0])
            world = puppet.trunk(trunk)
            puppet.legs(world, trunk.pelvis, *feet)
        pelvis = trunk.pelvis
        for side in (LEFT, RIGHT):
            puppet.arm_to(world, pelvis, side, self._wrist(world, pelvis, times, side), 0.15)
        keys: list[tuple[np.ndarray, HandShape]] = [
            (ramp(times, 0.7, 1.05), FLAT),
            (ramp(times, 1.4, 1.8), RELAXED),
        ]
        puppet.fingers(world, RIGHT, puppet.finger_track(RIGHT, keys))
        puppet.fingers(world, LEFT, puppet.finger_track(LEFT, []))
        pose = np.broadcast_to(self.seat, (len(times), 4, 4)).copy()
        return Performance(world, pelvis, pose)


class StoolSit(Sitting):
    """A round seat without a back; the left hand hangs near its rim."""

    object_class = "stool"
    palm_at = (-0.02, -0.16)
    hanging = 1.0
    hover_m = (0.006, 0.016)  # range of the gap between the left hand and the seat, metres

    def plan(self) -> None:
        super().plan()
        self.hover_place = self._beside_seat(self.rng.uniform(*self.hover_m))

    def turned(self) -> float:
        return self.rng.uniform(0, np.pi / 2)

    def _beside_seat(self, hover: float) -> np.ndarray:
        """The left hand hanging near the seat's rim, ``hover`` metres away."""
        hand = self.puppet.hands[LEFT]
        fingers, palm = unit(np.array([0.15, 0.10, -1.0])), np.array([0.0, -1.0, -0.1])
        rotation = self.puppet.wrist_rotation(LEFT, fingers, palm)
        place = np.array([0.02, 0.20, self.seat_top - 0.02]) - rotation @ hand.knuckles.mean(0)
        return backed_off(
            hand, RELAXED, self.prop.surface, self.seat, rigid(rotation, place),
            np.array([0, 1.0, 0]), hover, reach_m=(-0.15, 0.12), steps=18,
        )  # fmt: skip

    def left_wrist(
        self, idle: PoseTrack, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray
    ) -> PoseTrack:
        place, aside = self.hover_place, shifted(self.hover_place, (0.0, 0.07, 0.06))
        return idle.through(
            times, (aside, 0.9, self.seated_s), (place, 1.38, 1.66), (aside, 1.92, 2.15)
        )


class ChairSit(Sitting):
    """The chair's front is ahead; both hands come to rest on the thighs."""

    object_class = "chair"
    palm_at = (-0.02, -0.19)
    rise_s, risen_s = 2.40, 3.20
    sat_back = -0.12
    front_edge, on_thigh_s = 0.262, 1.95
    back_by_s = 0.12
    back_pressed_m = 0.006  # depth to which the slats press the back, metres
    over_seat_m = 0.04  # skin less than this above the seat is not tested against the back, metres
    sits_above_m = 0.13  # first guess of the pelvis above the seat, metres
    upright_rad = 0.08  # recline at which the sitting place is found
    reclined_rad = 0.65  # recline, at most
    farthest_ahead_m = 0.04  # the pelvis ahead of the seat's middle, at most, metres

    def turned(self) -> float:
        return np.pi / 2 + self.rng.normal(0, 0.03)

    def sit(self) -> None:
        """Sit as far back as an upright back has room, then lean back until the slats press it.

        Finds ``sat_back``, ``recline`` and ``seated_height``.
        """
        subject = self.puppet.subject
        bones = [JOINT_INDEX[name] for name in ("pelvis", "spine1", "spine2", "spine3")]
        share = np.asarray(subject.weights[:, bones].sum(1)).ravel()
        back = part_of(subject, np.flatnonzero(share > 0.5))
        when = np.array([(self.seated_s + self.rise_s) / 2])

        def is_pressed() -> bool:
            trunk = self.trunk(when, still=True)
            local = local_rotations(self.puppet.trunk(trunk))
            posed = back.skin(local, trunk.pelvis - subject.rest_joints[0]).vertices[0]
            at = (posed - self.seat[:3, 3]) @ self.seat[:3, :3]
            at = at[at[:, 2] + self.seat[2, 3] > self.seat_top + self.over_seat_m]
            return float(self.prop.surface.signed_distance(at).min()) < -self.back_pressed_m

        self.seated_height, self.recline = self.seat_top + self.sits_above_m, self.upright_rad

        def is_too_far_back(ahead: float) -> bool:
            self.sat_back = ahead
            return is_pressed()

        def has_room(recline: float) -> bool:
            self.recline = recline
            return not is_pressed()

        _, self.sat_back = bisect(self.sat_back, self.farthest_ahead_m, 12, is_too_far_back)
        for _ in range(2):
            super().sit()
            self.recline, _ = bisect(0.0, self.reclined_rad, 12, has_room)
        super().sit()
