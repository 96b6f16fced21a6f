"""Signed distance field of an object from depth images with known poses, and its closed surface.

As in volumetric fusion (Curless and Levoy, SIGGRAPH 1996), each voxel averages the signed distances
along the rays of all images. Votes for empty space are counted apart, so that rays that pass a thin
part do not erode it. Both are weighted by the certainty of the object's pose. Voxels that no ray
reached count as inside, which closes the surface with the visual hull.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import igl
import numba
import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter, map_coordinates

from intercap_core.geometry.rigid.open3d_core import o3d
from intercap_core.scan.surfaces import OBJECT, UNKNOWN

# Largest distance before and behind a measured surface that is averaged. Both are equal, because
# with less behind the surface than before it, noise makes the object smaller (bench/RESULTS.md).
BAND_M = 0.010
# Scale of the weight of a distance. Near one side of a thin wall, measurements of that side count
# more than those of the other side. Noise of depth and poses, metres.
NOISE_M = 0.003
EMPTY_RATIO = 4.0  # a voxel is empty if its votes for empty space outnumber the others by this
# Least votes of an empty voxel, of frame sets of mean certainty: single depth pixels are wrong
MIN_EMPTY = 3


@dataclass(frozen=True, eq=False)
class LabelledDepth:
    """A window of a depth image, and what its pixels show."""

    depth: np.ndarray
    """(h, w) float32, metres along the optical axis; 0 = none."""
    kind: np.ndarray
    """(h, w) uint8: ``UNKNOWN``, ``OBJECT`` or ``OTHER`` of :mod:`.surfaces`."""
    weight: np.ndarray
    """(h, w) float32: weight of the pixels that show the object."""
    pinhole: tuple[float, float, float, float]
    """fx, fy, cx, cy of the window, pixels; no distortion."""
    depth_from_object: np.ndarray
    """(4, 4), metres."""


@dataclass(frozen=True, eq=False)
class ClosedSurface:
    """A closed triangle mesh."""

    vertices: np.ndarray
    """(V, 3) metres, the object's frame."""
    faces: np.ndarray
    """(F, 3), normals outward."""
    measured: np.ndarray
    """(V,) bool: depth images measured the vertex; the others close holes."""
    apart_share: float
    """Share of the measured area that lay in other parts, which are left out."""


