"""Named vertices of the open body: keypoints and the 81 markers of the LEMO prior.

Keypoints are extremes of the shape. A marker is where a ray from a bone, in an anatomical
direction, leaves the skin: so it follows the marker protocol's words, not another mesh's ids.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.maps import MARKER_NAMES, POINT_NAMES, find_regions

_X, _Y, _Z = np.eye(3)
# Left and midline markers: start joint, end joint, share of the way, direction (x to the left).
# "hand" and "sole" stand for the wrist and ankle frames, which are level in the T-pose.
_MARKERS: dict[str, tuple[str, str, float, tuple[float, float, float]]] = {
    "C7": ("neck", "spine3", 0.05, (0, 0.25, -1)),
    "CLAV": ("neck", "spine3", 0.35, (0, 0, 1)),
    "STRN": ("neck", "spine3", 0.95, (0, 0, 1)),
    "T8": ("neck", "spine3", 0.85, (0, 0, -1)),
    "MBLLY": ("spine2", "spine1", 0.8, (0, 0, 1)),
    "LANK": ("left_ankle", "left_ankle", 0, (1, -0.05, -0.1)),
    "LFWT": ("pelvis", "left_hip", 0.95, (0.35, 0.55, 1)),
    "LBWT": ("pelvis", "left_hip", 0.45, (0, 0.45, -1)),
    "LNWST": ("spine1", "spine2", 0.2, (1, 0, 0)),
    "LBAK": ("spine3", "left_shoulder", 0.6, (0, -0.35, -1)),
    "LBCEP": ("left_shoulder", "left_elbow", 0.55, (0, 0, 1)),
    "LBSH": ("left_shoulder", "left_shoulder", 0, (0.1, 0.1, -1)),
    "LBUM": ("left_hip", "left_hip", 0, (-0.15, -0.25, -1)),
    "LBUST": ("spine3", "left_shoulder", 0.5, (0, -0.45, 1)),
    "LRSTBEEF": ("left_ankle", "left_foot", 0.5, (0.15, 1, 0)),
    "LELB": ("left_elbow", "left_elbow", 0, (0, 0.2, -1)),
    "LELBIN": ("left_elbow", "left_elbow", 0, (0, -0.2, 1)),
    "LFIN": ("left_wrist", "left_middle1", 0.9, (0, 1, 0.1)),
    "LFRM2": ("left_elbow", "left_wrist", 0.5, (0, 0, -1)),
    "LFTHI": ("left_hip", "left_knee", 0.4, (0, 0, 1)),
    "LFTHIIN": ("left_hip", "left_knee", 0.5, (-0.5, 0, 1)),
    "LTHI": ("left_hip", "left_knee", 0.55, (1, 0, 0)),
    "LKNE": ("left_knee", "left_knee", 0, (1, 0, 0.1)),
    "LKNI": ("left_knee", "left_knee", 0, (-1, 0, 0.1)),
    "LTIB": ("left_knee", "left_ankle", 0.45, (0.5, 0, 1)),
    "LHEE": ("left_ankle", "left_ankle", 0, (0, -0.45, -1)),
    "LMT1": ("left_foot", "left_foot", 0, (-1, 0.25, 0)),
    "LMT5": ("left_foot", "left_foot", 0, (1, -0.05, -0.35)),
    "LTOE": ("left_ankle", "left_foot", 1.2, (0, 1, 0.6)),
    "LIWR": ("left_wrist", "left_wrist", 0, (-0.1, 0.1, 1)),
    "LOWR": ("left_wrist", "left_wrist", 0, (-0.1, 0.1, -1)),
    "LTHMB": ("left_thumb2", "left_thumb3", 0.3, (-0.2, 0.5, 1)),
    "LSHO": ("left_shoulder", "left_shoulder", 0, (0.1, 1, 0)),
    "LCHEECK": ("jaw", "left_eye_smplhf", 0.5, (0.5, -0.1, 1)),
    "LFHD": ("left_eye_smplhf", "left_eye_smplhf", 0, (0.7, 1.1, 0.6)),
    "LBHD": ("head", "left_eye_smplhf", 0.6, (0.7, 0.9, -1)),
    "LIDX3": ("left_index3", "left_index3", 0, (0.5, 1, 0)),
    "LMID3": ("left_middle3", "left_middle3", 0, (0.5, 1, 0)),
    "LPNK3": ("left_pinky3", "left_pinky3", 0, (0.5, 1, 0)),
    "LRNG3": ("left_ring3", "left_ring3", 0, (0.5, 1, 0)),
    "LTHM4": ("left_thumb3", "left_thumb3", 0, (0.6, 0.5, 0.6)),
    "CHN1": ("jaw", "jaw", 0, (0.06, -0.75, 1)),
    "CHN2": ("jaw", "jaw", 0, (0, -0.95, 1)),
    "MTH3": ("jaw", "jaw", 0, (0.22, -0.2, 1)),
    "MTH7": ("jaw", "jaw", 0, (-0.22, -0.2, 1)),
}  # fmt: skip
# The set's two sides differ: the right breast marker is lower, the forearm has an extra one.
_RIGHT_ONLY = {
    "RBUSTLO": ("spine3", "right_shoulder", 0.5, (0, -0.75, 1)),
    "RFRM2IN": ("right_elbow", "right_wrist", 0.5, (0, 0, 1)),
}


def _leave(
    origin: np.ndarray,
    direction: np.ndarray,
    vertices: np.ndarray,
    scene: object,
    faces: np.ndarray,
) -> int:
    """The vertex nearest to where the ray first leaves the skin."""
    d = direction / np.linalg.norm(direction)
    ray = np.concatenate([origin, d]).astype(np.float32)[None]
    hit = scene.cast_rays(ray)  # type: ignore[attr-defined]
    face = faces[int(hit["primitive_ids"].numpy()[0])]
    point = origin + d * float(hit["t_hit"].numpy()[0])
    return int(face[np.linalg.norm(vertices[face] - point, axis=1).argmin()])


def markers(vertices: np.ndarray, faces: np.ndarray, joints: np.ndarray,
            weights: np.ndarray,) -> dict[str, int]:  # fmt: skip
    """Vertex id of each of `MARKER_NAMES`."""
    import open3d as o3d

    skin = faces[(weights[faces][..., [23, 24]].sum(2) < 0.5).all(1)]
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), skin.astype(np.uint32))
    found = {}
    for name in MARKER_NAMES:
        flip = False
        spec = _MARKERS.get(name) or _RIGHT_ONLY.get(name)
        if spec is None:
            spec, flip = _MARKERS["L" + name[1:]], True
        start, end, share, direction = spec
        if flip:
            start, end = (n.replace("left_", "right_") for n in (start, end))
        a, b = joints[JOINT_INDEX[start]], joints[JOINT_INDEX[end]]
        d = np.array(direction, float) * ([-1, 1, 1] if flip else [1, 1, 1])
        found[name] = _leave(a + share * (b - a), d, vertices, scene, skin)
    return found


def keypoint_vertices(
    vertices: np.ndarray, weights: np.ndarray, joints: np.ndarray, tips: np.ndarray
) -> dict[str, int]:
    """Vertex id of each of `POINT_NAMES`; tips (10,3) ends of the finger bones."""

    def furthest(mask: np.ndarray, direction: np.ndarray) -> int:
        score = np.where(mask, vertices @ direction, -np.inf)
        return int(score.argmax())

    head = weights[:, JOINT_INDEX["head"]] > 0.5
    out = {"nose": furthest(head & (np.abs(vertices[:, 0]) < 0.01), _Z)}
    order = ("index", "middle", "pinky", "ring", "thumb")
    for side, flip, first in (("left", 1.0, 0), ("right", -1.0, 5)):
        mirror = np.array([flip, 1, 1])
        ball = weights[:, JOINT_INDEX[f"{side}_eye_smplhf"]] > 0.5
        out[f"{side}_eye"] = furthest(ball, _Z)
        out[f"{side}_ear"] = furthest(head, _X * flip)
        foot = weights[:, [JOINT_INDEX[f"{side}_{n}"] for n in ("ankle", "foot")]].sum(1) > 0.5
        ankle = joints[JOINT_INDEX[f"{side}_ankle"]]
        toward = joints[JOINT_INDEX[f"{side}_foot"]] - ankle
        toward = toward * [1, 0, 1] / np.linalg.norm(toward * [1, 0, 1])
        outward = np.cross(_Y, toward) * flip
        out[f"{side}_heel"] = furthest(foot, -toward - 0.15 * _Y)
        inner = foot & ((vertices - ankle) @ outward < -0.01)
        out[f"{side}_big_toe"] = furthest(inner, toward)
        out[f"{side}_small_toe"] = furthest(foot, toward + 1.6 * outward)
        for f, finger in enumerate(order):
            last = JOINT_INDEX[f"{side}_{finger}3"]
            along = tips[first + f] - joints[last]
            out[f"{side}_{finger}"] = furthest(
                weights[:, last] > 0.5, along / np.linalg.norm(along) - 0.2 * _Y * mirror
            )
    return {name: out[name] for name in POINT_NAMES}


def write_maps(
    path: Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    weights: np.ndarray,
    joints: np.ndarray,
    tips: np.ndarray,
    mouth_outline: np.ndarray,
) -> None:
    regions = find_regions(vertices, faces, weights, joints, mouth_outline)
    content = {
        "points": keypoint_vertices(vertices, weights, joints, tips),
        "markers": markers(vertices, faces, joints, weights),
        "regions": {name: ids.tolist() for name, ids in regions.items()},
    }
    rows = [f'  "{key}": {json.dumps(value)}' for key, value in content.items()]
    path.write_text("{\n" + ",\n".join(rows) + "\n}\n")
