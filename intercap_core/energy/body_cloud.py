"""Cloud term of the body's energy, E_D of equation 2.

    E_D = sum over views v, points p of the person's cloud in v of min over visible vertices |v - p|

Here the distance is taken along the surface's normal, to the vertex that is nearest in position and
in orientation; a vertex can only be met by points whose surface looks the same way, which leaves
the vertices that the point's camera sees. The measured surface is clothing and hair, not skin:

    e = n . (p - v) - c_g,      c_g = c0_g exp(u_g),   u_g ~ N(0, spread^2)

with one thickness c_g > 0 for each kind of covering g (trunk, upper arms, thighs, head, ...),
shared by all frames. c0_g are everyday garments; hands and face are bare.

The way back, from vertices that a camera should see to what it measured, is in
:mod:`intercap_core.fitting.free_space`.

Points are gathered on a fixed sparse set of vertices, the samples: the solver sees one row for each
sample and frame, the mean distance of the points around it. Errors of neighbouring points are the
same fold of cloth, so a sample counts as one measurement however many points it has.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import JOINT_INDEX, JOINT_NAMES
from intercap_core.body.model import BodyModel

if TYPE_CHECKING:
    from intercap_core.energy.body_surface import Surface

_BODY_SPACING = 0.045
_HAND_SPACING = 0.015
_PATCH = 20  # vertices around a sample among which a point looks for its nearest
NORMAL_LENGTH = 0.06  # metres that a turn of one radian between normals counts as
_ASIDE = 0.03  # metres beside the normal's line beyond which a point meets nothing
_TURNED_AWAY = 0.3  # cosine between the normals of point and vertex below which they do not match


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
    Covering("foot", 0.005, 0.6, 0.009),
)
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
        for part, spacing in ((~hand, _BODY_SPACING), (hand, _HAND_SPACING))
    ]
    vertex = np.concatenate(chosen)
    outside = np.flatnonzero(outer)
    _, near = scipy.spatial.cKDTree(template[outside]).query(template[vertex], _PATCH)
    names = [c.name for c in COVERINGS]
    group = np.array([_covering(joint[v], names) for v in vertex])
    face = _is_face(template, joint, model)[vertex]
    group[face] = names.index("bare")
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

    from intercap_core.energy.first_hit import first_hits
    from intercap_core.rigid.normals import vertex_normals

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


class CloudRows(NamedTuple):
    """What the points say, by sample (B,N): the solver's rows until the next matching.

    target (B,N): n . v that the mean of the points asks for, metres; normal (B,N,3); weight (B,N)
    1/m^2, 0 = no point; distance (B,N): mean signed distance of the points now, outside positive.
    """

    target: Tensor
    normal: Tensor
    weight: Tensor
    distance: Tensor


class Matches(NamedTuple):
    """For each point of one frame (M,): its sample, signed distance (m), and whether it counts."""

    sample: Tensor
    distance: Tensor
    valid: Tensor


def match(
    points: Tensor,
    normals: Tensor,
    vertices: Tensor,
    vertex_normals: Tensor,
    samples: Tensor,
    patch: Tensor,
    reach: float,
) -> Matches:
    """Correspondences of one frame: points, normals (M,3); all vertices (V,3) and normals (V,3);
    samples (N,), patch (N,20) vertex ids. Points farther than ``reach`` metres do not count.
    """
    v, n = vertices[samples], vertex_normals[samples]
    centre = v.mean(0)
    ours = torch.cat([v - centre, NORMAL_LENGTH * n], 1)
    theirs = torch.cat([points - centre, NORMAL_LENGTH * normals], 1)
    sample = torch.addmm((ours * ours).sum(1), theirs, ours.T, alpha=-2).argmin(1)
    near = patch[sample]
    gap = points[:, None] - vertices[near]
    best = (gap * gap).sum(2).argmin(1, keepdim=True)
    at = near.gather(1, best)[:, 0]
    gap = gap.gather(1, best[..., None].expand(-1, 1, 3))[:, 0]
    normal = vertex_normals[at]
    distance = (normal * gap).sum(1)
    sideways = (gap - distance[:, None] * normal).norm(dim=1)
    valid = ((normal * normals).sum(1) > _TURNED_AWAY) & (distance.abs() < reach)
    return Matches(sample, distance, valid & (sideways < _ASIDE))


def match_compiled(
    points: Tensor,
    normals: Tensor,
    vertices: Tensor,
    vertex_normals: Tensor,
    surface: Surface,
    reach: float,
) -> Matches:
    """The same by the compiled kernel, on the CPU; vertices and normals (R,3) of the surface."""
    from intercap_core.energy import body_match_kernel

    kind = vertices.dtype
    found = body_match_kernel.match(
        points.to(kind).numpy(), normals.to(kind).numpy(), vertices.numpy(),
        vertex_normals.numpy(), surface.sample, surface.patch, surface.order, surface.groups,
        vertices.numpy().dtype.type(NORMAL_LENGTH), reach, _ASIDE, _TURNED_AWAY,
    )  # fmt: skip
    return Matches(*map(torch.from_numpy, found))


def gather(
    found: Matches,
    trust: Tensor,
    expected: Tensor,
    num_samples: int,
    *,
    huber: float,
) -> tuple[Tensor, Tensor]:
    """Mean distance (N,) and number of effective points (N,) of each sample, in one frame.

    trust (M,) of each point; ``expected`` (N,) the covering's thickness at each sample: points away
    from it by more than ``huber`` metres pull less (iterated once, by Huber's weight).
    """
    away = (found.distance - expected[found.sample]).abs()
    weight = trust * found.valid * (huber / away.clamp_min(huber))
    total = torch.zeros(num_samples, dtype=trust.dtype, device=trust.device)
    total = total.index_add(0, found.sample, weight)
    summed = torch.zeros_like(total).index_add(0, found.sample, weight * found.distance)
    return summed / total.clamp_min(1e-6), total


class CloudTerm(NamedTuple):
    """cost (B,), gradient (B,n), hessian (B,n,n) by the body; of u (B,G), (B,n,G), (B,G,G)."""

    cost: Tensor
    gradient: Tensor
    hessian: Tensor
    gradient_u: Tensor
    cross: Tensor
    hessian_u: Tensor


def residuals(points: Tensor, rows: CloudRows, thickness: Tensor, group: Tensor) -> Tensor:
    """e (B,N), metres, of sample points (B,N,3); thickness (G,), group (N,).

    Positive: the measured surface lies farther out than skin and covering.
    """
    return rows.target - (rows.normal * points).sum(2) - thickness[group]


def cost(points: Tensor, rows: CloudRows, thickness: Tensor, group: Tensor) -> Tensor:
    """sum over samples of weight e^2 / 2: (B,)."""
    e = residuals(points, rows, thickness, group)
    return 0.5 * (rows.weight * e * e).sum(1)


def assemble(
    points: Tensor, by: Tensor, rows: CloudRows, thickness: Tensor, group: Tensor
) -> CloudTerm:
    """Normal equations of the term.

    points (B,N,3); ``by`` (B,N,n): n . d v / d parameters; thickness (G,) = c0 exp(u), whose
    derivative by u is itself.
    """
    e = residuals(points, rows, thickness, group)
    weight = rows.weight
    weighted = by * weight[..., None]
    pick = torch.zeros(len(group), len(thickness), dtype=by.dtype, device=by.device)
    pick[torch.arange(len(group)), group] = thickness[group]
    # de/d theta = -by, de/du = -pick
    gradient = -(weighted * e[..., None]).sum(1)
    hessian_u = torch.einsum("bn,ng,nh->bgh", weight, pick, pick)
    return CloudTerm(
        0.5 * (weight * e * e).sum(1),
        gradient,
        weighted.transpose(1, 2) @ by,
        -(weight * e) @ pick,
        weighted.transpose(1, 2) @ pick,
        hessian_u,
    )


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Area-weighted unit normals (B,V,3) of (B,V,3), (F,3)."""
    a, b, c = (vertices[:, faces[:, i]] for i in range(3))
    cross = torch.linalg.cross(b - a, c - a)
    normals = torch.zeros_like(vertices)
    for i in range(3):
        normals.index_add_(1, faces[:, i], cross)
    return torch.nn.functional.normalize(normals, dim=2)
