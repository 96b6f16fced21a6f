"""Step up to a plinth, take a vessel around its wall, drink, put it back.

Conventions of numbers, columns and frames: :mod:`.base`.
"""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.geometry.camera.transforms import rigid, rotation_exp
from intercap_core.studio.controls import PoseTrack, bisect, plateau, ramp
from intercap_core.studio.hands import OPEN, RELAXED, HandShape, part_of
from intercap_core.studio.interactions.base import shifted
from intercap_core.studio.interactions.grasps import backed_off
from intercap_core.studio.interactions.handling import HandlingScript
from intercap_core.studio.motion import LEFT, RIGHT, Trunk


class Drinking(HandlingScript):
    """The vessel's x axis points to the person's left; the right hand holds the wall."""

    highlight = 1.75
    centre = (0.18, -0.05)
    tilt_deg = (42.0, 52.0)  # how far the vessel leans at the lips
    head_back = 0.22  # rad
    lips_at_edge = True  # the lips touch the rim's near edge, else the middle of the mouth
    attach_s = 1.06  # grasp, script time
    release_s = 2.50  # release, script time
    plinth_share = 0.565  # height of the plinth's top, share of the person's height
    aside_m = -0.12  # the plinth, metres to the left
    lip_gap_m = 0.0008  # between the vessel and the lips, metres
    hover_m = (0.007, 0.018)  # range of the gap between the other hand and the vessel, metres

    def plan(self) -> None:
        rng = self.rng
        self.set_out(self.plinth_share, self.aside_m)
        self.tilt = np.radians(rng.uniform(*self.tilt_deg))
        self.hover = rng.uniform(*self.hover_m)
        self.grasp()
        self._drinking_place()
        self._hovering_place()

    def _drinking_place(self) -> None:
        """Plan head_from_prop (4, 4), which puts the rim of the tilted vessel at the lips.

        The head's frame has the axes of the rest pose and its origin at the head joint.
        """
        subject = self.puppet.subject
        head = JOINT_INDEX["head"]
        share = np.asarray(subject.weights[:, [head, JOINT_INDEX["jaw"]]].sum(1)).ravel()
        eyes = subject.rest_joints[JOINT_INDEX["left_eye_smplhf"], 1]
        ids = np.flatnonzero((share > 0.9) & (subject.rest[:, 1] < eyes))
        face = part_of(subject, ids).rest - subject.rest_joints[head]
        middle = np.abs(face[:, 0]) < 0.012
        corner = self.mouth - subject.rest_joints[head]
        front = face[middle & (np.abs(face[:, 1] - corner[1]) < 0.01), 2].max()
        # the vessel's axis leans towards the face; its near rim is at the lips
        up = np.array([0.0, np.cos(self.tilt), -np.sin(self.tilt)])
        side = np.array([1.0, 0, 0])
        rotation = np.stack([side, np.cross(up, side), up], 1)
        rim_up = self.prop.vertices[:, 2].max()
        near_rim = rotation @ np.array([0.0, 0, rim_up])
        if self.lips_at_edge:
            rim = self.prop.vertices[self.prop.vertices[:, 2] > rim_up - 0.003]
            across = np.cross(side, up)
            across *= -np.sign(across[2])
            near_rim = near_rim + np.linalg.norm(rim[:, :2], axis=1).max() * across
        mouth = np.array([0.0, corner[1] - 0.003, front])

        def is_too_near(ahead: float) -> bool:
            centre = mouth + np.array([0, 0, ahead]) - near_rim
            distance = self.prop.surface.signed_distance((face - centre) @ rotation).min()
            return bool(distance < self.lip_gap_m)

        _, high = bisect(-0.03, 0.05, 18, is_too_near)
        self.head_from_prop = rigid(rotation, mouth + np.array([0, 0, high]) - near_rim)

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
        """Plan the left hand: flat, ``hover`` metres from the vessel, as if to steady it."""
        hand = self.puppet.hands[LEFT]
        fingers = np.array([0.80, -0.45, -0.20])
        palm = np.array([-0.45, -0.85, 0.0])
        rotation = self.puppet.wrist_rotation(LEFT, fingers / np.linalg.norm(fingers), palm)
        skin = hand.skin(hand.local(OPEN)[None])[0] @ rotation.T
        place = self.pick_pose[:3, 3] - skin[hand.palm_ids].mean(0) - 0.03 * fingers
        place[2] = self.pick_pose[2, 3] + 0.03 - skin[:, 2].mean()
        self.left_place = backed_off(hand, OPEN, self.prop.surface, self.pick_pose,
                                     rigid(rotation, place), -palm, self.hover)  # fmt: skip

    def trunk(self, times: np.ndarray) -> Trunk:
        """Lean to the plinth, straighten up and put the head back to drink, lean again."""
        reach = plateau(times, 0.4, 1.0, 1.1, 1.6) + plateau(times, 2.0, 2.45, 2.55, 3.0)
        drink = plateau(times, 1.25, 1.7, 2.05, 2.4)
        trunk = self.leaning(times, reach, 0.28 * reach - self.head_back * drink)
        trunk.bend[:, 0] -= 0.03 * drink
        trunk.bend[:, 1] += 0.10 * reach
        trunk.head[:, 1] -= 0.12 * reach
        return trunk

    def path(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> PoseTrack:
        """From the plinth to the lips, tilted there, and back."""
        place = self.puppet.joint(world, pelvis, "head")
        head = rigid(world[:, JOINT_INDEX["head"]], place)
        at_lips = head @ self.head_from_prop
        # before and after the drink it is upright, a little lower and ahead of the lips
        upright_share = 1 - plateau(times, 1.45, 1.80, 2.00, 2.30)
        ease = np.zeros((len(times), 3))
        ease[:, 0] = upright_share * self.tilt * 0.85
        away = head[:, :3, :3] @ np.array([0.0, -0.035, 0.055])
        position = at_lips[:, :3, 3] + upright_share[:, None] * away
        drinking = PoseTrack(position, at_lips[:, :3, :3] @ rotation_exp(ease))
        lift = np.array([0.0, 0, 0.05])
        return PoseTrack.of(self.pick_pose).through(
            times,
            (drinking, self.attach_s, 1.72, lift),
            (self.place_pose, 2.02, self.release_s - 0.03, lift),
        )

    def wrist(
        self, side: int, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray, prop: np.ndarray
    ) -> PoseTrack:
        """The right hand handles the vessel; the left only comes near."""
        wrist = super().wrist(side, world, pelvis, times, prop)
        if side == RIGHT:
            return wrist
        near, away = self.left_place, shifted(self.left_place, (-0.10, 0.10, 0.10))
        return wrist.through(
            times, (away, 0.2, 0.75), (near, 0.65, 0.95), (away, 1.02, 1.3), (wrist, 1.2, 1.8)
        )

    def finger_keys(self, side: int, times: np.ndarray) -> list[tuple[np.ndarray, HandShape]]:
        """The left hand opens while it hovers."""
        if side == LEFT:
            return [(ramp(times, 0.3, 0.7), OPEN), (ramp(times, 1.2, 1.6), RELAXED)]
        return super().finger_keys(side, times)

    def needs(self, times: np.ndarray) -> dict[int, np.ndarray]:
        """The trunk helps both hands at the plinth, none at the mouth."""
        at_plinth = plateau(times, 0.4, 0.85, 1.1, 1.5) + plateau(times, 2.1, 2.4, 2.7, 3.0)
        return {RIGHT: at_plinth, LEFT: plateau(times, 0.4, 0.85, 1.02, 1.4)}

    def raised(self, times: np.ndarray, side: int) -> np.ndarray:
        """The elbow is lifted a little to drink."""
        return (0.0, 0.1)[side] * plateau(times, 1.2, 1.7, 2.0, 2.4)
