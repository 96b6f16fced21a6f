"""The mesh of an object from recordings with known poses of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial import cKDTree

from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.scan.handled import Chain
from intercap_core.scan.surfaces import (
    OBJECT,
    OTHER,
    UNKNOWN,
    DepthImages,
    ViewSurface,
    floating,
)
from intercap_core.scan.volume import NOISE_M, ClosedSurface, LabelledDepth, Volume

MIN_COSINE = 0.25  # of the angle between a ray and the normal; flatter measurements mix surfaces
SAME_SURFACE_M = 0.015  # difference of neighbouring depths on one surface
NEAREST_M = 0.1  # a camera nearer than this to the box is left out
MARGIN_M = 0.02  # of the grid around the points
FINEST_M = 0.002  # voxel; noise of the averaged surface is not finer
FUSED_SETS = 60  # frame sets of a recording that are fused, at most twice as many
ON_GROUND_M = 0.008  # distance of a point on the plane on which the object stands: noise of depth
LOWEST = 0.5  # percentile of the points' heights on which an object stands
VOXELS = 250**3  # of the grid around the object
COLOURED_SETS = 12  # frame sets whose images give the colours


@dataclass(frozen=True, eq=False)
class Posed:
    """A recording, and what is known of the object in it."""

    recording: DepthImages
    surfaces: Chain
    """Points that show the object, by frame set."""
    poses: Mapping[int, np.ndarray]
    """master_from_object (4, 4) by frame set."""
    covariances: Mapping[int, np.ndarray] = field(default_factory=dict)
    """Covariance (6, 6) of (rotation vector, translation) by frame set, rad and metres, rotation
    applied on the left. Poses without one count as exact."""

    @property
    def sets(self) -> list[int]:
        """Frame sets with a pose and points of the object."""
        return sorted(self.poses.keys() & self.surfaces.keys())

    def covariance(self, t: int) -> np.ndarray:
        """Covariance (6, 6) of the pose of a frame set; zero if none is known."""
        return self.covariances.get(t, np.zeros((6, 6)))

    def points(self, t: int) -> np.ndarray:
        """Points (N, 3) of all cameras in the object's frame."""
        views = np.concatenate([view.points for view in self.surfaces[t]])
        return apply(invert(self.poses[t]), views)


