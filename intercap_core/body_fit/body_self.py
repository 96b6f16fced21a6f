"""Self-penetration of the body, E_P = E_P_self: equation 5, a part of equations 2 and 6.

    E_P_self = sum over samples p inside another part of the body of w rho(d - tolerance) / 2

PROX penalises colliding triangles by the distance fields of Tzionas et al. 2016; here a sample of
the skin that lies behind the surface of another part of the body is pushed out along that surface's
normal, and the surface is pushed the other way. The depth is

    d = -n_q . (p - q),

with q the nearest vertex of another part, n_q the normal there and w the weight of a sample
(``SELF_WEIGHT``), and rho is Geman and McClure's: where the observations
put one part deep inside another, either they are outliers or the body is thinner than its model,
and a repulsion would correct neither. Parts are the trunk, the head, the segments of the limbs, the
palms and the fingers. Where two parts join, skin meets skin in every pose: samples that are near to
each other over the surface, for the thickness of what they lie on, never count as touching.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.jacobian import Linearisation
from intercap_core.body.joints import JOINT_NAMES
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.body_fit.body_constants import (
    DEEPEST_M,
    DEEPEST_THICKNESSES,
    GEODESIC_ROUNDS,
    JOINED_HINGE_THICKNESSES,
    JOINED_THICKNESSES,
    SELF_REACH_M,
    SELF_TOLERANCE_M,
    SELF_WEIGHT,
    SPACING_RANK,
    WATCHED_M,
)
from intercap_core.body_fit.body_samples import Samples
from intercap_core.geometry.solve.robust import geman_mcclure

_FAR = 1e6

_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar")
_HAND_PARTS = ("wrist", "thumb", "index", "middle", "ring", "pinky")
_HEAD = ("neck", "head", "jaw", "left_eye_smplhf", "right_eye_smplhf")


def _part(joint: str) -> str:
    if joint in _TRUNK:
        return "trunk"
    if joint in _HEAD:
        return "head"
    if joint.endswith("_foot"):
        return joint.replace("foot", "ankle")
    return joint[:-1] if joint[-1] in "123" else joint


_PART_NAMES = tuple(dict.fromkeys(_part(joint) for joint in JOINT_NAMES))
_PART_OF_JOINT = np.array([_PART_NAMES.index(_part(joint)) for joint in JOINT_NAMES])
_HINGES = ("shoulder elbow", "elbow wrist", "wrist thumb", "hip knee", "knee ankle")

_HAND_OF_PART = np.array(
    [
        -1 if not name.endswith(_HAND_PARTS) else int(name.startswith("right"))
        for name in _PART_NAMES
    ]
)


def _hinged() -> np.ndarray:
    """(parts, parts) bool: next to each other along a limb."""
    table = np.zeros((len(_PART_NAMES), len(_PART_NAMES)), bool)
    for hinge in _HINGES:
        for side in ("left", "right"):
            a, b = (_PART_NAMES.index(f"{side}_{name}") for name in hinge.split())
            table[a, b] = table[b, a] = True
    return table


_HINGED = _hinged()


@dataclass(frozen=True)
class SelfContact:
    """Which samples of a body may touch each other, for the N samples of the cloud term.

    vertex (N,) and patch (N,20) as in :class:`Samples`; part (N,) of each sample and patch_part
    (N,20) of the vertices around it; hand (N,): 0 left, 1 right, -1 none; apart (N,N) bool: the two
    may touch; deepest and sideways (N,), metres: how far behind and beside the surface there a
    point can be and still be inside by it.
    """

    vertex: Tensor
    patch: Tensor
    part: Tensor
    patch_part: Tensor
    hand: Tensor
    apart: Tensor
    deepest: Tensor
    sideways: Tensor

    @classmethod
    def of(cls, model: BodyModel, samples: Samples) -> SelfContact:
        """Found on the template, once for a body file."""
        template = model.template.double().cpu().numpy()
        faces = model.faces.cpu().numpy()
        part = _PART_OF_JOINT[model.skinning_weights.argmax(1).cpu().numpy()]
        thickness = _thickness(template, faces, samples.vertex)
        own = part[samples.vertex]
        factor = np.where(_HINGED[own[:, None], own], JOINED_HINGE_THICKNESSES, JOINED_THICKNESSES)
        joined = factor * (thickness[:, None] + thickness) / 2
        joined[own[:, None] == own] = 0  # parts do not collide with themselves
        apart = _over_the_surface(template, faces, part, samples.vertex, joined) > joined
        apart &= own[:, None] != own
        around = np.linalg.norm(template[samples.patch] - template[samples.vertex, None], axis=2)
        spacing = np.sort(around, 1)[:, SPACING_RANK]

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, device=model.device)

        return cls(
            tensor(samples.vertex),
            tensor(samples.patch),
            tensor(own),
            tensor(part[samples.patch]),
            tensor(_HAND_OF_PART[own]),
            tensor(apart),
            tensor(np.minimum(DEEPEST_THICKNESSES * thickness, DEEPEST_M)).to(model.dtype),
            tensor(spacing).to(model.dtype),
        )


class Pairs(NamedTuple):
    """M samples that are inside another part, or nearly, until pairs are found anew.

    frame (M,); inner, outer (M,): places in ``vertices`` (U,) of the sample and of the vertex whose
    surface it is behind; normal (M,3) of that surface, outward, master frame.
    """

    frame: Tensor
    inner: Tensor
    outer: Tensor
    normal: Tensor
    vertices: Tensor

    def of_frames(self, index: Tensor) -> tuple[Pairs, Tensor] | None:
        """The pairs of the frames ``index`` (b,), counted by place in it, and which of the b have
        any (F,); ``frame`` then counts those. None = no pair."""
        place = self.frame.new_full((int(max(self.frame.max(), index.max())) + 1,), -1)
        place[index] = torch.arange(len(index), device=index.device)
        at = place[self.frame]
        kept = at >= 0
        if not bool(kept.any()):
            return None
        present, frame = at[kept].unique(return_inverse=True)
        inner, outer, normal = self.inner[kept], self.outer[kept], self.normal[kept]
        return Pairs(frame, inner, outer, normal, self.vertices), present


def join(found: list[tuple[Tensor, Tensor, Tensor]]) -> Pairs | None:
    """What :func:`find` gives in each frame, in order; None where nothing is near another part."""
    counts = torch.tensor([len(inner) for inner, _, _ in found])
    if not int(counts.sum()):
        return None
    inner, outer, normal = (torch.cat(parts) for parts in zip(*found, strict=True))
    vertices, place = torch.cat([inner, outer]).unique(return_inverse=True)
    frame = torch.arange(len(found)).repeat_interleave(counts).to(inner.device)
    return Pairs(frame, place[: len(inner)], place[len(inner) :], normal, vertices)


def find(contact: SelfContact, vertices: Tensor, normals: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Samples of one body that are inside another part: vertex ids (M,) of sample and surface, and
    the surface's normal (M,3).

    vertices (V,3) metres, unit normals (V,3). Samples up to ``WATCHED_M`` outside are found too.
    Fingers of one hand are searched separately: the next finger is nearer than what a hand
    penetrates.
    """
    if vertices.device.type == "cpu":
        return find_compiled(contact, vertices, normals)
    return find_plain(contact, vertices, normals)


