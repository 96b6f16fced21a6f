"""From anny's stance (arms lowered, elbows bent) to SMPL-X's T-pose.

The T-pose is the one from which linear blend skinning leads back to anny's stance exactly: with
x_A = sum_k w_k (R_k^T (x_T - j_T,k) + j_A,k) linear in x_T, each vertex is a 3x3 solve. So the
shapes that the artists made are met where arms usually are, not the T-pose.
"""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_NAMES, PARENTS

# Limb directions of SMPL's mean skeleton in its rest pose (left side; x is mirrored for the right).
_UPPER_ARM = (0.2553, -0.0156, -0.0229)
_FOREARM = (0.2657, 0.0127, -0.0074)
_THIGH = (0.0343, -0.3752, -0.0045)
_SHANK = (-0.0136, -0.3980, -0.0437)
_FOOT_YAW = (0.0264, 0.0, 0.1193)
_SPLAY_KEPT = 0.6  # share of the fingers' natural sideways spread that the flat hand keeps
_PELVIS = np.array([0.0, -0.35, 0.01])  # about where SMPL-X has it, so that `transl` compares
_ID = {name: i for i, name in enumerate(JOINT_NAMES)}


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def _shortest_rotation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """R with R a parallel to b, without twist about either."""
    a, b = _unit(a), _unit(b)
    v, c = np.cross(a, b), float(a @ b)
    k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + k + k @ k / (1 + c)


def _frame(direction: np.ndarray, second: np.ndarray) -> np.ndarray:
    x = _unit(direction)
    y = _unit(second - x * (second @ x))
    return np.stack([x, y, np.cross(x, y)], 1)


def _about(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = _unit(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def _twist(rotation: np.ndarray, axis: np.ndarray) -> float:
    """Angle of the rotation's part about `axis`."""
    q_w = np.sqrt(max(1 + np.trace(rotation), 1e-12)) / 2
    q_v = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    ) / (4 * q_w)
    return 2 * float(np.arctan2(q_v @ _unit(axis), q_w))


def world_rotations(joints: np.ndarray, tips: np.ndarray) -> np.ndarray:
    """(55,3) joints and (10,3) finger tips in anny's stance -> (55,3,3) rotations to the T-pose."""
    rotations = np.tile(np.eye(3), (55, 1, 1))
    for side, flip in (("left", 1.0), ("right", -1.0)):
        mirror = np.array([flip, 1, 1])
        at = {n[len(side) + 1 :]: joints[i] for n, i in _ID.items() if n.startswith(side)}

        def put(name: str, rotation: np.ndarray, side: str = side) -> None:
            rotations[_ID[f"{side}_{name}"]] = rotation

        put("hip", _shortest_rotation(at["knee"] - at["hip"], _THIGH * mirror))
        put("knee", _shortest_rotation(at["ankle"] - at["knee"], _SHANK * mirror))
        foot = (at["foot"] - at["ankle"]) * [1, 0, 1]
        yaw = _shortest_rotation(foot, _FOOT_YAW * mirror)
        put("ankle", yaw)
        put("foot", yaw)

        upper, fore = at["elbow"] - at["shoulder"], at["wrist"] - at["elbow"]
        hinge = np.cross(upper, fore)
        hinge_t = np.array([0, -flip, 0])
        upper_t, fore_t = _UPPER_ARM * mirror, _FOREARM * mirror
        shoulder = _frame(upper_t, hinge_t) @ _frame(upper, hinge).T
        elbow = _frame(fore_t, hinge_t) @ _frame(fore, hinge).T
        along = at["middle1"] - at["wrist"]
        palm = flip * np.cross(at["pinky1"] - at["wrist"], at["index1"] - at["wrist"])
        out = np.array([flip, 0, 0])
        down = np.array([0.0, -1, 0])
        wrist = _frame(out, down) @ _frame(along, palm).T
        # Half of the forearm's roll goes to the elbow, so that the skin does not wring at the wrist
        roll = _twist(wrist @ elbow.T, fore_t)
        put("shoulder", shoulder)
        put("elbow", _about(fore_t, roll / 2) @ elbow)
        put("wrist", wrist)

        for f, finger in enumerate(("index", "middle", "pinky", "ring", "thumb")):
            if finger == "thumb":
                for i in (1, 2, 3):
                    put(f"thumb{i}", wrist)
                continue
            tip = tips[f if side == "left" else 5 + f]
            chain = [at[f"{finger}{i}"] for i in (1, 2, 3)] + [tip]
            first = wrist @ (chain[1] - chain[0])
            angle = _SPLAY_KEPT * np.arctan2(first[2], flip * first[0])
            target = np.array([flip * np.cos(angle), 0, np.sin(angle)])
            for i in (1, 2, 3):
                bend = _shortest_rotation(wrist @ (chain[i] - chain[i - 1]), target)
                put(f"{finger}{i}", bend @ wrist)
    return rotations


def to_t_pose(
    vertices: np.ndarray, joints: np.ndarray, tips: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One body: vertices (V,3), joints (55,3), tips (10,3), weights (V,55) -> the same, T-posed."""
    rotations = world_rotations(joints, tips)
    placed = np.empty_like(joints)
    placed[0] = _PELVIS
    for k in range(1, 55):
        p = PARENTS[k]
        placed[k] = placed[p] + rotations[p] @ (joints[k] - joints[p])
    back = rotations.transpose(0, 2, 1)
    shift = joints - np.einsum("kij,kj->ki", back, placed)
    blended = (weights @ back.reshape(55, 9)).reshape(-1, 3, 3)
    t_vertices = np.linalg.solve(blended, (vertices - weights @ shift)[..., None])[..., 0]
    ends = [*range(27, 40, 3), *range(42, 55, 3)]
    t_tips = placed[ends] + np.einsum("kij,kj->ki", rotations[ends], tips - joints[ends])
    return t_vertices, placed, t_tips
