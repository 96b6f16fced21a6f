"""SMPL-X's 55 joints: names and parents, in the order of all pose and joint arrays."""

from __future__ import annotations

JOINT_NAMES: tuple[str, ...] = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2",
    "left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar",
    "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
    "left_wrist", "right_wrist", "jaw", "left_eye_smplhf", "right_eye_smplhf",
    *(f"{side}_{finger}{i}" for side in ("left", "right")
      for finger in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3)),
)  # fmt: skip

# Parent of each joint (SMPL-X), -1 = root.
PARENTS: tuple[int, ...] = (
    -1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15,
    20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38,
    21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53,
)  # fmt: skip

NUM_JOINTS = len(JOINT_NAMES)
JOINT_INDEX: dict[str, int] = {name: i for i, name in enumerate(JOINT_NAMES)}
FIRST_FINGER = JOINT_INDEX["left_index1"]
"""The joints from here on are those of the fingers, three of each."""
BODY_JOINTS = slice(JOINT_INDEX["pelvis"], JOINT_INDEX["jaw"])
"""The 22 joints of trunk and limbs, wrists included."""
BOTH_HANDS = slice(FIRST_FINGER, NUM_JOINTS)
FINGER_JOINTS = (
    slice(FIRST_FINGER, JOINT_INDEX["right_index1"]),
    slice(JOINT_INDEX["right_index1"], NUM_JOINTS),
)
"""Joints of the left and of the right hand, without the wrists."""
FOOT_JOINTS = [
    JOINT_INDEX[f"{side}_{name}"] for side in ("left", "right") for name in ("ankle", "foot")
]
"""Ankle and ball of either foot."""


def ancestors(joint: int) -> tuple[int, ...]:
    """Return the joint and its ancestors, root first."""
    chain = [joint]
    while PARENTS[chain[-1]] >= 0:
        chain.append(PARENTS[chain[-1]])
    return tuple(reversed(chain))
