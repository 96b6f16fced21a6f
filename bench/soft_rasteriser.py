"""Differentiable silhouettes and depths of a mesh in several views at once, for the baseline.

Two rasterisers with one interface: ``SoftRasteriser``, plain torch, after Liu et al., Soft
Rasterizer, ICCV 2019 (sigmoid of the signed squared distance to each triangle, product over
triangles, softmax over depth); and ``OverdrawRasteriser``, the compiled DEODR (BSD 2-clause), which
blends only along the silhouette (de La Gorce et al., PAMI 2011). Both are asked for a list of
pixels only: equation 1 counts no others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch

SIGMA_PX2 = 0.3  # of the sigmoid over squared distance: an edge some 1 px wide, as in the paper
REACH_PX = 2.0  # sigmoid(-4 / 0.3) is nothing
GAMMA_M = 0.005  # of the softmax over depth
OVERDRAW_PX = 1.0  # width of DEODR's blended edge


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels to draw in V tiles."""

    view: np.ndarray
    """(P,) tile."""
    x: np.ndarray
    """(P,) int64 in the tile."""
    y: np.ndarray
    """(P,) int64 in the tile."""
    sizes: np.ndarray
    """(V, 2) width and height."""


class Rasteriser(Protocol):
    """Differentiable drawing of corners (V, N, 2), px in each tile, with depth (V, N), metres.

    Returns coverage (P,) in [0, 1] and depth (P,), metres, of the pixels. Depth is meaningless
    where
    coverage is small.
    """

    def __call__(
        self, corners: torch.Tensor, depth: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]: ...


