"""Correspondences of E_D: assign the measurements of a frame to the samples of the skin, by camera.

There are three kinds of measurements, each a signed distance at a sample:
- depth points of the person, matched to the surface here;
- samples in front of a surface that a camera measured farther away (:mod:`.free_space`);
- rims of the person's masks, whose rays touch the surface (:mod:`.outlines`).
The distances at each sample and camera are averaged. :class:`.evidence.Evidence` then averages over
the cameras, which gives one residual of :mod:`.cloud_term` for each sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from intercap_core.body_fit.clouds import PersonCloud
from intercap_core.body_fit.free_space import find_protruding
from intercap_core.body_fit.outlines import RimSamples, find_touched
from intercap_core.body_fit.surface import MATCH_SIDEWAYS_M, NORMAL_LENGTH_M, Samples, SkinSurface
from intercap_core.geometry.camera.rig import Rig

# Smallest cosine between the normals of a point and of its vertex. Tuned on the studio.
MATCH_COSINE = 0.3
# A covering is what lies over the skin, clothing or hair (:mod:`.cloud_term`). A point farther than
# this from its outer surface loses weight, metres. Tuned on the studio.
CLOUD_HUBER_M = 0.012


class Matches(NamedTuple):
    """M distances of measured points from samples."""

    sample: Tensor
    """(M,) index of the sample."""
    distance: Tensor
    """(M,) signed distance from the surface, outside positive, metres."""
    valid: Tensor
    """(M,) bool: the match counts."""


def match_points(
    points: Tensor,
    normals: Tensor,
    vertices: Tensor,
    vertex_normals: Tensor,
    surface: SkinSurface,
    reach: float,
) -> Matches:
    """Match each point to the sample that is nearest in position and normal.

    The distance to be minimised is |p - v|^2 + L^2 |n_p - n_v|^2 with L = `NORMAL_LENGTH_M`. The
    signed distance is then measured from the vertex of the sample's patch that is nearest in
    position. Normals must agree, so a point matches only a surface that faces its camera.

    Args:
        points: (M, 3) measured points, metres.
        normals: (M, 3) unit normals.
        vertices: (R, 3) of the posed surface, metres.
        vertex_normals: (R, 3)
        surface: samples and patches.
        reach: largest valid distance along the normal, metres.
    """

    def array(values: Tensor) -> np.ndarray:
        return values.to(vertices.dtype).numpy()

    arrays = _match(
        array(points), array(normals), array(vertices), array(vertex_normals), surface.sample,
        surface.patch, surface.order, surface.groups, reach,
    )  # fmt: skip
    return Matches(*(torch.as_tensor(values) for values in arrays))


def average(
    matches: Matches, trust: Tensor, expected: Tensor, *, huber: float
) -> tuple[Tensor, Tensor]:
    """Return the weighted mean distance (N,) at each sample, and the sum of the weights (N,).

    The sum of weights is the effective number of points.

    Args:
        matches: of M points.
        trust: (M,) weight of each point.
        expected: (N,) thickness of the covering at each sample, metres.
        huber: distance from ``expected`` beyond which a point loses weight, metres: one
            iteration of reweighting by Huber's function.
    """
    excess = (matches.distance - expected[matches.sample]).abs()
    weight = trust * matches.valid * (huber / excess.clamp_min(huber))
    total = torch.zeros(len(expected), dtype=trust.dtype)
    total = total.index_add(0, matches.sample, weight)
    summed = torch.zeros_like(total).index_add(0, matches.sample, weight * matches.distance)
    return summed / total.clamp_min(1e-6), total


# --- all measurements of a frame -------------------------------------------------------------


class PosedSkin(NamedTuple):
    """A posed body in the master frame, metres."""

    vertices: Tensor
    """(R, 3) vertices of the surface."""
    normals: Tensor
    """(R, 3) unit normals of samples and patches; 0 at other vertices."""
    samples: Tensor
    """(S, 3) positions of the samples."""
    displacement: Tensor | None
    """(C, S, 3) displacement of the samples until each camera exposes."""


class FrameMatches(NamedTuple):
    """Distances at S samples in C cameras."""

    distance: Tensor
    """(C, S) mean distance, metres."""
    points: Tensor
    """(C, S) effective number of points, 0 = none."""
    residual: Tensor
    """Median absolute distance of the matched depth points, metres; NaN = no match."""
    measured: Tensor
    """(S,) bool: the sample has depth points."""


@dataclass(frozen=True, eq=False)
class Matcher:
    """Matches the measurements of a frame to the S samples of a surface."""

    surface: SkinSurface
    sample: Tensor
    """(S,) index of each sample in the surface."""
    rims: RimSamples
    """Samples that rims of masks can touch."""

    @classmethod
    def of(cls, samples: Samples, surface: SkinSurface) -> Matcher:
        sample = torch.as_tensor(surface.sample)
        return cls(surface, sample, RimSamples.of(samples, surface))

    def match(
        self,
        cloud: PersonCloud,
        rig: Rig,
        depth_bias: np.ndarray,
        skin: PosedSkin,
        expected: Tensor,
        reach: float,
        depth_points_only: bool = False,
    ) -> FrameMatches:
        """Match one frame; returns distances by camera and sample.

        Args:
            cloud: points, depth windows and outlines of the person.
            rig: cameras.
            depth_bias: (C,) excess of the depth that each camera measures, metres.
            skin: the posed body.
            expected: (C * S,) thickness of the covering, by camera and sample, metres.
            reach: largest valid distance, metres.
            depth_points_only: match neither protruding samples nor rims.
        """
        points = self._match_points(cloud, skin, reach)
        # by camera, since samples that several cameras see determine the errors of the cameras
        parts = [(points._replace(sample=self._row(cloud.view, points.sample)), cloud.trust)]
        if not depth_points_only:
            parts.append(self._find_protruding(cloud, rig, depth_bias, skin))
            parts.append(self._find_on_rims(cloud, rig, skin, reach))
        every = Matches(*map(torch.cat, zip(*(matches for matches, _ in parts), strict=True)))
        trust = torch.cat([trust for _, trust in parts])
        distance, number = average(every, trust, expected, huber=CLOUD_HUBER_M)
        measured = torch.zeros_like(self.sample, dtype=torch.bool)
        measured[points.sample[points.valid]] = True
        return FrameMatches(
            distance.reshape(len(rig), -1),
            number.reshape(len(rig), -1),
            points.distance[points.valid].abs().nanmedian(),
            measured,
        )

    def _row(self, view: Tensor | int, sample: Tensor) -> Tensor:
        """Return the index of a camera's sample among the C * S rows."""
        return view * len(self.sample) + sample

    def _match_points(self, cloud: PersonCloud, skin: PosedSkin, reach: float) -> Matches:
        """Match the depth points, by sample."""
        matches = match_points(
            cloud.points, cloud.normals, skin.vertices, skin.normals, self.surface, reach
        )
        if skin.displacement is None:
            return matches
        outward = skin.normals[self.sample[matches.sample]]
        moved = (skin.displacement[cloud.view, matches.sample] * outward).sum(1)
        return matches._replace(distance=matches.distance - moved)

    def _find_protruding(
        self, cloud: PersonCloud, rig: Rig, depth_bias: np.ndarray, skin: PosedSkin
    ) -> tuple[Matches, Tensor]:
        """Match samples in front of a surface measured farther away, and return their trust."""
        outward = skin.normals[self.sample].numpy()
        parts = []
        for window in cloud.windows:
            view, samples = window.view, skin.samples
            if skin.displacement is not None:
                samples = samples + skin.displacement[view]
            index, inside = find_protruding(
                window, rig[view], float(depth_bias[view]), samples.numpy(), outward
            )
            parts.append((view, index, -inside))
        return self._join(parts, skin)

    def _find_on_rims(
        self, cloud: PersonCloud, rig: Rig, skin: PosedSkin, reach: float
    ) -> tuple[Matches, Tensor]:
        """Match samples that the rims of masks touch, and return their trust."""
        vertices, normals = skin.vertices.numpy(), skin.normals.numpy()
        parts = []
        for rim in cloud.outlines:
            moved = None if skin.displacement is None else skin.displacement[rim.view].numpy()
            pose = rig[rim.view].master_from_colour
            index, distance = find_touched(rim, pose, vertices, normals, self.rims, reach, moved)
            parts.append((rim.view, index, distance))
        return self._join(parts, skin)

    def _join(
        self, parts: list[tuple[int, np.ndarray, np.ndarray]], skin: PosedSkin
    ) -> tuple[Matches, Tensor]:
        """Join (camera, samples, distances) of all views to matches with a trust of 1 each."""
        like = skin.samples
        sample, distance = [self.sample[:0]], [like[:0, 0]]
        for view, index, away in parts:
            sample.append(self._row(view, torch.as_tensor(index)))
            distance.append(torch.as_tensor(away, dtype=like.dtype))
        every = torch.cat(sample)
        matches = Matches(every, torch.cat(distance), torch.ones_like(every, dtype=torch.bool))
        return matches, like.new_ones(len(every))


