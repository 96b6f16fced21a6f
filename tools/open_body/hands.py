"""Mean pose and pose components of the hands from a set of grasps with anatomical ranges.

The grasps are named after Feix et al. 2016, "The GRASP Taxonomy of Human Grasp Types"; joint
ranges are those of the AAOS tables (MCP 0-90, PIP 0-100, DIP 0-70, abduction +-20 degrees; thumb
MCP 0-50, IP 0-80, palmar abduction 0-70). The base of the thumb flexes about an axis that stays
with the trapezium and abducts about one that goes with the metacarpal (Hollister et al. 1992, "The
axes of rotation of the thumb carpometacarpal joint"); it flexes and extends through 53 degrees
(Cooney et al. 1981, "The kinesiology of the thumb trapeziometacarpal joint") and ten more. The
pronation of opposition, which the joints of the thumb share in life, is all the base's.
"""

from __future__ import annotations

import numpy as np

FINGERS = ("index", "middle", "pinky", "ring", "thumb")
_FIRST = {"left": 25, "right": 40}

# degrees: MCP, PIP, DIP flexion of index, middle, ring, pinky; their abduction (away from the
# middle finger); thumb: palmar abduction, flexion and pronation of the base, flexion of MCP, of IP.
# In the T-pose the phalanges of the thumb are 30 degrees out of the palm's plane already, and its
# base 43. Thumbs that touch or face fingers, and index and middle of pinch and tripod, were found
# by a search for contact of the pads without penetration on the mean body's skin.
GRASPS: dict[str, tuple[tuple[float, ...], ...]] = {
    "flat": ((0, 0, 0),) * 4 + ((4, 0, 4, 8), (-20, 0, 0, 0, 0)),
    "spread": ((-8, 2, 0),) * 4 + ((16, 0, 14, 20), (-10, -12, -5, -5, -5)),
    "relaxed": ((18, 25, 12), (22, 30, 14), (26, 32, 15), (30, 32, 15), (3, 0, 2, 5),
                (-6, 8, 8, 10, 14)),
    "curled": ((40, 50, 25), (44, 55, 28), (48, 55, 28), (52, 52, 26), (2, 0, 2, 4),
               (2, 12, 14, 14, 22)),
    "fist": ((78, 95, 55), (82, 98, 58), (84, 98, 58), (84, 94, 55), (0, 0, 0, 0),
             (-3, 44, 34, 17, 34)),
    "hook": ((15, 85, 50), (15, 88, 52), (18, 88, 52), (22, 84, 50), (0, 0, 0, 2),
             (-12, 6, 4, 8, 12)),
    "large_diameter": ((28, 35, 20), (32, 38, 22), (36, 40, 24), (42, 40, 24), (8, 0, 6, 10),
                       (34, 12, 32, 2, 5)),
    "medium_wrap": ((48, 55, 30), (54, 60, 34), (60, 62, 34), (64, 60, 32), (3, 0, 2, 5),
                    (34, 9, 32, 8, 13)),
    "small_diameter": ((65, 78, 42), (70, 84, 46), (74, 84, 46), (78, 80, 44), (0, 0, 0, 2),
                       (14, 10, 29, 17, 55)),
    "sphere": ((30, 40, 25), (32, 42, 26), (34, 42, 26), (36, 40, 25), (14, 0, 12, 18),
               (34, 22, 32, 4, 2)),
    "disk": ((5, 45, 28), (6, 46, 28), (8, 46, 28), (10, 44, 26), (15, 0, 12, 18),
             (34, 22, 30, 5, 5)),
    "pinch": ((53, 47, 23), (30, 35, 18), (26, 30, 15), (24, 26, 12), (2, 0, 2, 4),
              (5, 15, 16, 13, 2)),
    "tripod": ((62, 39, 17), (62, 56, 24), (45, 55, 30), (50, 55, 28), (0, 0, 2, 4),
               (11, 32, 30, 10, 1)),
    "lateral": ((45, 60, 30), (60, 75, 40), (66, 78, 42), (70, 74, 40), (0, 0, 0, 2),
                (-31, 35, 10, 9, 1)),
    "platform": ((8, 12, 6), (8, 12, 6), (10, 12, 6), (12, 12, 6), (8, 0, 6, 10),
                 (-12, -8, 0, 0, 0)),
    "point": ((0, 3, 0), (70, 88, 48), (76, 90, 50), (78, 86, 46), (0, 0, 0, 0),
              (-7, 31, 23, 28, 19)),
    "index_extension": ((20, 15, 5), (58, 66, 36), (64, 68, 38), (68, 66, 36), (2, 0, 2, 4),
                        (32, 16, 30, 12, 16)),
    "extended": ((55, 5, 3), (55, 5, 3), (56, 6, 4), (56, 8, 4), (2, 0, 2, 4), (2, 39, 34, 1, 0)),
}  # fmt: skip
_SPREAD_DEG = 7.0  # independent variation of every angle about a mixture of two grasps
_THUMB_SPREAD_DEG = 15.0  # objects turn a thumb aside more than they do fingers

