"""Where a body touches things: fourteen regions of the skin, found on the T-posed template.

The same rules serve every mesh in SMPL-X's format: skinning weights say which limb a vertex
belongs to, normals which side of it. Lengths scale with the body's own bones.
"""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_INDEX, JOINT_NAMES

REGION_NAMES: tuple[str, ...] = (
    "left_hand", "right_hand", "left_foot", "right_foot", "left_thigh", "right_thigh", "seat",
    "back", "chest", "left_forearm", "right_forearm", "mouth", "left_shoulder", "right_shoulder",
)  # fmt: skip


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,3), (F,3) -> unit normals (V,3), each face counted by its area."""
    cross = np.cross(
        vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    )
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], cross)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _inside_polygon(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """(N,2) inside the closed (M,2) polygon, by crossing number."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    x, y = points[:, :1], points[:, 1:]
    spans = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
    at = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / rise
    return ((spans & (x < at)).sum(1) % 2) == 1


def find_regions(
    vertices: np.ndarray,
    faces: np.ndarray,
    weights: np.ndarray,
    joints: np.ndarray,
    mouth_outline: np.ndarray,
) -> dict[str, np.ndarray]:
    """Vertex ids of each region, ascending; a vertex is in one region at most.

    vertices (V,3), faces (F,3), weights (V,55), joints (55,3) of the T-posed template (y up, facing
    +z, metres); mouth_outline (12,3): the outer lip landmarks in order.
    """
    normals = vertex_normals(vertices, faces)
    at = {name: joints[i] for name, i in JOINT_INDEX.items()}

    def share(*names: str) -> np.ndarray:
        return weights[:, [JOINT_INDEX[n] for n in names]].sum(1)

    found: dict[str, np.ndarray] = {}
    free = np.ones(len(vertices), bool)

    def claim(name: str, mask: np.ndarray) -> None:
        found[name] = np.flatnonzero(mask & free)
        free[found[name]] = False

    thigh_length = np.linalg.norm(at["left_knee"] - at["left_hip"])
    hip_y = (at["left_hip"][1] + at["right_hip"][1]) / 2
    torso = share("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar")

    outline = mouth_outline[:, :2]
    outline = outline.mean(0) + (outline - outline.mean(0)) * 1.06
    front = vertices[:, 2] > mouth_outline[:, 2].min() - 0.012
    claim(
        "mouth",
        (share("head", "jaw") > 0.6)
        & front
        & (normals[:, 2] > 0)
        & _inside_polygon(vertices[:, :2], outline),
    )
    for side, out in (("left", 1.0), ("right", -1.0)):
        fingers = [n for n in JOINT_NAMES if n.startswith(f"{side}_") and n[-1] in "123"]
        hand = share(f"{side}_wrist", *fingers) > 0.5
        past_wrist = out * (vertices[:, 0] - at[f"{side}_wrist"][0]) > 0
        thumb = share(*(n for n in fingers if "thumb" in n)) > 0.5
        down = np.array([0.0, -1, 0])
        # The thumb's pad looks across the palm: to the little finger and down
        across = np.array([0.0, -0.55, -0.83])
        pad = np.where(thumb[:, None], across, down)
        claim(f"{side}_hand", hand & past_wrist & ((normals * pad).sum(1) > 0.15))
        claim(
            f"{side}_foot",
            (share(f"{side}_ankle", f"{side}_foot") > 0.5) & (normals[:, 1] < -0.5),
        )
    seat_low, seat_high = hip_y - 0.32 * thigh_length, hip_y + 0.18 * thigh_length
    legs = share("pelvis", "left_hip", "right_hip")
    claim(
        "seat",
        (legs > 0.5)
        & (vertices[:, 1] > seat_low)
        & (vertices[:, 1] < seat_high)
        & (normals[:, 2] < 0.1)
        & (vertices[:, 2] < joints[[1, 2], 2].mean()),
    )
    arm_length = np.linalg.norm(at["left_elbow"] - at["left_shoulder"])
    for side, out in (("left", 1.0), ("right", -1.0)):
        near = np.linalg.norm(vertices - at[f"{side}_shoulder"], axis=1) < 0.42 * arm_length
        upper_outer = normals @ np.array([0.35 * out, 0.94, 0.0])
        claim(
            f"{side}_shoulder",
            (share(f"{side}_collar", f"{side}_shoulder") > 0.4) & near & (upper_outer > 0.3),
        )
        claim(f"{side}_thigh", share(f"{side}_hip") > 0.5)
        claim(f"{side}_forearm", share(f"{side}_elbow") > 0.5)
    claim("back", (torso > 0.5) & (normals[:, 2] < -0.3) & (vertices[:, 1] > seat_high))
    claim("chest", (torso > 0.5) & (normals[:, 2] > 0.3) & (vertices[:, 1] > seat_high))
    return {name: found[name] for name in REGION_NAMES}