# --- compiled --------------------------------------------------------------------------------


@numba.njit(cache=True, nogil=True)
def _match(points, point_normals, vertices, normals, samples, patch, order, starts, reach):
    """Return sample (M,), signed distance (M,) and validity (M,); see :func:`match_points`.

    Nearest-neighbour search in 6D, of position and scaled normal. Neighbouring samples form groups
    with a bounding sphere. For each point all groups are visited. A group is skipped if its sphere
    is farther than the best sample so far, so the search is exact. The match of the previous point
    is the first candidate.

    points, point_normals (M,3): measured. vertices, normals (R,3): posed surface.
    samples (S,), patch (S,20): indices of vertices. order (S,): samples by group. starts (G + 1,):
    start of each group in the order.
    """
    groups, kind = len(starts) - 1, vertices.dtype
    length = kind.type(NORMAL_LENGTH_M)
    own, centre = np.empty((6, len(order)), kind), np.zeros((6, groups), kind)
    radius, to_group = np.zeros(groups, kind), np.empty(groups, kind)
    longest = 0
    for g in range(groups):
        first, last = starts[g], starts[g + 1]
        longest = max(longest, last - first)
        for at in range(first, last):
            v = samples[order[at]]
            for d in range(3):
                own[d, at] = vertices[v, d]
                own[3 + d, at] = length * normals[v, d]
        for d in range(6):
            centre[d, g] = own[d, first:last].mean()
        for at in range(first, last):
            radius[g] = max(radius[g], _square(own, at, centre[:, g]))
        radius[g] = np.sqrt(radius[g])
    apart, here = np.empty(longest, kind), np.empty(6, kind)
    sample = np.empty(len(points), np.int64)
    distance = np.empty(len(points), kind)
    valid = np.zeros(len(points), np.bool_)
    best = 0  # place in the order
    for m in range(len(points)):
        for d in range(3):
            here[d] = points[m, d]
            here[3 + d] = length * point_normals[m, d]
        least = _square(own, best, here)
        bound = np.sqrt(least)
        _squares(centre, 0, groups, here, to_group)
        for g in range(groups):
            limit = bound + radius[g]
            if to_group[g] >= limit * limit:
                continue
            first = starts[g]
            size = starts[g + 1] - first
            _squares(own, first, size, here, apart)
            for at in range(size):
                if apart[at] < least:
                    least, best = apart[at], first + at
            bound = np.sqrt(least)
        sample[m] = order[best]
        nearest, gx, gy, gz = _nearest_of_patch(points[m], vertices, patch[sample[m]])
        # the gap between vertex and point: ``height`` along the normal, (sx, sy, sz) sideways
        nx, ny, nz = normals[nearest, 0], normals[nearest, 1], normals[nearest, 2]
        height = nx * gx + ny * gy + nz * gz
        distance[m] = height
        sx, sy, sz = gx - height * nx, gy - height * ny, gz - height * nz
        valid[m] = (
            nx * point_normals[m, 0] + ny * point_normals[m, 1] + nz * point_normals[m, 2]
            > MATCH_COSINE
            and abs(height) < reach
            and np.sqrt(sx * sx + sy * sy + sz * sz) < MATCH_SIDEWAYS_M
        )
    return sample, distance, valid


