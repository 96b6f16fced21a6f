"""The puppet's skeleton: forward kinematics and closed-form inverse kinematics of the limbs.

"Stage" is any frame with z up and the floor at z = 0, metres, such as that of a script. A joint's
rotation ``stage_from_rest`` (3, 3) turns the axes of the T-pose (x to the person's left, y up, z
ahead) to the stage. All functions take N moments at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import JOINT_INDEX, PARENTS
from intercap_core.geometry.camera.transforms import rotation_exp, rotation_log

# Shares of a limb's length. A limb reaches targets up to the first share exactly. Beyond it, the
# limb stretches less and less, at most to the second share: knees and elbows that become straight
# would snap.
REACH_FREE = 0.972
REACH_MOST = 0.994


def unit(v: np.ndarray) -> np.ndarray:
    """(..., 3) scaled to length one."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def about_z(angle: float) -> np.ndarray:
    """Rotation (3, 3) by ``angle`` rad about the vertical."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def blend(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Rotations (N, 3, 3) from ``a`` to ``b`` along the shortest way, ``share`` (N,) of it."""
    way = rotation_log(np.swapaxes(a, -1, -2) @ b)
    return a @ rotation_exp(way * share[..., None])


def frame(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3) by Gram-Schmidt: columns are ``first``, ``second`` made orthogonal to
    it, and their cross product, all of unit length."""
    x = unit(first)
    y = unit(second - x * (x * second).sum(-1, keepdims=True))
    return np.stack([x, y, np.cross(x, y)], -1)


def carry(
    from_first: np.ndarray, from_second: np.ndarray, to_first: np.ndarray, to_second: np.ndarray
) -> np.ndarray:
    """Rotations that take one pair of directions to another (the second as far as possible)."""
    return frame(to_first, to_second) @ np.swapaxes(frame(from_first, from_second), -1, -2)


@dataclass(frozen=True)
class PuppetSkeleton:
    """Rest joints (55, 3) of one person in the T-pose, metres."""

    rest: np.ndarray

    def bone(self, parent: str, child: str) -> np.ndarray:
        """Vector (3,) from one joint to another in the T-pose."""
        return self.rest[JOINT_INDEX[child]] - self.rest[JOINT_INDEX[parent]]

    def length(self, *names: str) -> float:
        """Summed length of the bones along a chain of joints."""
        return float(sum(np.linalg.norm(self.bone(a, b)) for a, b in pairwise(names)))

    def forward(self, rotations: np.ndarray, pelvis: np.ndarray) -> np.ndarray:
        """Joints (N, 55, 3) of rotations (N, 55, 3, 3) and pelvis positions (N, 3)."""
        joints = np.empty((len(pelvis), 55, 3))
        joints[:, 0] = pelvis
        for joint in range(1, 55):
            parent = PARENTS[joint]
            bone = self.rest[joint] - self.rest[parent]
            joints[:, joint] = joints[:, parent] + rotations[:, parent] @ bone
        return joints

    def limb(
        self,
        names: tuple[str, str, str],
        root: np.ndarray,
        target: np.ndarray,
        pole: np.ndarray,
        rest_hinge: np.ndarray,
        free: float = REACH_FREE,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Two bones from ``root`` to ``target``, both (N, 3), bent towards ``pole`` (N, 3).

        The law of cosines gives the angle at the root. ``rest_hinge`` (3,) is the axis about which
        the middle joint bends in the T-pose. Returns the rotations (N, 3, 3) of the upper and the
        lower bone. A target farther than ``free`` of the limb's length is not quite reached
        (``REACH_MOST``).
        """
        upper, lower = self.bone(names[0], names[1]), self.bone(names[1], names[2])
        a, b = np.linalg.norm(upper), np.linalg.norm(lower)
        way = target - root
        wanted = np.linalg.norm(way, axis=1) / (a + b)
        spare = REACH_MOST - free
        beyond = np.maximum(wanted - free, 0)
        wanted = np.minimum(wanted, free) + spare * -np.expm1(-beyond / spare)
        distance = np.maximum(wanted, abs(a - b) / (a + b) * 1.02) * (a + b)
        along = unit(way)
        out = unit(pole - along * (along * pole).sum(1, keepdims=True))
        cosine = (a * a + distance**2 - b * b) / (2 * a * distance)
        sine = np.sqrt(np.maximum(1 - cosine**2, 0))
        first = along * cosine[:, None] + out * sine[:, None]
        second = unit(along * distance[:, None] - first * a)
        # the joint bends about this axis: from the upper bone's direction to the lower one's
        hinge = np.cross(out, along)
        return (carry(upper, rest_hinge, first, hinge), carry(lower, rest_hinge, second, hinge))


def twist_angle(rotation: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Angle (N,) of the part of ``rotation`` (N, 3, 3) about unit ``axis`` (3,)."""
    quaternion = Rotation.from_matrix(rotation).as_quat(canonical=True)
    angle = 2 * np.arctan2(quaternion[:, :3] @ axis, quaternion[:, 3])
    return (angle + np.pi) % (2 * np.pi) - np.pi


def local_rotations(world: np.ndarray) -> np.ndarray:
    """Rotations (N, 55, 3, 3) relative to each joint's parent; the pelvis keeps its own."""
    local = world.copy()
    for joint in range(1, 55):
        local[:, joint] = np.swapaxes(world[:, PARENTS[joint]], -1, -2) @ world[:, joint]
    return local
