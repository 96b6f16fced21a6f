"""The part of the skin that E_D and E_P_self (equations 4 and 5) use: samples and their patches.

Points of the measured clouds are assigned to a sparse set of skin vertices, the samples. Each
sample is one measurement, however many points it has. The 20 outer vertices nearest to a sample are
its patch. Every sample belongs to a covering: a kind of clothing, hair, or bare skin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import JOINT_INDEX, JOINT_NAMES
from intercap_core.body.keypoints import FACE
from intercap_core.body.kinematics import vertex_normals
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.geometry.rigid import surfaces as rigid_surfaces
from intercap_core.geometry.rigid.surface_tree import SurfaceTree

# Scale of unit normals n in the distance of a match, |p - q|^2 + (scale |n_p - n_q|)^2: metres per
# radian. Tuned on the studio.
NORMAL_LENGTH_M = 0.06
BODY_LENGTH_M = 3.0  # longer than any body
# Largest distance of a matched point from the line through its vertex along the normal, metres.
# Tuned on the studio.
MATCH_SIDEWAYS_M = 0.03


# Weight of a sample in E_D and E_P_self. Errors of neighbouring samples are correlated, since they
# lie on one fold of cloth and penetrate together: four samples count as one independent
# measurement. Tuned on the studio.
SAMPLE_SHARE = 0.25


@dataclass(frozen=True)
class Covering:
    """The layer between the skin and the measured surface."""

    name: str
    thickness: float
    """Usual thickness, metres."""
    spread: float
    """Standard deviation of the logarithm of the thickness."""
    noise: float
    """Initial standard deviation of a sample's mean distance, metres, due to folds and errors of
    the body model."""


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
_COVERING_OF_JOINT = {
    "pelvis": "trunk", "spine1": "trunk", "spine2": "trunk", "spine3": "trunk",
    "collar": "trunk", "neck": "bare", "head": "hair", "jaw": "bare", "shoulder": "upper_arm",
    "elbow": "forearm", "wrist": "bare", "hip": "thigh", "knee": "lower_leg", "ankle": "foot",
    "foot": "foot",
}  # fmt: skip


# --- samples ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Samples:
    """The sparse set of N skin vertices."""

    vertex: np.ndarray
    """(N,) vertex ids."""
    patch: np.ndarray
    """(N, 20) ids of the nearest vertices of the outer skin, the sample itself first."""
    group: np.ndarray
    """(N,) covering of each sample, an index into COVERINGS."""
    hand: np.ndarray
    """(N,) bool: the sample is on a hand."""


def choose_samples(model: BodyModel) -> Samples:
    """Spread samples over the outer skin, denser on the hands. The choice is deterministic."""
    import scipy.spatial

    template = model.template.double().numpy()
    faces = model.faces.numpy()
    joint = model.skinning_weights.argmax(1).numpy()
    # wrists and the 30 finger joints, 25 to 54
    hand_joints = [i for i, name in enumerate(JOINT_NAMES) if i >= 25 or name.endswith("wrist")]
    hand = np.isin(joint, hand_joints)
    outer = _flag_outer_skin(template, faces, joint)
    # spacing in metres; on hands the width of a finger (anatomy), elsewhere tuned on the studio
    chosen = [
        _thin_by_grid(template, np.flatnonzero(outer & part), spacing)
        for part, spacing in ((~hand, 0.045), (hand, 0.015))
    ]
    vertex = np.concatenate(chosen)
    outside = np.flatnonzero(outer)
    _, near = scipy.spatial.cKDTree(template[outside]).query(template[vertex], 20)
    names = [c.name for c in COVERINGS]
    group = np.array([_covering(joint[v], names) for v in vertex])
    face = _flag_face(template, joint, model)[vertex]
    group[face] = names.index("bare")
    # the upper of a shoe begins 35 mm above the lowest skin (anatomy)
    low = template[vertex, 1] < template[:, 1].min() + 0.035
    group[low & (group == names.index("foot"))] = names.index("sole")
    return Samples(vertex, outside[near], group, hand[vertex])


def _covering(joint: int, names: list[str]) -> int:
    """Return the index among ``names`` of the covering of the skin that follows a joint."""
    name = JOINT_NAMES[joint].removeprefix("left_").removeprefix("right_")
    return names.index(_COVERING_OF_JOINT.get(name, "bare"))


def _flag_face(template: np.ndarray, joint: np.ndarray, model: BodyModel) -> np.ndarray:
    """Flag the vertices (V,) of the face: the front of the head within the box of the landmarks.

    The landmarks reach from the brows to the mouth; the box is 10 mm larger.
    """
    landmarks = template[model.keypoint_map.ids[FACE].reshape(-1)]
    low, high = landmarks.min(0), landmarks.max(0)
    inside = (template[:, :2] > low[:2] - 0.01) & (template[:, :2] < high[:2] + 0.01)
    on_head = np.isin(joint, [JOINT_INDEX["head"], JOINT_INDEX["jaw"]])
    return inside.all(1) & (template[:, 2] > low[2] - 0.01) & on_head


def _thin_by_grid(points: np.ndarray, ids: np.ndarray, spacing: float) -> np.ndarray:
    """Return one of the ``ids`` for each occupied cube of a grid: the point nearest to its centre.

    spacing: size of a cube, metres.
    """
    cell = np.floor(points[ids] / spacing).astype(np.int64)
    from_middle = np.abs(points[ids] / spacing - cell - 0.5).max(1)
    order = np.lexsort((from_middle, cell[:, 2], cell[:, 1], cell[:, 0]))
    _, first = np.unique(cell[order], axis=0, return_index=True)
    return np.sort(ids[order[first]])


def _flag_outer_skin(points: np.ndarray, faces: np.ndarray, joint: np.ndarray) -> np.ndarray:
    """Flag the vertices (V,) of the outer skin: no eyes, tongue, mouth cavity or nostrils.

    A vertex of the head is inside if a ray along its normal meets the mesh again.
    """
    import scipy.sparse.csgraph

    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    graph = scipy.sparse.coo_matrix(
        (np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(len(points), len(points))
    )
    _, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    outer = part == np.bincount(part).argmax()
    head = [JOINT_INDEX[n] for n in ("head", "jaw", "left_eye_smplhf", "right_eye_smplhf")]
    ids = np.flatnonzero(outer & np.isin(joint, head))
    normals = rigid_surfaces.vertex_normals(points, faces)[ids]
    inner = np.zeros(len(ids), bool)
    surface = SurfaceTree(points, faces).shaped(points)
    surface.blocks(points[ids] + 1e-3 * normals, points[ids] + BODY_LENGTH_M * normals, inner)
    outer[ids[inner]] = False
    return outer


# --- posed surface ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SkinSurface:
    """The part of the mesh around the N samples: the F faces that touch a patch, and their R
    vertices."""

    model: BodyModel
    ids: np.ndarray
    """(R,) vertex ids in the body."""
    faces: np.ndarray
    """(F, 3) indices into ``ids``."""
    sample: np.ndarray
    """(N,) index of each sample in ``ids``."""
    patch: np.ndarray
    """(N, 20) indices of each sample's patch in ``ids``."""
    around: np.ndarray
    """(A,) faces at each vertex, vertex by vertex. Vertices outside of all patches have none."""
    starts: np.ndarray
    """(R + 1,) start of each vertex's faces in ``around``, then A."""
    order: np.ndarray
    """(N,) samples, ordered by groups of neighbours (not by coverings)."""
    groups: np.ndarray
    """(G + 1,) start of each group of neighbours in ``order``, then N."""

    @classmethod
    def around_samples(cls, model: BodyModel, samples: Samples) -> SkinSurface:
        """Return the surface around the samples of a body."""
        every = model.faces.numpy()
        used = np.zeros(model.num_vertices, bool)
        used[samples.vertex] = used[samples.patch] = True
        faces = every[used[every].any(1)]
        ids = np.unique(faces)
        place = np.full(model.num_vertices, -1)
        place[ids] = np.arange(len(ids))
        faces = place[faces]
        corner = faces.ravel()
        face = np.repeat(np.arange(len(faces)), 3)[used[ids][corner]]
        corner = corner[used[ids][corner]]
        order, groups = _group_samples(model, samples)
        return cls(
            model=model,
            ids=ids,
            faces=faces,
            sample=place[samples.vertex],
            patch=place[samples.patch],
            around=face[np.argsort(corner, kind="stable")],
            starts=np.searchsorted(np.sort(corner), np.arange(len(ids) + 1)),
            order=order,
            groups=groups,
        )

    def posed(self, params: BodyParameters) -> tuple[Tensor, Tensor]:
        """Return vertices (B, R, 3), metres, and unit normals (B, R, 3) of B posed bodies.

        Normals of vertices outside of all patches are zero.
        """
        vertices = self.model.forward(params, vertex_ids=self.ids).vertices
        normals = torch.empty_like(vertices)
        _vertex_normals(vertices.numpy(), self.faces, self.starts, self.around, normals.numpy())
        return vertices, normals