@numba.njit(cache=True, nogil=True)
def _square(values, at, here):
    """Return the squared distance of column ``at`` of (6,N) from ``here`` (6,)."""
    total = here[0] * 0
    for d in range(6):
        gap = values[d, at] - here[d]
        total += gap * gap
    return total


@numba.njit(cache=True, nogil=True)
def _squares(values, first, count, here, out):
    """Write the squared distances of ``count`` columns from ``first`` on to ``out``."""
    h0, h1, h2, h3, h4, h5 = here[0], here[1], here[2], here[3], here[4], here[5]
    last = first + count
    a, b, c = values[0, first:last], values[1, first:last], values[2, first:last]
    d, e, f = values[3, first:last], values[4, first:last], values[5, first:last]
    for at in range(count):
        x, y, z = a[at] - h0, b[at] - h1, c[at] - h2
        p, q, r = d[at] - h3, e[at] - h4, f[at] - h5
        out[at] = x * x + y * y + z * z + p * p + q * q + r * r


@numba.njit(cache=True, nogil=True)
def _nearest_of_patch(point, vertices, patch):
    """Return the vertex of ``patch`` nearest to a point (3,), and the point minus that vertex."""
    px, py, pz = point[0], point[1], point[2]
    best, gx, gy, gz = patch[0], px * 0, px * 0, px * 0
    least = px * 0 + np.inf
    for v in patch:
        x, y, z = px - vertices[v, 0], py - vertices[v, 1], pz - vertices[v, 2]
        square = x * x + y * y + z * z
        if square < least:
            least, best, gx, gy, gz = square, v, x, y, z
    return best, gx, gy, gz
