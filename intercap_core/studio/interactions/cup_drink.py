"""Step up to a plinth, take the cup around its wall, drink, put it back."""

from __future__ import annotations

from itertools import product

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.camera.transforms import invert
from intercap_core.studio.controls import Footwork, Pose, Step, bump, plateau, ramp
from intercap_core.studio.hands import OPEN, RELAXED, HandShape, part_of, shape
from intercap_core.studio.interactions.base import (
    SCRIPT_S,
    Box,
    Interaction,
    Performance,
    held_object,
    transform,
    upright,
)
from intercap_core.studio.motion import LEG_REACH, Trunk
from intercap_core.studio.skeleton import turn, unit

RIGHT, LEFT = 1, 0
LIMITS = {"finger": (75.0, 95.0, 60.0), "thumb": (40.0, 50.0, 60.0)}
ATTACH_S, RELEASE_S = 1.06, 2.50
PLINTH_OF_HEIGHT = 0.565  # its top, as a share of the person's height
PALM_PRESSED_M = 0.001
FINGER_MEETS_M = 0.002
LIP_GAP_M = 0.0008  # the rim rests this close to the lips
TABLE_GAP_M = 0.004  # the hand stays this far above the plinth
HOVER_M = (0.007, 0.018)  # how near the other hand comes without touching


