"""The 135 keypoints of detectors, as constant linear combinations of vertices and joints.

Order: OpenPose body 25, left hand 21, right hand 21, face 51 (dlib 17 to 67), jaw line 17 (dlib 0
to 16, of a head seen from the front).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from intercap_core.body.joints import JOINT_INDEX

if TYPE_CHECKING:
    from intercap_core.body.loading import BodyArrays

# (keypoint, joint name or "@" + name of a mesh point)
_BODY: tuple[tuple[str, str], ...] = (
    ("nose", "@nose"), ("neck", "neck"),
    ("right_shoulder", "right_shoulder"), ("right_elbow", "right_elbow"),
    ("right_wrist", "right_wrist"), ("left_shoulder", "left_shoulder"),
    ("left_elbow", "left_elbow"), ("left_wrist", "left_wrist"), ("mid_hip", "pelvis"),
    ("right_hip", "right_hip"), ("right_knee", "right_knee"), ("right_ankle", "right_ankle"),
    ("left_hip", "left_hip"), ("left_knee", "left_knee"), ("left_ankle", "left_ankle"),
    ("right_eye", "@right_eye"), ("left_eye", "@left_eye"), ("right_ear", "@right_ear"),
    ("left_ear", "@left_ear"), ("left_big_toe", "@left_big_toe"),
    ("left_small_toe", "@left_small_toe"), ("left_heel", "@left_heel"),
    ("right_big_toe", "@right_big_toe"), ("right_small_toe", "@right_small_toe"),
    ("right_heel", "@right_heel"),
)  # fmt: skip
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")


def _hand(side: str) -> list[tuple[str, str]]:
    """Return the 21 keypoints of a hand, in the form of `_BODY`."""
    rows = [(f"{side}_hand_wrist", f"{side}_wrist")]
    for finger in _FINGERS:
        rows += [(f"{side}_{finger}{i}", f"{side}_{finger}{i}") for i in (1, 2, 3)]
        rows.append((f"{side}_{finger}_tip", f"@{side}_{finger}"))
    return rows


_POINTS = (*_BODY, *_hand("left"), *_hand("right"))
_GROUPS = (
    [name for name, _ in _BODY],
    [name for name, _ in _hand("left")],
    [name for name, _ in _hand("right")],
    [f"face_{i}" for i in range(17, 68)],
    [f"face_{i}" for i in range(17)],
)
KEYPOINT_NAMES: tuple[str, ...] = tuple(name for group in _GROUPS for name in group)
NUM_KEYPOINTS = len(KEYPOINT_NAMES)
KEYPOINT_INDEX = {name: index for index, name in enumerate(KEYPOINT_NAMES)}
BODY, LEFT_HAND, RIGHT_HAND, FACE, CONTOUR = (
    slice(KEYPOINT_INDEX[group[0]], KEYPOINT_INDEX[group[-1]] + 1) for group in _GROUPS
)


def _partner(name: str) -> str:
    for side, other in (("left_", "right_"), ("right_", "left_")):
        if name.startswith(side):
            return other + name.removeprefix(side)
    return name


# (135,) index of the same keypoint of the other side. A keypoint without sides is its own partner,
# and so are those of the face, which detectors recognise as a whole.
PARTNER = np.array([KEYPOINT_INDEX[_partner(name)] for name in KEYPOINT_INDEX])

# Bones between body keypoints by name: of an arm, leg and foot of one side; of both sides at once.
ARM_BONES = (("shoulder", "elbow"), ("elbow", "wrist"))
LEG_BONES = (("hip", "knee"), ("knee", "ankle"))
FOOT_BONES = (("ankle", "big_toe"), ("ankle", "heel"))
LIMB_BONES = (*ARM_BONES, *LEG_BONES, *FOOT_BONES)


def of_side(side: str, bones: Iterable[tuple[str, str]]) -> tuple[tuple[str, str], ...]:
    """Add a side, "left" or "right", to the names of bones."""
    return tuple((f"{side}_{first}", f"{side}_{second}") for first, second in bones)


# The tree that OpenPose draws, without eyes and ears: trunk, arms, legs and nose; then the feet.
SKELETON: tuple[tuple[str, str], ...] = (
    ("neck", "mid_hip"),
    *(("neck", "right_shoulder"), *of_side("right", ARM_BONES)),
    *(("neck", "left_shoulder"), *of_side("left", ARM_BONES)),
    *(("mid_hip", "right_hip"), *of_side("right", LEG_BONES)),
    *(("mid_hip", "left_hip"), *of_side("left", LEG_BONES)),
    ("neck", "nose"),
)
FEET = (*of_side("right", FOOT_BONES), *of_side("left", FOOT_BONES))


def keypoint_pairs(bones: Iterable[tuple[str, str]]) -> np.ndarray:
    """Return the indices (B, 2) of both ends of bones among the 135 keypoints."""
    ends = [[KEYPOINT_NAMES.index(first), KEYPOINT_NAMES.index(second)] for first, second in bones]
    return np.array(ends, int).reshape(-1, 2)


@dataclass(frozen=True)
class KeypointMap:
    """Keypoint i is joint ``joint[i]``, or if that is -1, sum_k weights[i,k] vertex ids[i,k]."""

    joint: np.ndarray
    """(135,) joint, or -1."""
    ids: np.ndarray
    """(135, 3) vertex ids."""
    weights: np.ndarray
    """(135, 3), zero in the rows of joints."""
    vertex_ids: np.ndarray
    """(N,) all ids used, ascending."""
    matrix: np.ndarray
    """(135, N + 55) maps these vertices followed by the 55 joints to the keypoints."""

    @classmethod
    def of(cls, points: dict[str, int], file: BodyArrays) -> KeypointMap:
        """Build the map from named vertices and the file's landmarks and frontal jaw line."""
        joint = np.full(NUM_KEYPOINTS, -1)
        ids = np.zeros((NUM_KEYPOINTS, 3), int)
        weights = np.zeros((NUM_KEYPOINTS, 3))
        for row, (_, source) in enumerate(_POINTS):
            if source.startswith("@"):
                ids[row] = points[source[1:]]
                weights[row, 0] = 1
            else:
                joint[row] = JOINT_INDEX[source]
        ids[FACE], weights[FACE] = file.faces[file.landmark_faces], file.landmark_barycentric
        ids[CONTOUR] = file.faces[file.contour_faces[0]]
        weights[CONTOUR] = file.contour_barycentric[0]
        vertex_rows = np.flatnonzero(joint < 0)
        vertex_ids = np.unique(ids[vertex_rows])
        matrix = np.zeros((NUM_KEYPOINTS, len(vertex_ids) + 55))
        place = np.searchsorted(vertex_ids, ids[vertex_rows])
        np.add.at(matrix, (vertex_rows[:, None], place), weights[vertex_rows])
        joint_rows = np.flatnonzero(joint >= 0)
        matrix[joint_rows, len(vertex_ids) + joint[joint_rows]] = 1
        return cls(joint, ids, weights, vertex_ids, matrix)