def _group_samples(model: BodyModel, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
    """Halve the samples by position and scaled normal at rest until groups have at most 24 samples.

    Each half is split along the coordinate of largest extent, as in a k-d tree.

    Returns:
        (N,) order of the samples, group by group.
        (G + 1,) start of each group in the order, then N.
    """
    template = model.template[None]
    rest = torch.cat([template, NORMAL_LENGTH_M * vertex_normals(template, model.faces)], 2)[0]
    at = rest.double().numpy()[samples.vertex]
    whole, parts = [np.arange(len(at))], []
    while whole:
        part = whole.pop()
        if len(part) <= 24:
            parts.append(part)
            continue
        axis = int(np.ptp(at[part], axis=0).argmax())
        half = np.array_split(part[np.argsort(at[part, axis], kind="stable")], 2)
        whole += half[::-1]
    return np.concatenate(parts), np.cumsum([0, *map(len, parts)])


@numba.njit(cache=True, nogil=True)
def _vertex_normals(vertices, faces, starts, around, out):
    """Write area-weighted unit normals (B,R,3) of vertices (B,R,3) to ``out``.

    ``around[starts[v] : starts[v + 1]]`` are the faces at vertex v, indices into faces (F,3). A
    vertex without faces gets a zero normal.
    """
    cross = np.empty((len(faces), 3), vertices.dtype)
    for b in range(len(vertices)):
        posed = vertices[b]
        for f in range(len(faces)):
            i, j, k = faces[f]
            ax, ay, az = posed[i, 0], posed[i, 1], posed[i, 2]
            ux, uy, uz = posed[j, 0] - ax, posed[j, 1] - ay, posed[j, 2] - az
            vx, vy, vz = posed[k, 0] - ax, posed[k, 1] - ay, posed[k, 2] - az
            cross[f, 0] = uy * vz - uz * vy
            cross[f, 1] = uz * vx - ux * vz
            cross[f, 2] = ux * vy - uy * vx
        for v in range(len(starts) - 1):
            x = y = z = cross[0, 0] * 0
            for at in range(starts[v], starts[v + 1]):
                f = around[at]
                x += cross[f, 0]
                y += cross[f, 1]
                z += cross[f, 2]
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0:
                x, y, z = x / length, y / length, z / length
            out[b, v, 0], out[b, v, 1], out[b, v, 2] = x, y, z
