"""Take a long object that lies on a block by its handle, swing it, lay it down again.

Conventions of numbers, columns and frames: :mod:`.base`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import ConvexHull

from intercap_core.geometry.camera.transforms import invert, rigid
from intercap_core.studio.controls import PoseTrack, Step, plateau
from intercap_core.studio.interactions.grasps import Approach, wrapped
from intercap_core.studio.interactions.handling import HandlingScript
from intercap_core.studio.motion import RIGHT, Trunk
from intercap_core.studio.skeleton import unit


@dataclass(frozen=True)
class Key:
    """Goal of the swinging hand."""

    wrist: tuple[float, float, float]
    """From the shoulder's rest place, in arm lengths ahead, to the left and up."""
    fingers: tuple[float, float, float]
    """Direction of the fingers."""
    thumb: tuple[float, float, float]
    """Direction of the thumb."""
    start: float
    """Start of the motion to this goal, script time."""
    end: float
    """Its end."""


class Swinging(HandlingScript):
    """The handle overhangs the block's right edge; the far end points to the left."""

    highlight = 1.65
    centre = (0.25, 0.0)
    handle_m = 0.0  # the middle of the hand along the object's z axis, from its origin
    far_end = 1.0  # where the far end is along z, +1 or -1
    side_up = 1.0  # which side of the object is up while it lies, along y
    clear_m, back_m = 0.045, 0.075  # the thumb is behind the handle
    keys: tuple[Key, ...] = ()
    turn_back_rad, turn_through_rad = 0.0, 0.0  # of the chest, to the right and to the left
    # times of these turns as :func:`plateau` takes them, script time
    back_s, through_s = (1.0, 1.35, 1.4, 1.7), (1.45, 1.75, 1.9, 2.3)
    attach_s = 0.96  # grasp, script time
    release_s = 2.56  # release, script time
    # leaning to the block, to pick up and to lay down: times as :func:`plateau` takes them
    lean_s = ((0.35, 0.9, 1.0, 1.4), (2.05, 2.5, 2.6, 3.0))
    right_steps_s = ((1.04, 1.38), (1.98, 2.34))  # of the right foot, back and to the block again
    # start and end of the way to above the block, and start of laying down, script time
    lower_s = (2.0, 2.44, 2.32)
    block_share = 0.49  # height of the block's top, share of the person's height
    block_half_m = 0.23  # half the block's size across the person's way, metres
    overhang_m = 0.085  # from the middle of the hand to the block's edge, metres

    def plan(self) -> None:
        rng, puppet = self.rng, self.puppet
        self.top = self.block_share * puppet.subject.height_m + rng.uniform(-0.03, 0.03)
        edge = -0.14 + self.overhang_m
        half = (self.plinth_half_m, self.block_half_m)
        self.table((0.40 + half[0], edge + half[1]), half, self.top)
        self.pick_pose = self._lying(0.50 + rng.uniform(-0.015, 0.015), rng.normal(0, 0.06))
        self.place_pose = self._lying(0.52 + rng.uniform(-0.015, 0.02), rng.normal(0, 0.10))
        w = puppet.hip_width * 1.1
        steps = [
            Step(RIGHT, 0.02, 0.40, (0.02, -w)),
            Step(1 - RIGHT, 0.34, 0.72, (0.04, w)),
            Step(RIGHT, *self.right_steps_s[0], (-0.20, -w - 0.05), -0.5),
            Step(RIGHT, *self.right_steps_s[1], (0.03, -w)),
        ]
        self.walk(np.array([[-0.24, w], [-0.22, -w]]), steps)
        self.size = rng.uniform(0.9, 1.1, 3)
        self.grips[RIGHT] = wrapped(puppet, self.prop.surface, self.pick_pose, self._approaches())
        self.hold_s[RIGHT] = (self.attach_s, self.release_s)

    def _lying(self, ahead: float, yaw: float) -> np.ndarray:
        """The object (4, 4) on the block: it rests on the two points on either side of its centre
        of mass, its handle's middle ``ahead`` of the person."""
        along = self.far_end * self.prop.vertices[:, 2]
        height = self.side_up * self.prop.vertices[:, 1]
        on_block = along > self.far_end * self.handle_m + self.overhang_m
        outline = np.stack([along, height], 1)[on_block]
        hull = ConvexHull(outline)
        ends = outline[hull.simplices]  # (E, 2, 2)
        below = (ends[:, :, 0].min(1) < 0) & (ends[:, :, 0].max(1) > 0)
        below &= hull.equations[:, 1] < 0
        near, beyond = sorted(ends[below][0].tolist())
        slope = np.arctan2(beyond[1] - near[1], beyond[0] - near[0])
        far = np.array([-np.sin(yaw) * np.cos(slope), np.cos(yaw) * np.cos(slope), -np.sin(slope)])
        z = self.far_end * far
        y = self.side_up * unit(np.array([0, 0, 1.0]) - far[2] * far)
        rotation = np.stack([np.cross(y, z), y, z], 1)
        place = np.array([ahead, -0.14, 0.0]) - rotation @ np.array([0, 0, self.handle_m])
        turned = self.prop.vertices[on_block] @ rotation.T
        place[2] = self.top - turned[:, 2].min()
        return rigid(rotation, place)

    def _approaches(self) -> Iterator[Approach]:
        """The palm from above and behind, fingers across the handle."""
        across = self.far_end * self.pick_pose[:3, 2]
        ahead = np.array([across[1], -across[0], 0.0])
        for shift, along in product((0.0, 0.012, -0.012), (0.034, 0.026, 0.042)):
            at = self.pick_pose[:3, 3] + (self.far_end * self.handle_m + shift) * across
            yield Approach(at, 0.92 * ahead + (0, 0, -0.40), -0.40 * ahead + (0, 0, -0.92), along)

    def trunk(self, times: np.ndarray) -> Trunk:
        """Lean to the block, turn back and through with the swing, lean again."""
        reach = plateau(times, *self.lean_s[0]) + plateau(times, *self.lean_s[1])
        trunk = self.leaning(times, reach, 0.30 * reach)
        back, through = plateau(times, *self.back_s), plateau(times, *self.through_s)
        swing = self.turn_through_rad * through - self.turn_back_rad * back
        trunk.bend[:, 0] += 0.5 * reach
        trunk.bend[:, 1] += swing
        trunk.head[:, 1] += 0.35 * swing - 0.15 * reach
        return trunk

    def path(self, world: np.ndarray, pelvis: np.ndarray, times: np.ndarray) -> PoseTrack:
        """Poses of the object that follow from the hand's way through the keys.

        Keys are relative to where the right shoulder of a standing person is at rest.
        """
        puppet = self.puppet
        grip = self.grips[RIGHT].object_from_wrist
        rest = puppet.subject.rest_joints
        # Joint 17 is the right shoulder, 0 the pelvis; the rest pose has x to the left and y up.
        shoulder = np.array([0.0, rest[17, 0], rest[17, 1] - rest[0, 1]])
        shoulder = pelvis * (1, 1, 0) + (0, 0, puppet.stand) + shoulder
        wrist = PoseTrack.of(self.pick_pose @ grip)
        for key in self.keys:
            fingers, thumb = unit(np.array(key.fingers)), unit(np.array(key.thumb))
            thumb = unit(thumb - fingers * (fingers @ thumb))
            rotation = puppet.wrist_rotation(RIGHT, fingers, np.cross(thumb, fingers))
            goal = PoseTrack(shoulder + puppet.arm * self.size * key.wrist, rotation)
            wrist = wrist.through(times, (goal, key.start, key.end))
        last = PoseTrack.of(self.place_pose @ self.object_from_wrist(RIGHT, times))
        above = PoseTrack(last.position + np.array([0.0, -0.02, 0.10]), last.rotation)
        start, over, lower = self.lower_s
        wrist = wrist.through(times, (above, start, over), (last, lower, self.release_s - 0.03))
        wrist_from_object = invert(self.object_from_wrist(RIGHT, times))
        offset = np.einsum("nij,nj->ni", wrist.rotation, wrist_from_object[:, :3, 3])
        return PoseTrack(wrist.position + offset, wrist.rotation @ wrist_from_object[:, :3, :3])

    def raised(self, times: np.ndarray, side: int) -> np.ndarray:
        """The elbow is a little away from the body in the swing."""
        return (0.0, 0.3)[side] * plateau(times, 1.0, 1.3, 1.9, 2.3)