def find_compiled(
    contact: SelfContact, vertices: Tensor, normals: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`find` by the compiled kernel, on the CPU."""
    from intercap_core.body_fit import body_match_kernel

    given = (getattr(contact, field.name).numpy() for field in fields(contact))
    found = body_match_kernel.find(
        len(_PART_NAMES), WATCHED_M, vertices.numpy(), normals.numpy(), *given
    )
    inner, outer = map(torch.from_numpy, found)
    return inner, outer, normals[outer]


def find_plain(
    contact: SelfContact, vertices: Tensor, normals: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """:func:`find` on any device."""
    where = vertices[contact.vertex]
    near = _near_other_parts(contact, where)
    distance = torch.cdist(where[near], where)
    same_hand = contact.hand[near, None] == contact.hand
    same_hand &= contact.hand >= 0
    found = []
    for looked_at in (contact.apart[near] & ~same_hand, contact.apart[near] & same_hand):
        nearest_distance, nearest = torch.where(looked_at, distance, _FAR).min(1)
        some = nearest_distance < _FAR
        found.append(_behind(contact, near[some], nearest[some], vertices, normals))
    # normals agree where two fingers join: no collision
    facing = (normals[found[1][0]] * normals[found[1][1]]).sum(1) < 0
    found[1] = (found[1][0][facing], found[1][1][facing])
    inner, outer = (torch.cat(part) for part in zip(*found, strict=True))
    return inner, outer, normals[outer]


def _behind(
    contact: SelfContact, sample: Tensor, nearest: Tensor, vertices: Tensor, normals: Tensor
) -> tuple[Tensor, Tensor]:
    """Which of the samples (M,) are behind the surface around the nearest sample (M,) of another
    part: vertex ids of the sample and of the vertex that it is behind."""
    patch = contact.patch[nearest]
    gap = vertices[contact.vertex[sample], None] - vertices[patch]
    square = (gap * gap).sum(2)
    square = square + _FAR * (contact.patch_part[nearest] != contact.part[nearest, None])
    best = square.argmin(1, keepdim=True)
    outer = patch.gather(1, best)[:, 0]
    gap = gap.gather(1, best[..., None].expand(-1, 1, 3))[:, 0]
    normal = normals[outer]
    height = (gap * normal).sum(1)
    beside = (gap - height[:, None] * normal).norm(dim=1)
    inside = (height < WATCHED_M) & (height > -contact.deepest[nearest])
    inside &= beside < contact.sideways[nearest]
    return contact.vertex[sample[inside]], outer[inside]


def _near_other_parts(contact: SelfContact, where: Tensor) -> Tensor:
    """Samples (M,) that lie in the box around another part, where the two may touch at all."""
    count = len(_PART_NAMES)
    index = contact.part[:, None].expand(-1, 3)
    low = where.new_full((count, 3), _FAR).scatter_reduce(0, index, where, "amin")
    high = where.new_full((count, 3), -_FAR).scatter_reduce(0, index, where, "amax")
    inside = (where[:, None] > low - WATCHED_M) & (where[:, None] < high + WATCHED_M)
    inside = inside.all(2)
    inside[torch.arange(len(where)), contact.part] = False
    return inside.any(1).nonzero()[:, 0]


def cost(model: BodyModel, params: BodyParameters, pairs: Pairs, index: Tensor) -> Tensor:
    """(b,) of the frames ``index`` (b,), whose bodies are ``params``; 0 where nothing touches."""
    total = torch.zeros(len(index), dtype=model.dtype, device=model.device)
    here = pairs.of_frames(index)
    if here is None:
        return total
    chosen, present = here
    points = model.forward(params.frames(present), vertex_ids=pairs.vertices).vertices
    robust = geman_mcclure(_residuals(points, chosen) ** 2, SELF_REACH_M)
    return total.index_add(0, present[chosen.frame], 0.5 * SELF_WEIGHT * robust.rho)


class SelfTerm(NamedTuple):
    """present (F,): places of the frames in which parts touch; of those, cost (F,), gradient (F,n),
    hessian (F,n,n)."""

    present: Tensor
    cost: Tensor
    gradient: Tensor
    hessian: Tensor


def assemble(
    model: BodyModel, params: BodyParameters, pairs: Pairs, index: Tensor, columns: Tensor
) -> SelfTerm | None:
    """Normal equations by the parameters ``columns`` (n,) of the frames ``index`` (b,).

    The gradient knows pose blend shapes, the Gauss-Newton matrix does not."""
    here = pairs.of_frames(index)
    if here is None:
        return None
    chosen, present = here
    linear = model.linearise(params.frames(present), vertex_ids=pairs.vertices)
    residual = _residuals(linear.points, chosen)
    active = residual > 0
    if not bool(active.any()):
        return None
    frame, residual = chosen.frame[active], residual[active]
    # d residual / d parameters = -n . (dp - dq)
    inner, outer, normal = chosen.inner[active], chosen.outer[active], chosen.normal[active]

    def rows_of(linear: Linearisation) -> Tensor:
        by_point = linear.full()[..., columns]
        return -(normal[:, None] @ (by_point[frame, inner] - by_point[frame, outer]))[:, 0]

    rows, rigid_rows = rows_of(linear), rows_of(linear.with_correctives_of(None))
    robust = geman_mcclure(residual**2, SELF_REACH_M)
    weight = SELF_WEIGHT * robust.weight
    count, size = len(present), len(columns)
    total = rows.new_zeros(count).index_add(0, frame, 0.5 * SELF_WEIGHT * robust.rho)
    gradients = (weight * residual)[:, None] * rows
    gradient = rows.new_zeros(count, size).index_add(0, frame, gradients)
    hessian = rows.new_zeros(count, size, size)
    for f in frame.unique().tolist():
        own = frame == f
        hessian[f] = rigid_rows[own].T @ (weight[own, None] * rigid_rows[own])
    return SelfTerm(present, total, gradient, hessian)


def _residuals(points: Tensor, pairs: Pairs) -> Tensor:
    """Depth (M,) beyond the tolerance, metres, of points (F,U,3); 0 = outside."""
    gap = points[pairs.frame, pairs.inner] - points[pairs.frame, pairs.outer]
    return (-(pairs.normal * gap).sum(1) - SELF_TOLERANCE_M).clamp_min(0)


def _thickness(points: np.ndarray, faces: np.ndarray, vertex: np.ndarray) -> np.ndarray:
    """Thickness (N,) of the body at each vertex, along its normal, metres."""
    from intercap_core.body_fit.first_hit import first_hits
    from intercap_core.geometry.rigid.surfaces import vertex_normals

    normals = vertex_normals(points, faces)[vertex]
    return first_hits(points, faces, points[vertex] - 1e-3 * normals, -normals)


def _over_the_surface(
    points: np.ndarray, faces: np.ndarray, part: np.ndarray, vertex: np.ndarray, limit: np.ndarray
) -> np.ndarray:
    """Distances (N,N) between vertices over the surface, metres, right up to ``limit`` (N,N) and
    else larger than it.

    Along a graph of the N vertices: two are neighbours where an edge of the mesh leads from what is
    nearest to one, on its part (V,) of the body, to what is nearest to the other.
    """
    import scipy.sparse.csgraph
    import scipy.spatial.distance

    nearest = np.full(len(points), -1)
    for p in np.unique(part[vertex]):
        here, own = np.flatnonzero(part == p), np.flatnonzero(part[vertex] == p)
        nearest[here] = own[scipy.spatial.cKDTree(points[vertex[own]]).query(points[here])[1]]
    edges = nearest[faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)]
    edges = np.unique(edges[(edges[:, 0] != edges[:, 1]) & (edges >= 0).all(1)], axis=0)
    length = np.linalg.norm(points[vertex[edges[:, 0]]] - points[vertex[edges[:, 1]]], axis=1)
    count = len(vertex)
    graph = scipy.sparse.csr_matrix((length, (edges[:, 0], edges[:, 1])), shape=(count, count))
    # the geodesic distance is no shorter than the Euclidean one
    straight = scipy.spatial.distance.cdist(points[vertex], points[vertex])
    farthest = np.where(straight <= limit, limit, 0).max(1)
    found = np.full((count, count), np.inf)
    for some in np.array_split(np.argsort(farthest, kind="stable"), GEODESIC_ROUNDS):
        found[some] = scipy.sparse.csgraph.dijkstra(
            graph, directed=False, indices=some, limit=farthest[some].max()
        )
    return found