def fuse(
    parts: Sequence[Posed],
    *,
    up: np.ndarray | None = None,
    ground: float | None = None,
    voxels: int = VOXELS,
) -> ClosedSurface:
    """Closed surface from all recordings, in the object's frame.

    Args:
        parts: recordings with poses of the object.
        up: (3,) direction up in the object's frame, if no frame set shows the underside: the
            object ends at its lowest points. None = it was lifted and turned.
        ground: height along ``up`` of the plane on which the object stands, metres; None = not
            known. The plane is fused with the object, and the object ends there.
        voxels: of the grid.

    Raises UserError if no surface is left.
    """
    points = np.concatenate([part.points(t) for part in parts for t in part.sets])
    low, high = np.percentile(points, (0.2, 99.8), axis=0)
    low, high = low - MARGIN_M, high + MARGIN_M
    voxel = max(FINEST_M, float(np.prod(high - low) / voxels) ** (1 / 3))
    volume = Volume(low, high, voxel)
    box = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    for part in parts:
        for t in part.sets[:: max(1, len(part.sets) // FUSED_SETS)]:
            views = {view.camera: view for view in part.surfaces[t]}
            images = [_labelled(part, t, c, views.get(c), box) for c in part.recording.cameras]
            shown = [image for image in images if image is not None]
            if up is not None and ground is not None:
                for image in shown:
                    _label_ground(image, up, ground)
            volume.integrate(shown, place_variance(part.poses[t], part.covariance(t)))
    if up is not None:
        if ground is None:
            ground = float(np.percentile(points @ up, LOWEST))
        volume.exclude_below(up, ground)
    surface = volume.surface()
    if not len(surface.faces):
        sequences = ", ".join(part.recording.frames.sequence for part in parts)
        raise UserError(
            f"sequence {sequences}: the depth images leave no surface of the object, in "
            f"{volume.sets} frame sets with a pose of it; turn it more slowly, and nearer to the "
            "cameras"
        )
    return surface


def place_variance(pose: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Quadratic form Q (4, 4) of the variance of the object's points under an uncertain pose.

    (x, 1) Q (x, 1)' is the variance in square metres, averaged over the three directions, of the
    point x of the object's frame.

    Args:
        pose: (4, 4) master_from_object.
        covariance: (6, 6) of (rotation vector, translation), rotation applied on the left.
    """
    turn, mixed, shift = covariance[:3, :3], covariance[:3, 3:], covariance[3:, 3:]
    # of the displacement w x r + v of the point r = R x: trace of its covariance
    form = np.zeros((4, 4))
    form[:3, :3] = np.trace(turn) * np.eye(3) - turn
    # E[v . (w x r)] = r . E[v x w]
    form[:3, 3] = form[3, :3] = (mixed.T - mixed)[[1, 2, 0], [2, 0, 1]]
    form[3, 3] = np.trace(shift)
    rotation = np.eye(4)
    rotation[:3, :3] = pose[:3, :3]
    return rotation.T @ form @ rotation / 3


def _labelled(
    part: Posed, t: int, c: int, view: ViewSurface | None, box: np.ndarray
) -> LabelledDepth | None:
    """The window of a depth image that shows the object's box; None without an image of it.

    Args:
        part: recording with poses of the object.
        t: frame set.
        c: camera.
        view: points that show the object in this image; None if there are none.
        box: (8, 3) corners around the object, its frame.
    """
    recording, pose = part.recording, part.poses[t]
    depth, camera = recording.depth(t, c), recording.rig[c]
    lens = camera.depth
    if depth is None or lens is None:
        return None
    depth_from_object = camera.depth_from_master @ pose
    local = apply(depth_from_object, box)
    if local[:, 2].min() < NEAREST_M:
        return None
    # Pixels at depth edges mix two surfaces: their rays may hit a rod, and do not show empty space.
    mixed = floating((1e3 * depth).astype(np.uint16))
    kind = np.where((depth > 0) & ~mixed, OTHER, UNKNOWN).astype(np.uint8)
    weight = np.ones(depth.shape, np.float32)
    if view is not None:
        mask = np.zeros(depth.shape, np.uint8)
        mask.ravel()[view.pixels] = 1
        kind[cv2.dilate(mask, np.ones((3, 3), np.uint8)) > 0] = UNKNOWN  # mixed pixels of the edge
        towards = camera.master_from_depth[:3, 3] - view.points
        cosine = (towards * view.normals).sum(1) / np.linalg.norm(towards, axis=1)
        kind.ravel()[view.pixels[cosine > MIN_COSINE]] = OBJECT
        arms = np.concatenate([np.cross(view.points - pose[:3, 3], view.normals), view.normals], 1)
        variance = np.einsum("ni,ij,nj->n", arms, part.covariance(t), arms)  # along the normals
        weight.ravel()[view.pixels] = cosine**2 * NOISE_M**2 / (NOISE_M**2 + variance)
    depth = cv2.bilateralFilter(depth, 5, SAME_SURFACE_M, 2.0)  # averages about ten pixels
    # a pinhole image of the box, so that each voxel is projected by two divisions
    rays = local[:, :2] / local[:, 2:]
    first, last = rays.min(0), rays.max(0)
    width, height = np.ceil((last - first) * (lens.fx, lens.fy)).astype(int) + 1
    row, column = np.mgrid[:height, :width]
    x, y = first[0] + column / lens.fx, first[1] + row / lens.fy
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    u, v = lens.project(rays).astype(np.float32).T.reshape(2, height, width)

    def resampled(image: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.remap(image, u, v, cv2.INTER_NEAREST))

    pinhole = (lens.fx, lens.fy, -first[0] * lens.fx, -first[1] * lens.fy)
    return LabelledDepth(
        resampled(depth), resampled(kind), resampled(weight), pinhole, depth_from_object
    )


def _label_ground(image: LabelledDepth, up: np.ndarray, ground: float) -> None:
    """Label the pixels on the plane up . x = ground of the object's frame as the object."""
    fx, fy, cx, cy = image.pinhole
    row, column = np.indices(image.depth.shape)
    rays = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(image.depth.shape)], -1)
    normal = image.depth_from_object[:3, :3] @ up
    slope = rays @ normal
    height = image.depth * slope - normal @ image.depth_from_object[:3, 3] - ground
    on = (image.kind == OTHER) & (np.abs(height) < ON_GROUND_M)
    image.kind[on] = OBJECT
    image.weight[on] = (slope[on] / np.linalg.norm(rays[on], axis=1)) ** 2


def vertex_colours(vertices: np.ndarray, parts: Sequence[Posed]) -> np.ndarray:
    """Colours (V, 3) uint8, sRGB: the median of the nearest five coloured points of each vertex."""
    points, colours = [], []
    for part in parts:
        for t in part.sets[:: max(1, len(part.sets) // COLOURED_SETS)]:
            for view in part.surfaces[t]:
                image = part.recording.frames.colour(t, view.camera)
                if image is None:
                    continue
                shown = view.colour_pixels >= 0
                points.append(apply(invert(part.poses[t]), view.points[shown]))
                colours.append(image.reshape(-1, 3)[view.colour_pixels[shown]])
    if not points:
        return np.full((len(vertices), 3), 128, np.uint8)
    _, near = cKDTree(np.concatenate(points)).query(vertices, 5)
    return np.median(np.concatenate(colours)[near], axis=1)[:, ::-1].astype(np.uint8)