class SoftRasteriser:
    """Soft Rasterizer in torch over pairs of a pixel and a triangle whose box holds it."""

    def __init__(self, faces: np.ndarray, pixels: Pixels) -> None:
        """``faces`` (F, 3) of the mesh, seen in every view."""
        self._faces = torch.as_tensor(np.asarray(faces, np.int64))
        self._sizes = torch.as_tensor(pixels.sizes)
        width, height = pixels.sizes.max(0)
        self._slot = torch.full((len(pixels.sizes), int(height), int(width)), -1)
        self._count = len(pixels.view)
        at = tuple(torch.as_tensor(v) for v in (pixels.view, pixels.y, pixels.x))
        self._slot[at] = torch.arange(self._count)
        self._place = torch.as_tensor(np.stack([pixels.x, pixels.y], 1))

    def __call__(
        self, corners: torch.Tensor, depth: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See :class:`Rasteriser`."""
        triangle, slot = self._pairs(corners.detach())
        count = len(self._faces)
        view, face = triangle // count, triangle % count
        vertex = self._faces[face] + (view * corners.shape[1])[:, None]  # (K, 3)
        a, b, c = corners.reshape(-1, 2)[vertex].unbind(1)
        at = self._place[slot].to(corners.dtype)
        none = corners.new_zeros(self._count)
        # twice the areas opposite to a, b, c: barycentric coordinates, and inside or not
        areas = torch.stack(
            [_cross(b - at, c - at), _cross(c - at, a - at), _cross(a - at, b - at)]
        )
        whole = areas.sum(0)
        whole = torch.where(whole.abs() < 1e-6, torch.full_like(whole, 1e-6), whole)
        weights = areas / whole
        inside = (weights >= 0).all(0)
        apart = torch.stack([_to_edge(at, a, b), _to_edge(at, b, c), _to_edge(at, c, a)]).amin(0)
        logit = torch.where(inside, apart, -apart) / SIGMA_PX2
        clear = none.index_add(0, slot, -torch.nn.functional.softplus(logit))
        # perspective: 1 / z is linear in the image; outside, the nearest point's as SoftRas does
        weights = weights.clamp(0, 1)
        weights = weights / weights.sum(0)
        inverse = (weights / depth.reshape(-1)[vertex].T).sum(0)
        z = 1 / inverse
        score = torch.nn.functional.logsigmoid(logit) - z / GAMMA_M
        best = torch.full_like(none, -torch.inf)
        best = best.scatter_reduce(0, slot, score.detach(), "amax")
        share = torch.exp(score - best[slot])
        total = none.index_add(0, slot, share)
        mean = none.index_add(0, slot, share * z)
        return 1 - torch.exp(clear), mean / total.clamp(min=1)

    def _pairs(self, corners: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Triangles (K,) = view * F + face and wanted pixels (K,) within their reach."""
        boxes = corners[:, self._faces]  # (V, F, 3, 2)
        first = (boxes.amin(2) - REACH_PX).ceil().clamp(min=0)
        last = torch.minimum((boxes.amax(2) + REACH_PX).floor(), self._sizes[:, None] - 1)
        span = (last - first + 1).clamp(min=0).long().reshape(-1, 2)
        first = first.long().reshape(-1, 2)
        area = span.prod(1)
        triangle = torch.repeat_interleave(torch.arange(len(area)), area)
        within = torch.arange(len(triangle)) - (area.cumsum(0) - area)[triangle]
        width = span[triangle, 0]
        x, y = first[triangle, 0] + within % width, first[triangle, 1] + within // width
        slot = self._slot[triangle // len(self._faces), y, x]
        wanted = slot >= 0
        return triangle[wanted], slot[wanted]


def _cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _to_edge(at: torch.Tensor, start: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
    """Squared distance (K,) of points (K, 2) from segments."""
    along, offset = end - start, at - start
    length = (along * along).sum(1).clamp(min=1e-12)
    part = ((offset * along).sum(1) / length).clamp(0, 1)
    away = offset - part[:, None] * along
    return (away * away).sum(1)


class OverdrawRasteriser:
    """DEODR on one image that holds all tiles one below the other.

    Coverage and depth are drawn as colours; depth is interpolated linearly in the image. The mesh
    must
    be closed, with outward faces.
    """

    def __init__(self, faces: np.ndarray, vertices: int, pixels: Pixels) -> None:
        from deodr.differentiable_renderer import Scene2D

        views = len(pixels.sizes)
        width, height = int(pixels.sizes[:, 0].max()), int(pixels.sizes[:, 1].sum())
        self._top = np.concatenate([[0], np.cumsum(pixels.sizes[:-1, 1])]).astype(np.float64)
        self._limit = pixels.sizes[:, None] - 1.0
        stacked = (faces[None] + np.arange(views)[:, None, None] * vertices).reshape(-1, 3)
        self._edges, self._edge_of_side = _edges(stacked)
        count = views * vertices
        self._faces = stacked
        self._scene = Scene2D(
            faces=stacked.astype(np.uint32),
            faces_uv=np.zeros(stacked.shape, np.uint32),
            ij=np.zeros((count, 2)),
            depths=np.zeros(count),
            textured=np.zeros(len(stacked), bool),
            uv=np.zeros((1, 2)),
            shade=np.zeros(count),
            colors=np.ones((count, 2)),
            shaded=np.zeros(len(stacked), bool),
            edgeflags=np.zeros(stacked.shape, bool),
            height=height,
            width=width,
            nb_colors=2,
            texture=np.zeros((0, 0, 2)),
            background_color=np.zeros(2),
            clockwise=False,
            backface_culling=True,
        )
        self._image = np.zeros((height, width, 2))
        self._buffer = np.zeros((height, width))
        self._wanted = (pixels.y + self._top[pixels.view].astype(np.int64), pixels.x)

    def __call__(
        self, corners: torch.Tensor, depth: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See :class:`Rasteriser`."""
        coverage, weighted = _Overdraw.apply(corners, depth, self)
        return coverage, weighted / coverage.clamp(min=1e-3)

    def draw(self, corners: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coverage (P,) and depth times coverage (P,)."""
        from deodr import differentiable_renderer_cython as compiled

        scene = self._scene
        # a tile's triangles must not reach into the next tile
        inside = np.clip(corners, 0, self._limit)
        inside[..., 1] += self._top[:, None]
        scene.ij = inside.reshape(-1, 2)
        scene.depths = depth.reshape(-1).astype(np.float64)
        scene.colors[:, 1] = scene.depths
        a, b, c = (
            scene.ij[self._faces[:, 0]],
            scene.ij[self._faces[:, 1]],
            scene.ij[self._faces[:, 2]],
        )
        u, v = b - a, c - a
        visible = np.append(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] < 0, False)
        rim = visible[self._edges[:, 0]] != visible[self._edges[:, 1]]
        scene.edgeflags = rim[self._edge_of_side]
        compiled.renderSceneCpp(
            scene, OVERDRAW_PX, self._image, self._buffer, False, None, None, False
        )
        found = self._image[self._wanted]
        return found[:, 0], found[:, 1]

    def pull_back(
        self, coverage: np.ndarray, weighted: np.ndarray, corners: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gradients (V, N, 2), (V, N) by corners and depths from those of the last drawing."""
        from deodr import differentiable_renderer_cython as compiled

        scene = self._scene
        wanted = np.zeros_like(self._image)
        wanted[self._wanted] = np.stack([coverage, weighted], 1)
        scene.clear_gradients()
        compiled.renderSceneBCpp(
            scene, OVERDRAW_PX, self._image, self._buffer, wanted, False, None, None, None, False
        )
        inside = (corners >= 0) & (corners <= self._limit)
        by_corner = scene.ij_b.reshape(corners.shape) * inside
        return by_corner, scene.colors_b[:, 1].reshape(corners.shape[:2])


class _Overdraw(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, corners: torch.Tensor, depth: torch.Tensor, rasteriser: OverdrawRasteriser
    ) -> tuple[torch.Tensor, torch.Tensor]:
        ctx.rasteriser, ctx.corners = rasteriser, corners.detach().numpy()
        found = rasteriser.draw(ctx.corners, depth.detach().numpy())
        coverage, weighted = (torch.from_numpy(values).to(corners.dtype) for values in found)
        return coverage, weighted

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[Any, ...]:
        coverage, weighted = (gradient.numpy() for gradient in gradients)
        found = ctx.rasteriser.pull_back(coverage, weighted, ctx.corners)
        dtype = gradients[0].dtype
        return (*(torch.from_numpy(values).to(dtype) for values in found), None)


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The faces (E, 2) that share an edge, F for none, and the edge (F, 3) of each side.

    Side i of a face runs from its corner i to the next.
    """
    sides = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1), -1).reshape(-1, 2)
    _, edge = np.unique(sides, axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    pairs = np.full((edge.max() + 1, 2), len(faces), np.int64)
    order = np.argsort(edge, kind="stable")
    first = np.searchsorted(edge[order], np.arange(len(pairs)))
    pairs[:, 0] = order[first] // 3
    second = np.minimum(first + 1, len(order) - 1)
    shared = edge[order[second]] == np.arange(len(pairs))
    shared &= second > first
    pairs[shared, 1] = order[second[shared]] // 3
    return pairs, edge.reshape(-1, 3)