class Volume:
    """Votes of all images in a grid of voxels."""

    def __init__(self, low: np.ndarray, high: np.ndarray, voxel_m: float) -> None:
        """Cover the box between the corners ``low`` and ``high`` (3,), metres."""
        self.voxel_m = voxel_m
        self.low = np.asarray(low, float)
        self.size = tuple((np.ceil((high - low) / voxel_m).astype(int) + 1).tolist())
        self._middle = np.append((self.low + high) / 2, 1.0)
        self._certainties: list[float] = []  # of the frame sets, in the middle of the box
        self._distance = np.zeros(self.size, np.float32)  # sum of weight * distance
        self._total = np.zeros(self.size, np.float32)  # sum of weight
        self._near = np.zeros(self.size, np.float32)  # votes near a surface
        self._empty = np.zeros(self.size, np.float32)  # votes for empty space

    @property
    def sets(self) -> int:
        """Number of frame sets that were integrated."""
        return len(self._certainties)

    def integrate(self, images: Iterable[LabelledDepth], variance: np.ndarray) -> None:
        """Add the votes of the depth images of a frame set.

        ``variance``: (4, 4) of the object's points, of :func:`.place_variance`.
        """
        for image in images:
            _integrate(
                self._distance, self._total, self._near, self._empty, self.low, self.voxel_m,
                image.depth, image.kind, image.weight, image.pinhole, image.depth_from_object,
                variance,
            )  # fmt: skip
        self._certainties.append(BAND_M**2 / (BAND_M**2 + self._middle @ variance @ self._middle))

    def exclude_below(self, normal: np.ndarray, offset: float) -> None:
        """Mark the voxels with normal . x < offset as empty."""
        axes = [self.low[k] + self.voxel_m * np.arange(n) for k, n in enumerate(self.size)]
        x, y, z = np.meshgrid(*axes, indexing="ij", sparse=True)
        below = normal[0] * x + normal[1] * y + normal[2] * z < offset
        self._empty[below], self._near[below] = np.inf, 0.0

    def surface(self) -> ClosedSurface:
        """Closed surface of the largest part; without faces if all voxels are empty."""
        near = (self._near > 0) & (self._empty <= EMPTY_RATIO * self._near)
        least = min(MIN_EMPTY, self.sets) * np.mean(self._certainties)
        empty = (self._empty >= least) & ~near
        value = np.where(near, self._distance / np.maximum(self._total, 1e-9), -BAND_M)
        value[empty] = BAND_M
        for axis in range(3):  # outside the grid is empty
            for end in (0, -1):
                value[tuple(end if k == axis else slice(None) for k in range(3))] = BAND_M
        # Equal limits inside and outside: with larger values outside, smoothing removes thin rods
        value = gaussian_filter(np.clip(value, -self.voxel_m, self.voxel_m), 1.0)
        corners = np.stack(np.meshgrid(*map(np.arange, self.size), indexing="ij"), -1)
        vertices, faces = igl.marching_cubes(
            value.ravel(order="F").astype(np.float64),
            corners.reshape(-1, 3, order="F").astype(np.float64),
            *self.size,
            0.0,
        )[:2]
        mesh = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces)
        )
        measured = map_coordinates(near.astype(np.float32), vertices.T, order=1) > 0.25
        part = np.asarray(mesh.cluster_connected_triangles()[0])
        areas = trimesh.triangles.area(vertices[faces]) * measured[faces].all(1)
        by_part = np.bincount(part, areas, minlength=1)
        largest = int(np.argmax(by_part))
        kept, number = np.unique(faces[part == largest], return_inverse=True)
        return ClosedSurface(
            self.low + self.voxel_m * vertices[kept],
            number.reshape(-1, 3),
            measured[kept],
            float(1 - by_part[largest] / max(by_part.sum(), 1e-9)),
        )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _integrate(
    distance, total, near, empty, low, voxel, depth, kind, weight, pinhole, pose, variance
):
    """Kernel of :meth:`Volume.integrate`."""
    height, width = depth.shape
    fx, fy, cx, cy = pinhole
    for i in range(distance.shape[0]):
        for j in range(distance.shape[1]):
            x, y = low[0] + voxel * i, low[1] + voxel * j
            x0 = pose[0, 0] * x + pose[0, 1] * y + pose[0, 3]
            y0 = pose[1, 0] * x + pose[1, 1] * y + pose[1, 3]
            z0 = pose[2, 0] * x + pose[2, 1] * y + pose[2, 3]
            for k in range(distance.shape[2]):
                z = low[2] + voxel * k
                pz = z0 + pose[2, 2] * z
                column = int(np.floor(fx * (x0 + pose[0, 2] * z) / pz + cx + 0.5))
                row = int(np.floor(fy * (y0 + pose[1, 2] * z) / pz + cy + 0.5))
                if column < 0 or row < 0 or column >= width or row >= height:
                    continue
                if kind[row, column] == UNKNOWN:
                    continue
                away = depth[row, column] - pz
                if away < -BAND_M:
                    continue
                spread = variance[3, 3]
                for a, value in enumerate((x, y, z)):
                    spread += 2.0 * variance[a, 3] * value
                    for b, other in enumerate((x, y, z)):
                        spread += variance[a, b] * value * other
                certainty = BAND_M**2 / (BAND_M**2 + spread)
                if away > BAND_M:
                    empty[i, j, k] += certainty
                elif kind[row, column] == OBJECT:
                    w = weight[row, column] * np.exp(-0.5 * (away / NOISE_M) ** 2)
                    distance[i, j, k] += w * away
                    total[i, j, k] += w
                    near[i, j, k] += certainty
