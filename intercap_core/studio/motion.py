"""A puppet plays controls: trunk first, then legs to the planted feet, then arms to the wrists.

Headings turn about the stage's z axis; a person with heading 0 faces +x. "Stage" is any frame with
z up and the floor at z = 0; scripts use their own. World rotations (N, 55, 3, 3) are
stage_from_rest of SMPL-X's joints; see :mod:`.skeleton`. Numbers without a comment are proportions
set by eye.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline

from intercap_core.body.joints import JOINT_INDEX, PARENTS
from intercap_core.geometry.camera.transforms import rotation_exp
from intercap_core.studio.controls import Footwork, PoseTrack, bisect, ramp
from intercap_core.studio.hands import RELAXED, Hand, HandShape, part_of
from intercap_core.studio.skeleton import (
    PuppetSkeleton,
    blend,
    carry,
    local_rotations,
    twist_angle,
    unit,
)
from intercap_core.studio.subjects import PosedSubject, Subject

SIDES = ("left", "right")
LEFT, RIGHT = range(2)
# How a bend of the trunk is shared along it, from the pelvis up
TRUNK = {"pelvis": 0.30, "spine1": 0.20, "spine2": 0.20, "spine3": 0.30}
SPLAY = 0.12  # rad, feet and knees outward
_J = JOINT_INDEX


def facing(heading: np.ndarray) -> np.ndarray:
    """stage_from_rest rotations (N, 3, 3) of upright people with headings (N,)."""
    cos, sin, zero = np.cos(heading), np.sin(heading), np.zeros_like(heading)
    left = np.stack([-sin, cos, zero], -1)
    up = np.stack([zero, zero, zero + 1], -1)
    forward = np.stack([cos, sin, zero], -1)
    return np.stack([left, up, forward], -1)


def foot_rotations(heading: np.ndarray, pitch: np.ndarray, splay: float = SPLAY) -> np.ndarray:
    """stage_from_rest rotations (N, 2, 2, 3, 3) by side (left, right) and joint (ankle, toes).

    Args:
        heading: (N, 2) of each foot, rad.
        pitch: (N, 2) rad, positive: heel above toes. The toes then follow by 35 %; a negative
            pitch lifts the whole foot's front.
        splay: outward rotation of each foot, rad.
    """
    result = np.empty((*heading.shape, 2, 3, 3))
    for side, sign in enumerate((1.0, -1.0)):
        ahead = facing(heading[:, side] + sign * splay)
        tilt = np.zeros((len(heading), 3))
        tilt[:, 0] = pitch[:, side]
        result[:, side, 0] = ahead @ rotation_exp(tilt)
        tilt[:, 0] = np.minimum(pitch[:, side], 0) + 0.35 * np.maximum(pitch[:, side], 0)
        result[:, side, 1] = ahead @ rotation_exp(tilt)
    return result


@dataclass(frozen=True)
class Trunk:
    """Pose of pelvis, trunk and head over N moments."""

    pelvis: np.ndarray
    """(N, 3) position of the pelvis joint, metres."""
    heading: np.ndarray
    """(N,) rad."""
    bend: np.ndarray
    """(N, 3) rotation vectors of the trunk in the person's axes (x left, y up, z forward)."""
    head: np.ndarray
    """(N, 3) rotation vectors of the head relative to the heading."""


@dataclass(frozen=True)
class PersonState:
    """A person at N moments, stage frame, metres."""

    body: np.ndarray
    """(N, V, 3) skin."""
    clothed: np.ndarray
    """(N, V, 3) surface of the clothes."""
    joints: np.ndarray
    """(N, 55, 3)."""
    pelvis: np.ndarray
    """(N, 3, 3) stage_from_rest rotation of the pelvis."""


def _sole_depth(subject: Subject, side: int) -> float:
    """Height of the ankle (joint 7 or 8) above the sole of a level foot in its shoe, metres."""
    share = np.asarray(subject.weights[:, [7 + side, 10 + side]].sum(1)).ravel()
    return float(subject.rest_joints[7 + side, 1] - subject.rest_clothed[share > 0.5, 1].min())


