"""The sparse set of skin vertices that E_D and E_P_self (equations 4 and 5) use, and its coverings.

Points of the measured clouds are gathered on these samples; a sample counts as one measurement.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.body.joints import JOINT_INDEX, JOINT_NAMES
from intercap_core.body.model import BodyModel
from intercap_core.body_fit.body_constants import BODY_SPACING_M, HAND_SPACING_M, PATCH_VERTICES


@dataclass(frozen=True)
class Covering:
    """What lies on the skin: usual thickness in metres, spread of its logarithm, and the noise
    (metres) of one sample's mean distance about it, from folds and from what the body model lacks.
    """

    name: str
    thickness: float
    spread: float
    noise: float


# Light indoor clothing is 1-2 mm of fabric that stands off by folds and air: mean air gaps of
# shirts and trousers are 5-20 mm (Psikuta et al. 2012, "Quantitative evaluation of air gap
# thickness and contact area between body and garment").
COVERINGS = (
    Covering("bare", 0.0005, 0.1, 0.006),
    Covering("hair", 0.004, 0.6, 0.010),
    Covering("trunk", 0.010, 0.5, 0.010),
    Covering("upper_arm", 0.009, 0.5, 0.009),
    Covering("forearm", 0.004, 0.7, 0.008),
    Covering("thigh", 0.009, 0.5, 0.010),
    Covering("lower_leg", 0.007, 0.6, 0.009),
    Covering("foot", 0.005, 1.0, 0.009),
    Covering("sole", 0.007, 1.0, 0.009),
)
SOLE_M = 0.035  # above the lowest skin; a shoe's upper begins about there

_COVERING_OF_JOINT = {
    "pelvis": "trunk", "spine1": "trunk", "spine2": "trunk", "spine3": "trunk",
    "collar": "trunk", "neck": "bare", "head": "hair", "jaw": "bare", "shoulder": "upper_arm",
    "elbow": "forearm", "wrist": "bare", "hip": "thigh", "knee": "lower_leg", "ankle": "foot",
    "foot": "foot",
}  # fmt: skip


@dataclass(frozen=True)
class Samples:
    """The sparse set of N vertices.

    vertex (N,) ids; patch (N,20) ids of the nearest outer vertices, itself first; group (N,) index
    into COVERINGS; hand (N,) bool.
    """

    vertex: np.ndarray
    patch: np.ndarray
    group: np.ndarray
    hand: np.ndarray


def choose_samples(model: BodyModel) -> Samples:
    """Spread vertices over the outer skin, denser on the hands; the same for the same file."""
    import scipy.spatial

    template = model.template.double().cpu().numpy()
    faces = model.faces.cpu().numpy()
    joint = model.skinning_weights.argmax(1).cpu().numpy()
    hand_joints = [i for i, name in enumerate(JOINT_NAMES) if i >= 25 or name.endswith("wrist")]
    hand = np.isin(joint, hand_joints)
    outer = _outer(template, faces, joint)
    chosen = [
        _grid(template, np.flatnonzero(outer & part), spacing)
        for part, spacing in ((~hand, BODY_SPACING_M), (hand, HAND_SPACING_M))
    ]
    vertex = np.concatenate(chosen)
    outside = np.flatnonzero(outer)
    _, near = scipy.spatial.cKDTree(template[outside]).query(template[vertex], PATCH_VERTICES)
    names = [c.name for c in COVERINGS]
    group = np.array([_covering(joint[v], names) for v in vertex])
    face = _is_face(template, joint, model)[vertex]
    group[face] = names.index("bare")
    low = template[vertex, 1] < template[:, 1].min() + SOLE_M
    group[low & (group == names.index("foot"))] = names.index("sole")
    return Samples(vertex, outside[near], group, hand[vertex])


def _covering(joint: int, names: list[str]) -> int:
    name = JOINT_NAMES[joint].removeprefix("left_").removeprefix("right_")
    return names.index(_COVERING_OF_JOINT.get(name, "bare"))


def _is_face(template: np.ndarray, joint: np.ndarray, model: BodyModel) -> np.ndarray:
    """The front of the head below the brows: within the box of the face landmarks, looking on."""
    landmarks = template[model.keypoint_map.ids[67:118].reshape(-1)]
    low, high = landmarks.min(0), landmarks.max(0)
    inside = (template[:, :2] > low[:2] - 0.01) & (template[:, :2] < high[:2] + 0.01)
    on_head = np.isin(joint, [JOINT_INDEX["head"], JOINT_INDEX["jaw"]])
    return inside.all(1) & (template[:, 2] > low[2] - 0.01) & on_head


def _grid(points: np.ndarray, ids: np.ndarray, spacing: float) -> np.ndarray:
    """One id for each occupied cube of a grid: the one nearest to the cube's middle."""
    cell = np.floor(points[ids] / spacing).astype(np.int64)
    from_middle = np.abs(points[ids] / spacing - cell - 0.5).max(1)
    order = np.lexsort((from_middle, cell[:, 2], cell[:, 1], cell[:, 0]))
    _, first = np.unique(cell[order], axis=0, return_index=True)
    return np.sort(ids[order[first]])


def _outer(points: np.ndarray, faces: np.ndarray, joint: np.ndarray) -> np.ndarray:
    """Vertices of the skin's outside: no eyes, tongue, mouth cavity or nostrils.

    On the head a vertex is inside where a ray along its normal meets the mesh again.
    """
    import scipy.sparse.csgraph

    from intercap_core.body_fit.first_hit import first_hits
    from intercap_core.geometry.rigid.surfaces import vertex_normals

    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(points), len(points))
    )
    _, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    outer = part == np.bincount(part).argmax()
    head = [JOINT_INDEX[n] for n in ("head", "jaw", "left_eye_smplhf", "right_eye_smplhf")]
    ids = np.flatnonzero(outer & np.isin(joint, head))
    normals = vertex_normals(points, faces)[ids]
    hits = first_hits(points, faces, points[ids] + 1e-3 * normals, normals)
    outer[ids[np.isfinite(hits)]] = False
    return outer
