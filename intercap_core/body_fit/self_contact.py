"""Search for parts of the body that penetrate each other, for E_P_self (equation 5).

A sample of the skin penetrates another part if it lies behind the nearest surface of that part.
Parts are the trunk, the head, the segments of the limbs, the palms and the fingers. At a joint the
skin of two parts touches in every pose. Two samples are therefore compared only if their geodesic
distance on the template exceeds a multiple of the thickness of their parts.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import JOINT_NAMES
from intercap_core.body.model import BodyModel
from intercap_core.body_fit.surface import BODY_LENGTH_M, Samples
from intercap_core.body_fit.term_inputs import Pairs
from intercap_core.geometry.rigid.surface_tree import SurfaceTree
from intercap_core.geometry.rigid.surfaces import vertex_normals

# A sample less than this outside of another part also becomes a pair, metres, since it may
# penetrate the part before the next search. Tuned on the studio.
_MARGIN_M = 0.004

_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar")
_HAND_PARTS = ("wrist", "thumb", "index", "middle", "ring", "pinky")
_HEAD = ("neck", "head", "jaw", "left_eye_smplhf", "right_eye_smplhf")
_HINGES = ("shoulder elbow", "elbow wrist", "wrist thumb", "hip knee", "knee ankle")


def _part(joint: str) -> str:
    """Return the part that a joint's skin belongs to: trunk, head, or named by a joint."""
    if joint in _TRUNK:
        return "trunk"
    if joint in _HEAD:
        return "head"
    if joint.endswith("_foot"):
        return joint.replace("foot", "ankle")
    return joint[:-1] if joint[-1] in "123" else joint


_PART_NAMES = tuple(dict.fromkeys(_part(joint) for joint in JOINT_NAMES))
_PART_OF_JOINT = np.array([_PART_NAMES.index(_part(joint)) for joint in JOINT_NAMES])
# 0 left hand, 1 right hand, -1 no hand
_HAND_OF_PART = np.array(
    [
        -1 if not name.endswith(_HAND_PARTS) else int(name.startswith("right"))
        for name in _PART_NAMES
    ]
)


def _hinged() -> np.ndarray:
    """Flag the pairs of parts (parts, parts) that a hinge of a limb joins."""
    table = np.zeros((len(_PART_NAMES), len(_PART_NAMES)), bool)
    for hinge in _HINGES:
        for side in ("left", "right"):
            a, b = (_PART_NAMES.index(f"{side}_{name}") for name in hinge.split())
            table[a, b] = table[b, a] = True
    return table


# --- which samples may touch -----------------------------------------------------------------


class SelfContact(NamedTuple):
    """Which of the N samples of a body may touch each other, and their depth limits."""

    vertex: np.ndarray
    """(N,) index of each sample among the posed vertices, see :class:`.surface.SkinSurface`."""
    patch: np.ndarray
    """(N, 20) indices of the vertices of each sample's patch among the posed vertices."""
    part: np.ndarray
    """(N,) part of each sample."""
    patch_part: np.ndarray
    """(N, 20) parts of the vertices of the patch."""
    hand: np.ndarray
    """(N,) 0 left hand, 1 right hand, -1 none."""
    apart: np.ndarray
    """(N, N) bool: the two samples are compared; others may touch in every pose."""
    deepest: np.ndarray
    """(N,) greatest depth behind a sample's surface at which a point counts as inside, metres."""
    sideways: np.ndarray
    """(N,) greatest distance of such a point from the line through the vertex along its normal,
    metres."""

    @classmethod
    def of(cls, model: BodyModel, samples: Samples) -> SelfContact:
        """Compute from the template, once for a body file."""
        template = model.template.double().numpy()
        faces = model.faces.numpy()
        part = _PART_OF_JOINT[model.skinning_weights.argmax(1).numpy()]
        normals = vertex_normals(template, faces)[samples.vertex]
        start = template[samples.vertex] - 1e-3 * normals
        surface = SurfaceTree(template, faces).shaped(template)
        # thickness of the body at each vertex along its normal, metres
        thickness = BODY_LENGTH_M * surface.first_hit(start, start - BODY_LENGTH_M * normals)
        own = part[samples.vertex]
        # Smallest geodesic distance of samples that are compared, over the mean thickness of their
        # parts. It is larger at a hinge, where flesh touches when it closes. Tuned on the studio.
        factor = np.where(_hinged()[own[:, None], own], 3.2, 1.6)
        joined = factor * (thickness[:, None] + thickness) / 2
        joined[own[:, None] == own] = 0  # parts do not collide with themselves
        apart = _geodesic_distances(template, faces, part, samples.vertex, joined) > joined
        apart &= own[:, None] != own
        around = np.linalg.norm(template[samples.patch] - template[samples.vertex, None], axis=2)
        # distance of the sixth neighbour; a vertex has six on average (Euler's formula)
        spacing = np.sort(around, 1)[:, 6]
        dtype = model.template.numpy().dtype
        return cls(
            vertex=samples.vertex,
            patch=samples.patch,
            part=own,
            patch_part=part[samples.patch],
            hand=_HAND_OF_PART[own],
            apart=apart,
            # beyond half of the thickness the far side is nearer (geometry); the limit of 0.06 m,
            # for the trunk, is tuned on the studio
            deepest=np.minimum(0.5 * thickness, 0.06).astype(dtype),
            sideways=spacing.astype(dtype),
        )