def _girth(subject: Subject) -> float:
    """Largest distance of the skin of hips and thighs to the side of the pelvis, metres."""
    # joints: pelvis, hips and knees
    legs = np.asarray(subject.weights[:, [0, 1, 2, 4, 5]].sum(1)).ravel() > 0.5
    return float(np.abs(subject.rest[legs, 0] - subject.rest_joints[0, 0]).max())


def _thigh_height(subject: Subject, side: int) -> float:
    """Height of the front of a bent thigh above the line from hip to knee, metres.

    It is measured from 45 to 85 % of the way to the knee.
    """
    hip, knee = subject.rest_joints[1 + side], subject.rest_joints[4 + side]
    own = np.asarray(subject.weights[:, [1 + side]].todense()).ravel() > 0.5
    share = (subject.rest[own, 1] - hip[1]) / (knee[1] - hip[1])
    flexed = subject.rest[own, 2] + subject.bulges[4 + side, own, 2]  # driver 4 + side: the hip
    height = flexed - hip[2] - share * (knee[2] - hip[2])
    return float(height[(share > 0.45) & (share < 0.85)].max())


class Puppet:
    """A subject that can be posed."""

    arm_reach = 0.960  # share of the arm's length beyond which the trunk helps
    assist_steps = 8  # iterations in which the trunk bends to help an arm
    forearm_twist = 0.6  # share of the wrist's roll that the forearm takes
    leg_reach = 0.984  # usable share of the leg's length
    settle_m = 0.004  # softness with which the pelvis sinks where a leg is at its reach, metres
    hand_half_m = 0.045  # half a hand, a sleeve and a trouser leg, metres
    stand_share = 0.990  # hip height when standing, share of the leg's length

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.skeleton = PuppetSkeleton(subject.rest_joints)
        self.hands = (Hand(subject, 0), Hand(subject, 1))
        rest = subject.rest_joints
        # people are not symmetric: both arms' lengths, and the shorter of both sides
        self.leg = min(self.skeleton.length(f"{s}_hip", f"{s}_knee", f"{s}_ankle") for s in SIDES)
        self.arms = [
            self.skeleton.length(f"{s}_shoulder", f"{s}_elbow", f"{s}_wrist") for s in SIDES
        ]
        self.arm = min(self.arms)
        self.hip_width = float(rest[_J["left_hip"], 0] - rest[_J["right_hip"], 0]) / 2
        self.hip_drop = float(rest[0, 1] - rest[[1, 2], 1].mean())
        self.ankle_height = np.array([_sole_depth(subject, side) for side in (0, 1)])
        self.girth = _girth(subject)
        self.thigh_height = [_thigh_height(subject, side) for side in (0, 1)]
        self.stand = self.stand_share * self.leg + float(self.ankle_height.min()) + self.hip_drop

    def trunk(self, trunk: Trunk) -> np.ndarray:
        """World rotations (N, 55, 3, 3) with the trunk and head set, limbs hanging on them."""
        count = len(trunk.pelvis)
        world = np.empty((count, 55, 3, 3))
        base = facing(trunk.heading)
        rotation = base
        for name, share in TRUNK.items():
            rotation = rotation @ rotation_exp(share * trunk.bend)
            world[:, _J[name]] = rotation
        head = base @ rotation_exp(trunk.head)
        neck = blend(rotation, head, np.full(count, 0.45))
        world[:, _J["neck"]] = neck
        for name in ("head", "jaw", "left_eye_smplhf", "right_eye_smplhf"):
            world[:, _J[name]] = head
        for side in SIDES:
            chest = ("collar", "shoulder", "elbow", "wrist")
            for name in chest:
                world[:, _J[f"{side}_{name}"]] = rotation
            for name in ("hip", "knee", "ankle", "foot"):
                world[:, _J[f"{side}_{name}"]] = world[:, 0]
        # the fingers follow the wrists, joints 20 and 21
        world[:, 25:40] = world[:, 20:21]
        world[:, 40:55] = world[:, 21:22]
        return world

    def pelvis_track(self, footwork: Footwork, hip_width: float | None = None) -> CubicSpline:
        """Pelvis position and heading (4 channels) over time that follows the feet.

        ``hip_width``: from the midline to each hip, metres; None: this person's.
        """
        width = self.hip_width if hip_width is None else hip_width
        return footwork.pelvis(self.leg_reach * self.leg, width, self.hip_drop, self.stand)

    def settled(self, trunk: Trunk, ankle: np.ndarray) -> Trunk:
        """The same trunk, lowered at moments when a leg cannot reach its ankle (N, 2, 3).

        The pelvis sinks by a smooth maximum of 0 and the excess height (softplus).
        """
        rotation = self.trunk(trunk)[:, 0]
        excess = np.full(len(trunk.pelvis), -np.inf)
        for side, name in enumerate(SIDES):
            hip = trunk.pelvis + rotation @ self.skeleton.bone("pelvis", f"{name}_hip")
            far = np.linalg.norm(hip[:, :2] - ankle[:, side, :2], axis=1)
            reach = np.sqrt(np.maximum((self.leg_reach * self.leg) ** 2 - far**2, 0.01))
            excess = np.maximum(excess, hip[:, 2] - ankle[:, side, 2] - reach)
        pelvis = trunk.pelvis.copy()
        pelvis[:, 2] -= self.settle_m * np.logaddexp(0, excess / self.settle_m)
        return replace(trunk, pelvis=pelvis)

    def legs(
        self,
        world: np.ndarray,
        pelvis: np.ndarray,
        ankle: np.ndarray,
        heading: np.ndarray,
        pitch: np.ndarray,
        splay: float = SPLAY,
    ) -> None:
        """Set the legs for ankles (N, 2, 3), foot headings and pitch (N, 2), in place.

        The knees point between the pelvis's and the foot's heading, ``splay`` rad outward.
        """
        hinge = np.array([1.0, 0, 0])
        feet = foot_rotations(heading, pitch, splay)
        for side, (name, sign) in enumerate(zip(SIDES, (1.0, -1.0), strict=True)):
            hip = pelvis + world[:, 0] @ self.skeleton.bone("pelvis", f"{name}_hip")
            names = (f"{name}_hip", f"{name}_knee", f"{name}_ankle")
            foot, toes = feet[:, side].swapaxes(0, 1)
            ahead = facing(heading[:, side] + sign * splay)[:, :, 2]
            pole = unit(world[:, 0, :, 2] * np.array([1, 1, 0.2])) + 1.5 * ahead
            upper, lower = self.skeleton.limb(
                names, hip, ankle[:, side], pole, hinge, self.leg_reach
            )
            world[:, _J[names[0]]], world[:, _J[names[1]]] = upper, lower
            world[:, _J[names[2]]], world[:, _J[f"{name}_foot"]] = foot, toes

    def joint(self, world: np.ndarray, pelvis: np.ndarray, name: str) -> np.ndarray:
        """A joint (N, 3) from rotations (N, 55, 3, 3) of its ancestors and the pelvis (N, 3)."""
        chain = [_J[name]]
        while chain[0] != _J["pelvis"]:
            chain.insert(0, PARENTS[chain[0]])
        at, rest = pelvis, self.skeleton.rest
        for a, b in pairwise(chain):
            at = at + world[:, a] @ (rest[b] - rest[a])
        return at

    def shoulder(self, world: np.ndarray, pelvis: np.ndarray, side: int) -> np.ndarray:
        """Shoulder joint (N, 3)."""
        return self.joint(world, pelvis, f"{SIDES[side]}_shoulder")

    def idle_wrist(
        self, world: np.ndarray, pelvis: np.ndarray, side: int, swing: np.ndarray
    ) -> PoseTrack:
        """The wrist of an arm that hangs and swings by ``swing`` (N,) metres forward."""
        sign = (1.0, -1.0)[side]
        # the heading from the chest's left side: its front may point down and back in a deep stoop
        base = facing(np.arctan2(-world[:, 9, 0, 0], world[:, 9, 1, 0]))
        left, up, forward = base[..., 0], base[..., 1], base[..., 2]
        shoulder = self.shoulder(world, pelvis, side)
        reach = 0.955 * self.arms[side]
        # clear of the hips
        aside = self.girth + self.hand_half_m - sign * ((shoulder - pelvis) * left).sum(1)
        out = np.clip(aside, 0.085, 0.6 * reach)
        down = np.sqrt((0.97 * reach) ** 2 - out**2)
        position = shoulder + sign * out[:, None] * left - down[:, None] * up
        position += (0.05 + swing)[:, None] * forward
        fingers = unit(-up + (0.10 + swing)[:, None] * forward - 0.02 * sign * left)
        palm = unit(-sign * left - 0.25 * forward)
        return PoseTrack(position, self.wrist_rotation(side, fingers, palm))

    def wrist_rotation(self, side: int, fingers: np.ndarray, palm: np.ndarray) -> np.ndarray:
        """Rotation(s) that point the fingers and face the palm along directions (..., 3)."""
        hand = self.hands[side]
        return carry(hand.out, hand.palm, fingers, palm)

    def assist(self, trunk: Trunk, targets: dict[int, tuple[PoseTrack, np.ndarray]]) -> Trunk:
        """Bend the trunk at moments when an arm cannot reach its target.

        Each iteration turns the trunk about the pelvis, so that the shoulder moves towards the
        target by the missing length (softened by 1 cm). ``targets``: wrist target and weight (N,)
        in [0, 1] for each side.
        """
        bend = trunk.bend.copy()
        for _ in range(self.assist_steps):
            current = Trunk(trunk.pelvis, trunk.heading, bend, trunk.head)
            world = self.trunk(current)
            base = facing(trunk.heading)
            for side, (target, weight) in targets.items():
                shoulder = self.shoulder(world, trunk.pelvis, side)
                way = target.position - shoulder
                excess = np.linalg.norm(way, axis=1) - self.arm_reach * self.arms[side]
                excess = weight * 0.5 * (excess + np.sqrt(excess**2 + 0.01**2))
                lever = shoulder - trunk.pelvis
                axis = np.cross(lever, unit(way)) / (lever**2).sum(1, keepdims=True)
                change = np.einsum("nji,nj->ni", base, axis * excess[:, None])
                bend = bend + 0.9 * change
        return Trunk(trunk.pelvis, trunk.heading, bend, trunk.head)

    def arm_to(
        self,
        world: np.ndarray,
        pelvis: np.ndarray,
        side: int,
        wrist: PoseTrack,
        raised: np.ndarray | float = 0.0,
    ) -> None:
        """Set one arm for a wrist pose, in place; ``raised`` (N,) lifts the elbow outward."""
        name, sign = SIDES[side], (1.0, -1.0)[side]
        shoulder = self.shoulder(world, pelvis, side)
        chest = world[:, _J["spine3"]]
        raised = np.broadcast_to(raised, len(pelvis))[:, None]
        # the elbow points back under a hanging arm, down and out before the chest
        ahead = np.einsum("ni,ni->n", wrist.position - shoulder, chest[..., 2]) / self.arm
        ahead = ramp(ahead, 0.0, 0.55)[:, None]
        pole = -0.75 * (1 - ahead) * chest[..., 2] + sign * (0.45 + raised) * chest[..., 0]
        pole = pole - (0.5 + 0.4 * ahead) * chest[..., 1]
        hand = self.hands[side]
        hinge = np.array([0.0, -sign, 0])
        names = (f"{name}_shoulder", f"{name}_elbow", f"{name}_wrist")
        upper, lower = self.skeleton.limb(
            names, shoulder, wrist.position, pole, hinge, self.leg_reach
        )
        forearm = unit(self.skeleton.bone(names[1], names[2]))
        roll = twist_angle(np.swapaxes(lower, -1, -2) @ wrist.rotation, forearm)
        lower = lower @ rotation_exp(self.forearm_twist * roll[:, None] * forearm)
        world[:, _J[names[0]]], world[:, _J[names[1]]] = upper, lower
        world[:, _J[names[2]]] = wrist.rotation
        world[:, hand.first : hand.first + 15] = wrist.rotation[:, None]

    def swing_arm(
        self,
        world: np.ndarray,
        pelvis: np.ndarray,
        side: int,
        swing: np.ndarray,
        *offsets: np.ndarray,
    ) -> None:
        """Set a hanging arm with relaxed fingers, in place.

        Args:
            swing: (N,) metres forward.
            offsets: (N, 3) of the wrist, metres.
        """
        wrist = self.idle_wrist(world, pelvis, side, swing)
        position = sum(offsets, wrist.position)
        self.arm_to(world, pelvis, side, PoseTrack(position, wrist.rotation))
        self.fingers(world, side, self.finger_track(side, []))

    def fingers(self, world: np.ndarray, side: int, vectors: np.ndarray) -> None:
        """Set the fingers' rotation vectors (N, 15, 3) relative to their parents, in place."""
        hand = self.hands[side]
        local = rotation_exp(vectors)
        for joint in range(15):
            parent = hand.wrist if joint % 3 == 0 else hand.first + joint - 1
            world[:, hand.first + joint] = world[:, parent] @ local[:, joint]

    def finger_track(self, side: int, keys: list[tuple[np.ndarray, HandShape]]) -> np.ndarray:
        """Rotation vectors (N, 15, 3): from relaxed to each shape in turn by its share (N,)."""
        hand = self.hands[side]
        vectors = hand.local(RELAXED)[None]
        for share, goal in keys:
            s = share[:, None, None]
            vectors = (1 - s) * vectors + s * hand.local(goal)[None]
        return vectors

    def skin(self, world: np.ndarray, pelvis: np.ndarray) -> PosedSubject:
        """The subject posed: world rotations (N, 55, 3, 3), pelvis (N, 3)."""
        return self.subject.skin(local_rotations(world), pelvis - self.subject.rest_joints[0])


