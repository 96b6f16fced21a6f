"""Differentiable silhouettes and depths of a mesh in several views at once, for the baseline.

Drawn by the compiled DEODR (BSD 2-clause), which blends only along the silhouette (de La Gorce et
al., PAMI 2011). Only the requested pixels are returned: equation 1 counts no others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

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


class OverdrawRasteriser:
    """DEODR on one image that holds all tiles one below the other.

    Draws corners (V, N, 2), px in each tile, with depth (V, N), metres; returns coverage (P,) in
    [0, 1] and depth (P,), metres, of the pixels. Depth is meaningless where coverage is small. Both
    are drawn as colours; depth is interpolated linearly in the image. The mesh must be closed, with
    outward faces.
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
        """Coverage and depth of the pixels, differentiable."""
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