def _geodesic_distances(
    points: np.ndarray, faces: np.ndarray, part: np.ndarray, vertex: np.ndarray, limit: np.ndarray
) -> np.ndarray:
    """Return geodesic distances (N, N) between the N samples, metres.

    They are shortest paths in a graph of the samples. Each vertex of the mesh belongs to the
    nearest sample on its part of the body. Two samples are neighbours if an edge of the mesh
    connects their vertices. Distances above ``limit`` are not exact, but they exceed it.

    Args:
        points: (V, 3) template, metres.
        faces: (F, 3)
        part: (V,) part of each vertex.
        vertex: (N,) vertex ids of the samples.
        limit: (N, N) metres.
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
    # A path is at least as long as the straight line. Dijkstra's search from a sample may therefore
    # stop at its largest limit to samples whose straight distance is within their limit.
    straight = scipy.spatial.distance.cdist(points[vertex], points[vertex])
    farthest = np.where(straight <= limit, limit, 0).max(1)
    distances = np.full((count, count), np.inf)
    for some in np.array_split(np.argsort(farthest, kind="stable"), 12):
        distances[some] = scipy.sparse.csgraph.dijkstra(
            graph, directed=False, indices=some, limit=farthest[some].max()
        )
    return distances


# --- search ----------------------------------------------------------------------------------

Contacts = tuple[Tensor, Tensor, Tensor]
"""Vertices p (M,) of penetrating samples, vertices q (M,) of surfaces, and normals (M, 3) at q."""


def no_contacts(like: Tensor) -> Contacts:
    """Return the contacts of a body that has none; normals have the floating type of ``like``."""
    none = torch.zeros(0, dtype=torch.long)
    return none, none, like.new_zeros(0, 3)


def join_frames(contacts: list[Contacts]) -> Pairs | None:
    """Join the contacts of all frames, one element for each frame; None if there are none."""
    counts = torch.tensor([len(inner) for inner, _, _ in contacts])
    if not int(counts.sum()):
        return None
    inner, outer, normal = (torch.cat(parts) for parts in zip(*contacts, strict=True))
    vertices, place = torch.cat([inner, outer]).unique(return_inverse=True)
    frame = torch.arange(len(contacts)).repeat_interleave(counts)
    return Pairs(frame, place[: len(inner)], place[len(inner) :], normal, vertices)


def find_contacts(contact: SelfContact, vertices: Tensor, normals: Tensor) -> Contacts:
    """Find the samples of one body inside another part, or less than 4 mm outside of it.

    A sample of a hand can have two pairs, one with another part of the same hand and one with the
    rest of the body. They are searched separately, since the next finger is always closest.

    Args:
        contact: the samples.
        vertices: (R, 3) posed vertices, metres.
        normals: (R, 3) unit normals.

    Returns:
        Indices of the vertices p and q, and normals at q.
    """
    parts = len(_PART_NAMES)
    indices = _find(parts, vertices.numpy(), normals.numpy(), contact)
    inner, outer = (torch.as_tensor(index) for index in indices)
    return inner, outer, normals[outer]


@numba.njit(cache=True, nogil=True)
def _find(parts, vertices, normals, contact):
    """Return the vertices p (K,) of penetrating samples and the vertices q (K,) of the surfaces.

    1. For each sample, the nearest sample of another part is searched among those with ``apart``.
       All samples of a part are visited, unless the bounding box of the part is farther than the
       best sample so far. Samples outside of the boxes of all other parts are skipped.
    2. q is the vertex nearest to p in the patch of that sample.
    3. The pair is kept if p is behind q's surface within the limits of depth and sideways distance,
       or less than the margin in front of it.

    parts: number of parts; vertices, normals (R,3): one posed body.
    """
    samples, patch, part, patch_part, hand, apart, deepest, sideways = contact
    count, kind = len(samples), vertices.dtype
    order = np.argsort(part, kind="mergesort")  # by part; this sort is stable
    starts = np.searchsorted(part[order], np.arange(parts + 1))
    where = np.empty((count, 3), kind)  # in that order
    low, high = np.full((parts, 3), np.inf, kind), np.full((parts, 3), -np.inf, kind)
    for at in range(count):
        i = order[at]
        for d in range(3):
            x = vertices[samples[i], d]
            where[at, d] = x
            low[part[i], d] = min(low[part[i], d], x)
            high[part[i], d] = max(high[part[i], d], x)
    nearest = np.full((2, count), -1)  # sample of another part; row 1: of the same hand, row 0: not
    for i in range(count):
        here = vertices[samples[i]]
        if not _in_a_box(here, part[i], low, high):
            continue
        least = np.full(2, np.inf)
        for p in range(parts):
            first, last = starts[p], starts[p + 1]
            if p == part[i] or first == last:
                continue
            same_hand = int(hand[i] >= 0 and hand[order[first]] == hand[i])
            if _to_box(here, low[p], high[p]) >= least[same_hand]:
                continue
            for at in range(first, last):
                x, y, z = where[at, 0] - here[0], where[at, 1] - here[1], where[at, 2] - here[2]
                square = x * x + y * y + z * z
                if square < least[same_hand] and apart[i, order[at]]:
                    least[same_hand], nearest[same_hand, i] = square, order[at]
    inner, outer = np.empty(2 * count, np.int64), np.empty(2 * count, np.int64)
    pairs = 0
    for same_hand in range(2):
        for i in range(count):
            j = nearest[same_hand, i]
            if j < 0:
                continue
            # the vertex of the other part that is nearest to the sample
            v, at = samples[i], -1
            least_gap = vertices[0, 0] * 0 + np.inf
            for k in range(patch.shape[1]):
                if patch_part[j, k] == part[j]:
                    w = patch[j, k]
                    x = vertices[v, 0] - vertices[w, 0]
                    y = vertices[v, 1] - vertices[w, 1]
                    z = vertices[v, 2] - vertices[w, 2]
                    square = x * x + y * y + z * z
                    if square < least_gap:
                        least_gap, at, gx, gy, gz = square, w, x, y, z
            if at < 0:
                continue
            nx, ny, nz = normals[at, 0], normals[at, 1], normals[at, 2]
            height = nx * gx + ny * gy + nz * gz
            sx, sy, sz = gx - height * nx, gy - height * ny, gz - height * nz
            if not (-deepest[j] < height < _MARGIN_M):
                continue
            if not np.sqrt(sx * sx + sy * sy + sz * sz) < sideways[j]:
                continue
            # the normals of two fingers agree near the place where they join: no collision
            if same_hand and (normals[v, 0] * nx + normals[v, 1] * ny + normals[v, 2] * nz >= 0):
                continue
            inner[pairs], outer[pairs] = v, at
            pairs += 1
    return inner[:pairs].copy(), outer[:pairs].copy()


@numba.njit(cache=True, nogil=True)
def _in_a_box(here, own, low, high):
    """Return whether a point (3,) is in the box of a part other than ``own``, with the margin."""
    for p in range(len(low)):
        if p != own and (
            here[0] > low[p, 0] - _MARGIN_M and here[0] < high[p, 0] + _MARGIN_M
            and here[1] > low[p, 1] - _MARGIN_M and here[1] < high[p, 1] + _MARGIN_M
            and here[2] > low[p, 2] - _MARGIN_M and here[2] < high[p, 2] + _MARGIN_M
        ):  # fmt: skip
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _to_box(here, low, high):
    """Return the squared distance of a point (3,) from a box, 0 inside."""
    total = here[0] * 0
    for d in range(3):
        gap = max(low[d] - here[d], here[d] - high[d])
        if gap > 0:
            total += gap * gap
    return total