class Foot:
    """One foot of a puppet; places (5,) are ankle x, y, z, pitch, heading."""

    def __init__(self, puppet: Puppet, side: int) -> None:
        self.side, self.subject = side, puppet.subject
        self.ankle, self.toes = (JOINT_INDEX[f"{SIDES[side]}_{j}"] for j in ("ankle", "foot"))
        share = np.asarray(self.subject.weights[:, [self.ankle, self.toes]].sum(1)).ravel()
        self._part = part_of(self.subject, np.flatnonzero(share > 0.5))

    def skin(self, places: np.ndarray) -> np.ndarray:
        """Clothed skin (N, n, 3) of the foot at places (N, 5)."""
        foot = foot_rotations(places[:, [4, 4]], places[:, [3, 3]])[:, self.side]
        local = np.broadcast_to(np.eye(3), (len(places), 55, 3, 3)).copy()
        local[:, self.ankle] = foot[:, 0]
        local[:, self.toes] = np.swapaxes(foot[:, 0], 1, 2) @ foot[:, 1]
        posed = self._part.skin(local, np.zeros((len(places), 3))).clothed
        return posed - self.subject.rest_joints[self.ankle] + places[:, None, :3]

    def backed_off(
        self,
        place: np.ndarray,
        way: np.ndarray,
        gap: float,
        distance: Callable[[np.ndarray], float],
    ) -> np.ndarray:
        """Move a foot until it has a gap to an object.

        Args:
            place: (5,) first place.
            way: (5,) largest change of the place.
            gap: wanted result of ``distance``, metres.
            distance: function of the skin (n, 3) that returns its least signed distance.

        Returns:
            (5,) place.
        """

        def is_too_near(share: float) -> bool:
            return distance(self.skin((place + share * way)[None])[0]) < gap

        return place + bisect(0.0, 1.0, 18, is_too_near)[1] * way


def moved(place: np.ndarray, x: float, y: float, z: float, pitch: float = 0.0) -> np.ndarray:
    """A place (5,) moved by metres and pitched by rad."""
    return place + np.array([x, y, z, pitch, 0.0])


def still(place: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """The path of a foot that stays at a place (5,)."""
    return lambda times: np.broadcast_to(place, (len(times), 5))
