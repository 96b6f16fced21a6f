"""The paper's object tracking, as a baseline: equation 1 minimised by Adam.

Every view keeps the candidate with the largest overlap with the rendering of the expected pose.
Then 400 (first frame) or 150 (other frames) Adam steps follow, on the soft silhouette and depth of
all views in one batch. Steps, learning rate and crops are those of the authors' public code.

Differences from that code:

- It continues from the last pose with Adam's moments; here each frame starts from an extrapolated
  pose, because the former loses small objects in a fast hand.
- It has no depth term, and the paper's weights were "set empirically". With equation 1's squares, a
  few mask pixels that show the wall behind drive the pose away, so depth is robust here, by the
  Geman-McClure function that the code imports.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bench.rasteriser import OverdrawRasteriser, Pixels
from intercap_core.body.kinematics import rotation_from_axis_angle
from intercap_core.geometry.camera.projection import project_with_jacobian
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render
from intercap_core.geometry.rigid.shots import Rendering
from intercap_core.geometry.solve.robust import geman_mcclure
from intercap_core.object_track.reduced_mask import ReducedMask
from intercap_core.object_track.view import View

MARGIN_PX = 12  # of a tile around mask and prediction
COVERED = 0.5  # depth is compared where the rendered coverage is larger
LIKELY_LABEL_BONUS = 0.05  # added to the overlap
MIN_PIXELS = 20  # of a mask, as in the public code


DEPTH_WEIGHT = 1e4  # lambda_depth over lambda_segm, per m^2
DEPTH_SCALE_M = 0.05  # of Geman-McClure


@dataclass(frozen=True)
class Recipe:
    """Steps of the baseline."""

    first_steps: int = 400
    steps: int = 150
    learning_rate_m: float = 1e-3
    learning_rate_rad: float = 1e-3


@dataclass(frozen=True, eq=False)
class FrameFit:
    """Path of the fit of one frame; the first entry is the start."""

    poses: np.ndarray  # (steps + 1, 4, 4)
    seconds: np.ndarray  # (steps + 1,) since the start of the frame


def fit_by_adam(
    mesh: ObjectMesh,
    views: list[View],
    pose: np.ndarray,
    recipe: Recipe,
    steps: int,
    *,
    min_overlap: float,
    labels: tuple[str, ...],
) -> FrameFit:
    """Take ``steps`` Adam steps from ``pose`` (4, 4) master_from_object; none if no view sees it.

    The rotation vector is relative to the frame's start, far from its singularity at 180 degrees.
    """
    begin = time.process_time()
    crops = Crops.cut(mesh, views, pose, min_overlap, labels)
    if crops is None:
        return FrameFit(pose[None], np.zeros(1))
    images, start = ObjectImages(mesh, {0: crops}), torch.tensor(pose[:3, :3]).float()
    turn = torch.zeros(3, requires_grad=True)
    place = torch.tensor(pose[:3, 3], dtype=torch.float32, requires_grad=True)
    adam = torch.optim.Adam(
        [
            {"params": [turn], "lr": recipe.learning_rate_rad},
            {"params": [place], "lr": recipe.learning_rate_m},
        ],
        fused=True,
    )
    path, seconds = [np.append(np.zeros(3), pose[:3, 3])], [0.0]
    for _ in range(steps):
        adam.zero_grad()
        images(rotation_from_axis_angle(turn[None]) @ start, place[None]).backward()
        adam.step()
        path.append(np.append(turn.detach().numpy(), place.detach().numpy()))
        seconds.append(time.process_time() - begin)
    poses = np.tile(np.eye(4), (len(path), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.array(path)[:, :3]).as_matrix() @ pose[:3, :3]
    poses[:, :3, 3] = np.array(path)[:, 3:]
    return FrameFit(poses, np.array(seconds))


@dataclass(frozen=True, eq=False)
class Crops:
    """Mask pixels of the object in V views, on tiles, and their depth."""

    pixels: Pixels  # the P mask pixels of all views
    depth: np.ndarray  # (P,) float32 metres along the colour camera's axis, 0 = unmeasured
    lens: np.ndarray  # (V, 13) with the tile's corner as origin
    camera_from_master: np.ndarray  # (V, 4, 4)

    @classmethod
    def cut(
        cls,
        mesh: ObjectMesh,
        views: list[View],
        pose: np.ndarray,
        min_overlap: float,
        labels: tuple[str, ...],
    ) -> Crops | None:
        """Crop the views to the candidates chosen at ``pose``; None if no view has one."""
        found: list[tuple[Any, ...]] = []
        for view in views:
            lens, camera = view.geometry.lens, view.geometry.camera
            drawn = render(mesh.vertices, mesh.faces, lens, camera.colour_from_master @ pose)
            kept = choose(view, drawn, min_overlap, labels)
            if kept is None or kept.area < MIN_PIXELS:
                continue
            y, x = np.nonzero(kept.mask)
            y, x = y + kept.y0, x + kept.x0
            (height, width), margin = drawn.mask.shape, MARGIN_PX
            left = max(min(x.min(), drawn.x0) - margin, 0)
            top = max(min(y.min(), drawn.y0) - margin, 0)
            right = min(max(x.max() + 1, drawn.x0 + width) + margin, lens.width)
            bottom = min(max(y.max() + 1, drawn.y0 + height) + margin, lens.height)
            size = (int(right - left), int(bottom - top))
            depth = registered_depth(mesh, view, pose, left, top, size)
            moved = lens.cropped(left, top, *size).parameters
            x, y = x - left, y - top
            found.append((x, y, size, depth[y, x], moved, camera.colour_from_master))
        if not found:
            return None
        columns, rows, sizes, depths, lenses, cameras = zip(*found, strict=True)
        number = np.repeat(np.arange(len(found)), [len(x) for x in columns])
        pixels = Pixels(number, np.concatenate(columns), np.concatenate(rows), np.array(sizes))
        return cls(pixels, np.concatenate(depths), np.array(lenses), np.array(cameras))


def choose(
    view: View, drawn: Rendering, min_overlap: float, labels: tuple[str, ...]
) -> ReducedMask | None:
    """The candidate with the largest IoU with the rendering ``drawn``; None below the threshold.

    Pixels hidden by the person are ignored, and a likely label breaks ties, as in the tracker.
    """
    best, best_rank = None, 0.0
    window = (drawn.x0, drawn.y0, *drawn.mask.shape)
    person = view.person.window(*window)
    for candidate in view.candidates:
        inside = candidate.mask.window(*window)
        visible = drawn.mask & (inside | ~person)
        common = int((visible & inside).sum())
        overlap = common / max(int(visible.sum()) + candidate.mask.area - common, 1)
        rank = overlap + (LIKELY_LABEL_BONUS if candidate.label in labels else 0.0)
        if overlap >= min_overlap and rank > best_rank:
            best, best_rank = candidate.mask, rank
    return best


def registered_depth(
    mesh: ObjectMesh, view: View, pose: np.ndarray, left: int, top: int, size: tuple[int, int]
) -> np.ndarray:
    """Depth (h, w) float32 of a window of the reduced colour image, 0 where unmeasured.

    Only depth around the object at ``pose`` is used; of several points in a pixel the nearest.
    """
    geometry = view.geometry
    camera, lens = geometry.camera, geometry.depth_lens
    image = np.full((size[1], size[0]), np.inf, np.float32)
    if view.depth is not None and lens is not None and camera.colour_from_depth is not None:
        corners = lens.project(apply(camera.depth_from_master @ pose, mesh.vertices))
        low = np.maximum(corners.min(0).astype(int) - MARGIN_PX, 0)
        high = np.maximum(corners.max(0).astype(int) + MARGIN_PX, 0)
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        known = (view.depth[window] > 0) & np.isfinite(lens.rays[window][..., 0])
        z = view.depth[window][known].astype(np.float64)
        local = np.column_stack([lens.rays[window][known] * z[:, None], z])
        points = apply(camera.colour_from_depth, local)
        x, y = np.rint(geometry.lens.project(points)).astype(int).T - np.array([[left], [top]])
        inside = (x >= 0) & (y >= 0) & (x < size[0]) & (y < size[1])
        np.minimum.at(image, (y[inside], x[inside]), points[inside, 2].astype(np.float32))
    image[np.isinf(image)] = 0
    return image


class ObjectImages:
    """Equation 1 of T frames with V views in all, in torch; all views are drawn as one image.

    The sum over mask pixels of (1 - coverage)^2 and, if measured and drawn, ``DEPTH_WEIGHT`` times
    the robust square of the difference of depths.
    """

    def __init__(self, mesh: ObjectMesh, crops: Mapping[int, Crops]) -> None:
        """``crops`` by frame; frames without views are omitted."""

        def tensor(values: list[np.ndarray]) -> torch.Tensor:
            return torch.as_tensor(np.concatenate(values).astype(np.float32))

        self._empty, views = not crops, list(crops.values())
        if self._empty:
            return
        self._frame = torch.tensor([t for t, crop in crops.items() for _ in crop.lens])
        first = np.cumsum([0, *(len(crop.lens) for crop in views)])
        pixels = Pixels(
            np.concatenate([c.pixels.view + n for c, n in zip(views, first, strict=False)]),
            np.concatenate([c.pixels.x for c in views]),
            np.concatenate([c.pixels.y for c in views]),
            np.concatenate([c.pixels.sizes for c in views]),
        )
        camera = tensor([c.camera_from_master for c in views])
        self._rotation, self._shift = camera[:, :3, :3], camera[:, None, :3, 3]
        self._lens = tensor([c.lens for c in views])[:, None]
        self._depth = tensor([c.depth for c in views])
        self._vertices = torch.as_tensor(mesh.vertices.astype(np.float32))
        self._draw = OverdrawRasteriser(mesh.faces, len(mesh.vertices), pixels)

    def __call__(self, rotation: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
        """The energy, differentiable, of poses (T, 3, 3) and (T, 3), master_from_object."""
        if self._empty:
            return translation.new_zeros(())
        points = self._vertices @ rotation.mT + translation[:, None]
        local = points[self._frame] @ self._rotation.mT + self._shift  # (V, N, 3)
        coverage, depth = self._draw(Project.apply(local, self._lens), local[..., 2])
        drawn = (self._depth > 0) & (coverage.detach() > COVERED)
        squared = torch.where(drawn, depth - self._depth, 0) ** 2
        robust = geman_mcclure(squared, DEPTH_SCALE_M).rho
        return ((1 - coverage) ** 2).sum() + DEPTH_WEIGHT * robust.sum()


class Project(torch.autograd.Function):
    """Pixels (V, N, 2) of points (V, N, 3) through each view's full lens (V, 1, 13)."""

    @staticmethod
    def forward(ctx: Any, points: torch.Tensor, lens: torch.Tensor) -> torch.Tensor:
        pixels, jacobian = project_with_jacobian(points, lens)
        ctx.save_for_backward(jacobian)
        return pixels

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:
        (jacobian,) = ctx.saved_tensors
        return torch.einsum("vni,vnij->vnj", gradients[0], jacobian), None