class CupDrink(Interaction):
    """The cup's handle points to the person's left; the right hand holds the wall."""

    object_class = "cup"
    highlight = 1.75
    centre = (0.18, -0.05)

    def plan(self) -> None:
        rng, puppet = self.rng, self.puppet
        top = PLINTH_OF_HEIGHT * puppet.subject.height_m + rng.uniform(-0.03, 0.03)
        half = 0.17
        self.furniture.append(
            Box((0.38, -0.12 - half, 0.0), (0.38 + 2 * half, -0.12 + half, top), 0.0, "wood")
        )
        self.rest = upright(
            0.46 + rng.uniform(0, 0.03), -0.13 + rng.uniform(-0.03, 0.03),
            top + self.thing.standing_height, np.radians(95) + rng.normal(0, 0.15),
        )  # fmt: skip
        self.back = upright(
            self.rest[0, 3] + rng.uniform(-0.01, 0.04), self.rest[1, 3] + rng.uniform(-0.03, 0.05),
            self.rest[2, 3], np.arctan2(self.rest[1, 0], self.rest[0, 0]) + rng.normal(0, 0.2),
        )  # fmt: skip
        w = puppet.hip_width * 1.05
        steps = [
            Step(RIGHT, 0.02, 0.40, (0.0, -w)),
            Step(LEFT, 0.34, 0.72, (0.02, w)),
        ]
        start = np.array([[-0.24, w], [-0.22, -w]])
        self.footwork = Footwork(start, 0.0, steps, puppet.ankle_height, SCRIPT_S)
        self.pelvis_track = self.footwork.pelvis(
            LEG_REACH * puppet.leg, puppet.hip_width, puppet.hip_drop, puppet.stand
        )
        self.tilt = np.radians(rng.uniform(42, 52))
        self.hover = rng.uniform(*HOVER_M)
        self._grasp(top)
        self._drinking_place()
        self._hovering_place()

    # --- places found on the person's own surface ------------------------------------------

    def _grasp(self, top: float) -> None:
        """The palm against the wall, then fingers and thumb around it; of several openings of the
        hand the first in which all fingers meet the wall, else the best."""
        best = -np.inf
        for opposition, azimuth in product((48.0, 30.0, 62.0), np.radians((62.0, 78.0, 50.0))):
            open_shape = shape((10, 12, 6), (0, 4, 6), opposition, 3)
            pose = self._palm_to_wall(open_shape, azimuth, top)
            closed, gaps = self.puppet.hands[RIGHT].close(
                open_shape, LIMITS, self.thing.surface, pose
            )
            score = -np.clip(gaps, 0, 0.03).sum()
            if score > best:
                best, self.open_shape, self.grip_shape = score, open_shape, closed
                self.grip_gaps, self.object_from_wrist = gaps, pose
            if gaps.max() < FINGER_MEETS_M:
                return

    def _palm_to_wall(self, open_shape: HandShape, azimuth: float, top: float) -> np.ndarray:
        """object_from_wrist (4, 4): the open hand just above the plinth's ``top``, fingers turned
        left of ahead by ``azimuth`` rad, brought to the wall until it touches."""
        hand = self.puppet.hands[RIGHT]
        fingers = unit(np.array([np.sin(azimuth), np.cos(azimuth), -0.10]))
        palm = np.array([-np.cos(azimuth), np.sin(azimuth), 0.0])
        rotation = self.puppet.wrist_rotation(RIGHT, fingers, palm)
        skin = hand.skin(hand.local(open_shape)[None])[0] @ rotation.T
        place = self.rest[:3, 3] - skin[hand.palm_ids].mean(0) - 0.028 * fingers
        place[2] = top + TABLE_GAP_M - skin[:, 2].min()
        near, far = 0.0, 0.12
        for _ in range(14):
            middle = (near + far) / 2
            pose = invert(self.rest) @ transform(rotation, place - middle * palm)
            if hand.gap(open_shape, self.thing.surface, pose) < -PALM_PRESSED_M:
                near = middle
            else:
                far = middle
        return invert(self.rest) @ transform(rotation, place - far * palm)

    def _drinking_place(self) -> None:
        """head_from_cup (4, 4): the rim against the lips, tilted; rest axes at the head joint."""
        subject = self.puppet.subject
        head = JOINT_INDEX["head"]
        share = np.asarray(subject.weights[:, [head, JOINT_INDEX["jaw"]]].sum(1)).ravel()
        eyes = subject.rest_joints[JOINT_INDEX["left_eye_smplhf"], 1]
        ids = np.flatnonzero((share > 0.9) & (subject.rest[:, 1] < eyes))
        face = part_of(subject, ids).rest - subject.rest_joints[head]
        middle = np.abs(face[:, 0]) < 0.012
        corner = self.mouth - subject.rest_joints[head]
        front = face[middle & (np.abs(face[:, 1] - corner[1]) < 0.01), 2].max()
        # the cup's axis leans towards the face; its near rim is at the lips
        lean = self.tilt
        up = np.array([0.0, np.cos(lean), -np.sin(lean)])
        side = np.array([1.0, 0, 0])  # the handle points to the person's left
        rotation = np.stack([side, np.cross(up, side), up], 1)
        rim_up = self.thing.vertices[:, 2].max()
        rim = self.thing.vertices[self.thing.vertices[:, 2] > rim_up - 0.003]
        rim_out = np.linalg.norm(rim[:, :2], axis=1).max()
        near_rim = rotation @ np.array([0.0, 0, rim_up])
        across = np.cross(side, up)
        across *= -np.sign(across[2])
        near_rim = near_rim + rim_out * across
        mouth = np.array([0.0, corner[1] - 0.003, front])
        low, high = -0.03, 0.05
        for _ in range(18):
            ahead = (low + high) / 2
            centre = mouth + np.array([0, 0, ahead]) - near_rim
            if self.thing.surface.signed_distance((face - centre) @ rotation).min() < LIP_GAP_M:
                low = ahead
            else:
                high = ahead
        self.head_from_cup = transform(rotation, mouth + np.array([0, 0, high]) - near_rim)

    @property
    def mouth(self) -> np.ndarray:
        """The middle of the mouth in the T-pose (3,): where the jaw's skin meets the head's."""
        subject = self.puppet.subject
        both = [JOINT_INDEX["head"], JOINT_INDEX["jaw"]]
        weights = np.asarray(subject.weights[:, both].todense())
        middle = np.abs(subject.rest[:, 0]) < 0.015
        front = subject.rest[:, 2] > subject.rest[middle & (weights.sum(1) > 0.9), 2].max() - 0.035
        pick = middle & front & (weights.min(1) > 0.05)
        heights = subject.rest[pick, 1]
        return np.array([0.0, float(np.median(heights)), float(subject.rest[pick, 2].mean())])

    def _hovering_place(self) -> None:
        """The left hand flat beside the cup, ``hover`` away, as if to steady it."""
        hand = self.puppet.hands[LEFT]
        fingers = np.array([0.80, -0.45, -0.20])
        palm = np.array([-0.45, -0.85, 0.0])
        rotation = self.puppet.wrist_rotation(LEFT, fingers / np.linalg.norm(fingers), palm)
        skin = hand.skin(hand.local(OPEN)[None])[0] @ rotation.T
        place = self.rest[:3, 3] - skin[hand.palm_ids].mean(0) - 0.03 * fingers
        place[2] = self.rest[2, 3] + 0.03 - skin[:, 2].mean()
        low, high = 0.0, 0.25
        for _ in range(16):
            middle = (low + high) / 2
            pose = invert(self.rest) @ transform(rotation, place - middle * palm)
            if hand.gap(OPEN, self.thing.surface, pose) < self.hover:
                low = middle
            else:
                high = middle
        self.left_place = transform(rotation, place - high * palm)

    # --- the script --------------------------------------------------------------------------

    def _trunk(self, times: np.ndarray) -> Trunk:
        track = self.pelvis_track(times)
        sway, shift = self.sway(times), self.weight_shift(times)
        reach = plateau(times, 0.4, 1.0, 1.1, 1.6) + plateau(times, 2.0, 2.45, 2.55, 3.0)
        drink = plateau(times, 1.25, 1.7, 2.05, 2.4)
        pelvis = track[:, :3] + shift
        pelvis[:, 2] -= 0.01
        bend = 0.6 * sway[:, :3]
        bend[:, 0] += 0.03 + 0.16 * reach - 0.03 * drink
        bend[:, 1] += 0.10 * reach
        head = 1.3 * sway[:, 3:]
        head[:, 0] += 0.10 + 0.28 * reach - 0.22 * drink
        head[:, 1] -= 0.12 * reach
        return Trunk(pelvis, track[:, 3], bend, head)

    def _right_wrist(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> Pose:
        count = len(times)
        puppet, grip = self.puppet, self.object_from_wrist
        idle = puppet.idle_wrist(world, pelvis, RIGHT, 0.08 * bump(times, 0, 0.6)
                                 + self.arm_swing(times)[:, 0])  # fmt: skip
        first, last = self.rest @ grip, self.back @ grip
        outward = first[:3, :3] @ -puppet.hands[RIGHT].palm
        before, after = first.copy(), last.copy()
        before[:3, 3] += 0.07 * outward + (-0.03, 0, 0.01)
        after[:3, 3] += 0.08 * outward + (-0.04, 0, 0.01)
        head = np.broadcast_to(np.eye(4), (count, 4, 4)).copy()
        head[:, :3, :3] = world[:, JOINT_INDEX["head"]]
        head[:, :3, 3] = puppet.joint_on_trunk(world, pelvis, "head")
        cup = head @ self.head_from_cup
        # before and after the drink the cup is upright, a little lower and ahead of the lips
        pour = plateau(times, 1.45, 1.80, 2.00, 2.30)
        ease = (1 - pour)[:, None, None] * np.eye(3)[0] * self.tilt * 0.85
        loose = cup.copy()
        loose[:, :3, :3] = cup[:, :3, :3] @ turn(ease[:, 0])
        loose[:, :3, 3] += (1 - pour)[:, None] * (head[:, :3, :3] @ np.array([0.0, -0.035, 0.055]))
        at_lips = loose @ grip
        drinking = Pose(at_lips[:, :3, 3], at_lips[:, :3, :3])
        lift = np.array([0.0, 0, 0.05])
        over = before.copy()
        over[:3, 3] += (-0.05, 0, 0.10)
        off = after.copy()
        off[:3, 3] += (-0.08, 0, 0.10)
        wrist = idle.towards(Pose.still(over, count), ramp(times, 0.15, 0.68))
        wrist = wrist.towards(Pose.still(before, count), ramp(times, 0.55, 0.86))
        wrist = wrist.towards(Pose.still(first, count), ramp(times, 0.80, 1.00))
        wrist = wrist.towards(drinking, ramp(times, ATTACH_S, 1.72), lift)
        wrist = wrist.towards(Pose.still(last, count), ramp(times, 2.02, RELEASE_S - 0.03), lift)
        wrist = wrist.towards(Pose.still(after, count), ramp(times, 2.58, 2.75))
        wrist = wrist.towards(Pose.still(off, count), ramp(times, 2.68, 2.92))
        return wrist.towards(idle, ramp(times, 2.82, 3.3))

    def _left_wrist(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> Pose:
        count = len(times)
        idle = self.puppet.idle_wrist(world, pelvis, LEFT, self.arm_swing(times)[:, 1])
        near = Pose.still(self.left_place, count)
        away = self.left_place.copy()
        away[:3, 3] += (-0.10, 0.10, 0.10)
        wrist = idle.towards(Pose.still(away, count), ramp(times, 0.2, 0.75))
        wrist = wrist.towards(near, ramp(times, 0.65, 0.95))
        wrist = wrist.towards(Pose.still(away, count), ramp(times, 1.02, 1.3))
        return wrist.towards(idle, ramp(times, 1.2, 1.8))

    def perform(self, times: np.ndarray) -> Performance:
        puppet = self.puppet
        trunk, feet = self._trunk(times), self.footwork.feet(times)
        world = puppet.trunk(trunk)
        at_table = plateau(times, 0.4, 0.85, 1.1, 1.5) + plateau(times, 2.1, 2.4, 2.7, 3.0)
        near = plateau(times, 0.4, 0.85, 1.02, 1.4)
        for _ in range(2):
            targets = {
                RIGHT: (self._right_wrist(world, trunk.pelvis, times), at_table),
                LEFT: (self._left_wrist(world, trunk.pelvis, times), near),
            }
            trunk = puppet.settled(puppet.assist(trunk, targets), feet[0])
            world = puppet.trunk(trunk)
        pelvis = trunk.pelvis
        puppet.legs(world, pelvis, *feet)
        drink = plateau(times, 1.2, 1.7, 2.0, 2.4)
        puppet.arm_to(world, pelvis, RIGHT, self._right_wrist(world, pelvis, times), 0.1 * drink)
        puppet.arm_to(world, pelvis, LEFT, self._left_wrist(world, pelvis, times))
        right: list[tuple[np.ndarray, HandShape]] = [
            (ramp(times, 0.3, 0.75), self.open_shape),
            (ramp(times, 0.94, ATTACH_S - 0.01), self.grip_shape),
            (ramp(times, RELEASE_S + 0.01, 2.60), self.open_shape),
            (ramp(times, 2.75, 3.1), RELAXED),
        ]
        left: list[tuple[np.ndarray, HandShape]] = [
            (ramp(times, 0.3, 0.7), OPEN),
            (ramp(times, 1.2, 1.6), RELAXED),
        ]
        puppet.fingers(world, RIGHT, puppet.finger_track(RIGHT, RELAXED, right))
        puppet.fingers(world, LEFT, puppet.finger_track(LEFT, RELAXED, left))
        held = held_object(puppet, world, pelvis, RIGHT, self.object_from_wrist)
        pose = np.where((times <= ATTACH_S)[:, None, None], self.rest, held)
        pose = np.where((times >= RELEASE_S)[:, None, None], self.back, pose)
        return Performance(world, pelvis, pose)