_DOWN = np.array([0.0, -1, 0])
# Where the left thumb's pad looks in the T-pose: along the shorter axis of its phalanges' sections
_THUMB_PAD = np.array([0.2, -0.4, -0.9])


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def _rotation_vector(rotation: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_rotvec()


def _about(axis: np.ndarray, degrees: float) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(_unit(axis) * np.radians(degrees)).as_matrix()


def _thumb(angles: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """Rotation vectors (3,3) of the left thumb; bones (3,3) in the T-pose."""
    palmar, flexion, pronation, *hinges = angles
    hinge = np.cross(bones, _THUMB_PAD)
    base = (
        _about(hinge[0], flexion)
        @ _about(np.cross(bones[0], _DOWN), palmar)
        @ _about(bones[0], pronation)
    )
    turns = [base, *(_about(axis, angle) for axis, angle in zip(hinge[1:], hinges, strict=True))]
    return np.stack([_rotation_vector(turn) for turn in turns])


def hand_pose(angles: np.ndarray, joints: np.ndarray, tips: np.ndarray) -> np.ndarray:
    """Left hand's (45,) axis-angle for (21,) angles in degrees, see `GRASPS` for their order.

    joints (55,3) and tips (10,3) in the T-pose: palm down, fingers along +x, thumb forward.
    """
    pose = np.zeros((15, 3))
    source_row = {"index": 0, "middle": 1, "ring": 2, "pinky": 3}
    away = {"index": 1.0, "middle": 0.0, "ring": -1.0, "pinky": -1.0}  # sign of z
    for f, finger in enumerate(FINGERS):
        chain = np.vstack([joints[25 + 3 * f : 28 + 3 * f], tips[f]])
        bones = np.diff(chain, axis=0)
        if finger == "thumb":
            pose[3 * f : 3 * f + 3] = _thumb(angles[16:21], bones)
            continue
        row = source_row[finger]
        spread = -away[finger] * angles[12 + row]  # about +y, +x turns to -z for a positive angle
        for i in range(3):
            turn = _about(np.cross(bones[i], _DOWN), angles[3 * row + i])
            if i == 0:
                turn = _about(-_DOWN, spread) @ turn
            pose[3 * f + i] = _rotation_vector(turn)
    return pose.reshape(45)


def named_grasp(name: str, joints: np.ndarray, tips: np.ndarray) -> np.ndarray:
    """The left hand's (45,) pose of one grasp."""
    return hand_pose(np.concatenate([np.ravel(x) for x in GRASPS[name]]), joints, tips)


def mirrored(pose: np.ndarray) -> np.ndarray:
    """(...,45) of one hand -> the other hand's: a rotation vector mirrors to (x, -y, -z)."""
    return (pose.reshape(*pose.shape[:-1], 15, 3) * [1, -1, -1]).reshape(pose.shape)


def pose_space(
    joints: np.ndarray, tips: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left hand's mean (45,), components (45,45), standard deviations (45,) of `count` poses."""
    rng = np.random.default_rng(seed)
    table = np.array([np.concatenate([np.ravel(x) for x in g]) for g in GRASPS.values()], float)
    low = np.array([-10, 0, 0] * 4 + [-5] * 4 + [-40, -15, -10, -10, -12], float)
    high = np.array([90, 105, 70] * 4 + [22] * 4 + [42, 48, 40, 55, 80], float)
    first, second = rng.integers(len(table), size=(2, count))
    share = rng.random((count, 1))
    angles = share * table[first] + (1 - share) * table[second]
    # Fingers vary together more than alone
    common = rng.normal(0, _SPREAD_DEG, (count, 3))
    angles[:, :12] += np.tile(common, 4)
    alone = np.array([_SPREAD_DEG] * 12 + [0.6 * _SPREAD_DEG] * 4 + [_THUMB_SPREAD_DEG] * 5)
    angles += rng.normal(0, 1, angles.shape) * alone
    angles = np.clip(angles, low, high)
    poses = np.stack([hand_pose(a, joints, tips) for a in angles])
    mean = poses.mean(0)
    _, size, components = np.linalg.svd(poses - mean, full_matrices=True)
    components *= np.sign(components[np.arange(45), np.abs(components).argmax(1)])[:, None]
    # What no sampled pose uses (fingers that roll about themselves) keeps a small spread
    deviation = np.maximum(size / np.sqrt(count), np.radians(1.0))
    return mean, components, deviation
