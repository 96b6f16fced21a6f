"""Cloud term of the body's energy, E_D: equation 4, a part of equation 2.

    E_D = sum over views v, points p of the person's cloud in v of min over visible vertices |v - p|

Here the distance is taken along the surface's normal, to the vertex that is nearest in position and
in orientation; a vertex can only be met by points whose surface faces the same way, which leaves
the vertices that the point's camera sees. Beyond the paper: the measured surface is clothing and
hair, not skin,

    e = n . (p - v) - c_g,      c_g = c0_g exp(u_g),   u_g ~ N(0, spread^2)

with n the surface's normal at v and one thickness c_g > 0 for each kind of covering g (trunk, upper
arms, thighs, head, ...), shared by all frames. c0_g are everyday garments; hands and face are bare.

The way back, from vertices that a camera should see to what it measured, is in
:mod:`intercap_core.body_fit.free_space`.

Points are gathered on a fixed sparse set of vertices, the samples: the solver sees one row for each
sample and frame, the mean distance of the points around it. Errors of neighbouring points are the
same fold of cloth, so a sample counts as one measurement however many points it has.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from intercap_core.body_fit.body_constants import MATCH_COSINE, MATCH_SIDEWAYS_M, NORMAL_LENGTH_M
from intercap_core.body_fit.body_surface import Surface


class CloudRows(NamedTuple):
    """The points by sample (B,N): the solver's rows until the next matching.

    target (B,N): n . v of the mean of the matched points, metres; normal (B,N,3); weight (B,N)
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
    ours = torch.cat([v - centre, NORMAL_LENGTH_M * n], 1)
    theirs = torch.cat([points - centre, NORMAL_LENGTH_M * normals], 1)
    sample = torch.addmm((ours * ours).sum(1), theirs, ours.T, alpha=-2).argmin(1)
    near = patch[sample]
    gap = points[:, None] - vertices[near]
    best = (gap * gap).sum(2).argmin(1, keepdim=True)
    at = near.gather(1, best)[:, 0]
    gap = gap.gather(1, best[..., None].expand(-1, 1, 3))[:, 0]
    normal = vertex_normals[at]
    distance = (normal * gap).sum(1)
    sideways = (gap - distance[:, None] * normal).norm(dim=1)
    valid = ((normal * normals).sum(1) > MATCH_COSINE) & (distance.abs() < reach)
    return Matches(sample, distance, valid & (sideways < MATCH_SIDEWAYS_M))


def match_compiled(
    points: Tensor,
    normals: Tensor,
    vertices: Tensor,
    vertex_normals: Tensor,
    surface: Surface,
    reach: float,
) -> Matches:
    """The same by the compiled kernel, on the CPU; vertices and normals (R,3) of the surface."""
    from intercap_core.body_fit import body_match_kernel

    kind = vertices.dtype
    found = body_match_kernel.match(
        points.to(kind).numpy(), normals.to(kind).numpy(), vertices.numpy(),
        vertex_normals.numpy(), surface.sample, surface.patch, surface.order, surface.groups,
        vertices.numpy().dtype.type(NORMAL_LENGTH_M), reach, MATCH_SIDEWAYS_M, MATCH_COSINE,
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

    trust (M,) of each point; ``expected`` (N,) the covering's thickness at each sample: points that
    differ from it by more than ``huber`` metres count less (one iteration of Huber's weight).
    """
    excess = (found.distance - expected[found.sample]).abs()
    weight = trust * found.valid * (huber / excess.clamp_min(huber))
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
    points: Tensor,
    by: Tensor,
    by_of_own_limb: Tensor,
    rows: CloudRows,
    thickness: Tensor,
    group: Tensor,
) -> CloudTerm:
    """Normal equations of the term.

    points (B,N,3); ``by`` (B,N,n): n . d v / d parameters, for the gradient, and the same with pose
    blend shapes by the joints of a point's own limb alone, for the Gauss-Newton matrix; thickness
    (G,) = c0 exp(u), whose derivative by u is itself.
    """
    e = residuals(points, rows, thickness, group)
    weight = rows.weight
    weighted = by_of_own_limb * weight[..., None]
    pick = torch.zeros(len(group), len(thickness), dtype=by.dtype, device=by.device)
    pick[torch.arange(len(group)), group] = thickness[group]
    # de/d theta = -by, de/du = -pick
    gradient = -(by * (weight * e)[..., None]).sum(1)
    hessian_u = torch.einsum("bn,ng,nh->bgh", weight, pick, pick)
    return CloudTerm(
        0.5 * (weight * e * e).sum(1),
        gradient,
        weighted.transpose(1, 2) @ by_of_own_limb,
        -(weight * e) @ pick,
        weighted.transpose(1, 2) @ pick,
        hessian_u,
    )
