"""Mean pose and pose components of the hands from a set of grasps with anatomical ranges.

The grasps are named after Feix et al. 2016, "The GRASP Taxonomy of Human Grasp Types"; joint
ranges are those of the AAOS tables (MCP 0-90, PIP 0-100, DIP 0-70, abduction +-20 degrees).
"""

from __future__ import annotations

import numpy as np

FINGERS = ("index", "middle", "pinky", "ring", "thumb")
_FIRST = {"left": 25, "right": 40}

# degrees: MCP, PIP, DIP flexion of index, middle, ring, pinky; their abduction (away from the
# middle finger); thumb: palmar abduction and flexion of the base, flexion of MCP, of IP.
_GRASPS: dict[str, tuple[tuple[float, ...], ...]] = {
    "flat": ((0, 0, 0),) * 4 + ((4, 0, 4, 8), (0, 0, 0, 0)),
    "spread": ((-8, 2, 0),) * 4 + ((16, 0, 14, 20), (0, -15, -5, -5)),
    "relaxed": ((18, 25, 12), (22, 30, 14), (26, 32, 15), (30, 32, 15), (3, 0, 2, 5),
                (15, 5, 10, 10)),
    "curled": ((40, 50, 25), (44, 55, 28), (48, 55, 28), (52, 52, 26), (2, 0, 2, 4),
               (25, 10, 15, 20)),
    "fist": ((78, 95, 55), (82, 98, 58), (84, 98, 58), (84, 94, 55), (0, 0, 0, 0),
             (30, 30, 35, 45)),
    "hook": ((15, 85, 50), (15, 88, 52), (18, 88, 52), (22, 84, 50), (0, 0, 0, 2), (5, 0, 5, 10)),
    "large_diameter": ((28, 35, 20), (32, 38, 22), (36, 40, 24), (42, 40, 24), (8, 0, 6, 10),
                       (42, 0, 8, 12)),
    "medium_wrap": ((48, 55, 30), (54, 60, 34), (60, 62, 34), (64, 60, 32), (3, 0, 2, 5),
                    (48, 12, 18, 25)),
    "small_diameter": ((65, 78, 42), (70, 84, 46), (74, 84, 46), (78, 80, 44), (0, 0, 0, 2),
                       (45, 22, 28, 35)),
    "sphere": ((30, 40, 25), (32, 42, 26), (34, 42, 26), (36, 40, 25), (14, 0, 12, 18),
               (48, -5, 10, 15)),
    "disk": ((5, 45, 28), (6, 46, 28), (8, 46, 28), (10, 44, 26), (15, 0, 12, 18), (40, -8, 5, 20)),
    "pinch": ((45, 42, 22), (30, 35, 18), (26, 30, 15), (24, 26, 12), (2, 0, 2, 4),
              (40, 12, 15, 22)),
    "tripod": ((44, 42, 22), (48, 44, 24), (45, 55, 30), (50, 55, 28), (2, 0, 2, 4),
               (42, 14, 16, 22)),
    "lateral": ((45, 60, 30), (60, 75, 40), (66, 78, 42), (70, 74, 40), (0, 0, 0, 2),
                (8, 25, 15, 25)),
    "platform": ((8, 12, 6), (8, 12, 6), (10, 12, 6), (12, 12, 6), (8, 0, 6, 10), (12, -8, 0, 0)),
    "point": ((0, 3, 0), (70, 88, 48), (76, 90, 50), (78, 86, 46), (0, 0, 0, 0), (32, 25, 30, 35)),
    "index_extension": ((20, 15, 5), (58, 66, 36), (64, 68, 38), (68, 66, 36), (2, 0, 2, 4),
                        (45, 15, 20, 28)),
    "extended": ((55, 5, 3), (55, 5, 3), (56, 6, 4), (56, 8, 4), (2, 0, 2, 4), (45, 5, 5, 5)),
}  # fmt: skip
_SPREAD_DEG = 7.0  # independent variation of every angle about a mixture of two grasps


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def _rotation_vector(rotation: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_rotvec()


def _about(axis: np.ndarray, degrees: float) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(_unit(axis) * np.radians(degrees)).as_matrix()


def hand_pose(angles: np.ndarray, joints: np.ndarray, tips: np.ndarray) -> np.ndarray:
    """Left hand's (45,) axis-angle for (20,) angles in degrees, see `_GRASPS` for their order.

    joints (55,3) and tips (10,3) in the T-pose: palm down, fingers along +x, thumb forward.
    """
    down, ulnar = np.array([0.0, -1, 0]), np.array([0.0, 0, -1])
    pose = np.zeros((15, 3))
    source_row = {"index": 0, "middle": 1, "ring": 2, "pinky": 3}
    away = {"index": 1.0, "middle": 0.0, "ring": -1.0, "pinky": -1.0}  # sign of z
    for f, finger in enumerate(FINGERS):
        chain = np.vstack([joints[25 + 3 * f : 28 + 3 * f], tips[f]])
        bones = np.diff(chain, axis=0)
        if finger == "thumb":
            palmar, flex, mcp, ip = angles[16:20]
            lift = np.cross(bones[0], down)
            bend = np.cross(bones[0], ulnar + 0.5 * down)
            base = _about(bend, flex) @ _about(lift, palmar) @ _about(bones[0], 0.4 * palmar)
            pose[3 * f] = _rotation_vector(base)
            for i, angle in ((1, mcp), (2, ip)):
                pose[3 * f + i] = _unit(np.cross(bones[i], ulnar + 0.5 * down)) * np.radians(angle)
            continue
        row = source_row[finger]
        spread = -away[finger] * angles[12 + row]  # about +y, +x turns to -z for a positive angle
        for i in range(3):
            turn = _about(np.cross(bones[i], down), angles[3 * row + i])
            if i == 0:
                turn = _about(-down, spread) @ turn
            pose[3 * f + i] = _rotation_vector(turn)
    return pose.reshape(45)


def named_grasp(name: str, joints: np.ndarray, tips: np.ndarray) -> np.ndarray:
    """The left hand's (45,) pose of one grasp."""
    return hand_pose(np.concatenate([np.ravel(x) for x in _GRASPS[name]]), joints, tips)


def mirrored(pose: np.ndarray) -> np.ndarray:
    """(...,45) of one hand -> the other hand's: a rotation vector mirrors to (x, -y, -z)."""
    return (pose.reshape(*pose.shape[:-1], 15, 3) * [1, -1, -1]).reshape(pose.shape)


def pose_space(
    joints: np.ndarray, tips: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Left hand's mean (45,), components (45,45), standard deviations (45,) of `count` poses."""
    rng = np.random.default_rng(seed)
    table = np.array([np.concatenate([np.ravel(x) for x in g]) for g in _GRASPS.values()], float)
    low = np.array([-10, 0, 0] * 4 + [-5] * 4 + [-5, -20, -10, -10], float)
    high = np.array([90, 105, 70] * 4 + [22] * 4 + [60, 40, 55, 70], float)
    first, second = rng.integers(len(table), size=(2, count))
    share = rng.random((count, 1))
    angles = share * table[first] + (1 - share) * table[second]
    # Fingers vary together more than alone
    common = rng.normal(0, _SPREAD_DEG, (count, 3))
    angles[:, :12] += np.tile(common, 4)
    angles += rng.normal(0, _SPREAD_DEG, angles.shape) * np.array([1] * 12 + [0.6] * 4 + [1] * 4)
    angles = np.clip(angles, low, high)
    poses = np.stack([hand_pose(a, joints, tips) for a in angles])
    mean = poses.mean(0)
    _, size, components = np.linalg.svd(poses - mean, full_matrices=True)
    components *= np.sign(components[np.arange(45), np.abs(components).argmax(1)])[:, None]
    # What no sampled pose uses (fingers that roll about themselves) keeps a small spread
    deviation = np.maximum(size / np.sqrt(count), np.radians(1.0))
    return mean, components, deviation
