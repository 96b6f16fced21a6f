"""Which vertices of a mesh a camera sees, by rays (Embree)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.rigid.constants import VISIBLE_OFFSET_M
from intercap_core.geometry.rigid.normals import vertex_normals
from intercap_core.geometry.rigid.open3d_core import o3d


class OcclusionScene:
    """Which vertices of a mesh a camera sees, the mesh itself and others in the way.

    All meshes in one common frame. Built once for a frame of the capture, asked for each camera.
    ``offset_m`` lifts a vertex off its own surface before the ray is cast.
    """

    def __init__(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        occluders: Sequence[tuple[np.ndarray, np.ndarray]] = (),
        *,
        offset_m: float = VISIBLE_OFFSET_M,
        threads: int = 0,
    ) -> None:
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=threads)
        for points, triangles in [(vertices, faces), *occluders]:
            self._scene.add_triangles(
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, np.float32)),
                o3d.core.Tensor.from_numpy(np.ascontiguousarray(triangles, np.uint32)),
            )
        self._vertices = np.asarray(vertices, np.float64)
        self._normals = vertex_normals(self._vertices, faces)
        self._offset = offset_m

    def visible(self, intrinsics: Intrinsics, camera_from_mesh: np.ndarray) -> np.ndarray:
        """Whether each vertex (V,) is in the image, faces the camera and is not hidden."""
        rotation, translation = camera_from_mesh[:3, :3], camera_from_mesh[:3, 3]
        eye = -rotation.T @ translation
        to_eye = eye - self._vertices
        seen = np.einsum("ij,ij->i", to_eye, self._normals) > 0
        seen &= intrinsics.sees(self._vertices @ rotation.T + translation)
        ids = np.flatnonzero(seen)
        if len(ids):
            start = self._vertices[ids] + self._offset * self._normals[ids]
            rays = np.concatenate([start, eye - start], 1).astype(np.float32)
            hidden = self._scene.test_occlusions(
                o3d.core.Tensor.from_numpy(rays), tnear=0.0, tfar=1.0
            )
            seen[ids[hidden.numpy()]] = False
        return seen
