"""Distances between body, object and measured points, and visibility of surfaces to the cameras."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.facing import facing_distance
from intercap_core.geometry.rigid.point_grid import PointGrid
from intercap_core.geometry.rigid.surface_tree import ShapedSurface, SurfaceTree
from intercap_core.geometry.rigid.surfaces import vertex_normals


class MeasuredCloud:
    """Measured points (N, 3), metres, indexed for nearest-point queries."""

    def __init__(self, points: np.ndarray) -> None:
        self.points = np.asarray(points, np.float32)
        self._tree = PointGrid(self.points) if len(self.points) else None

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance (M,) of points (M, 3) to the nearest measured point; NaN for an empty cloud."""
        if self._tree is None:
            return np.full(len(points), np.nan)
        return self._tree.distance(points)

    def mean_distance(self, points: np.ndarray) -> float:
        """Mean :meth:`distance` of points (M, 3); NaN without points."""
        return float(self.distance(points).mean()) if len(points) else float("nan")


REACH_M = 0.10  # distances outside a surface are clipped here: no figure needs larger ones
DEEPEST_M = 0.25  # depths inside a surface, and distances of measured points, are clipped here


class PosedObject:
    """A rigid mesh (V, 3), (F, 3) in its own frame, with search trees that are built once.

    ``watertight``: the mesh may be closed. Ray parity then decides which points are inside; for
    other meshes the winding number does.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, *, watertight: bool = True) -> None:
        self._tree, self._vertices = SurfaceTree(vertices, faces), vertices
        field = None
        if not (watertight and self._tree.closed):
            field = DistanceField(vertices, faces, watertight=watertight)
        self._solid = _Solid(self._tree.shaped(vertices), field)

    def placed(self, rotation: np.ndarray, translation: np.ndarray) -> ShapedSurface:
        """The surface under the pose master_from_object."""
        return self._tree.shaped(self._vertices @ rotation.T + translation)

    def signed_distance(
        self,
        points: np.ndarray,
        rotation: np.ndarray,
        translation: np.ndarray,
        *,
        reach: float = REACH_M,
    ) -> np.ndarray:
        """Signed distance (N,) of points (N, 3), master frame, to the object; negative inside.

        Values are clipped to [-``DEEPEST_M``, ``reach``].
        """
        return self._solid.signed_distance((points - translation) @ rotation, reach)

    def contact_distance(
        self, body: BodySurface, rotation: np.ndarray, translation: np.ndarray, reach: float
    ) -> np.ndarray:
        """Contact distances (V,) of a body's vertices to the object, see
        :meth:`BodySurface.facing`."""
        signed = self.signed_distance(body.vertices, rotation, translation, reach=reach)
        return body.facing(self.placed(rotation, translation), signed, reach)


class BodySurface:
    """The surface of a body in one pose, vertices (V, 3), with the search ``tree`` of its faces."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, tree: SurfaceTree) -> None:
        self.surface = tree.shaped(vertices)
        self.vertices, self._faces = vertices, faces
        self._solid = _Solid(self.surface, None if tree.closed else DistanceField(vertices, faces))

    def signed_distance(self, points: np.ndarray, *, reach: float = REACH_M) -> np.ndarray:
        """Signed distance (N,) of points (N, 3), clipped as in :class:`PosedObject`."""
        return self._solid.signed_distance(points, reach)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Unsigned distance (N,) of points (N, 3), at most ``DEEPEST_M``."""
        return self.surface.distance(points, DEEPEST_M)

    def facing(self, object_: ShapedSurface, signed: np.ndarray, reach: float) -> np.ndarray:
        """Contact distances (V,) of the body's vertices to an object, by ``signed`` (V,) distances.

        See :func:`.facing_distance`; capped at ``REACH_M``, which stands for none within ``reach``.
        """
        around = (signed < reach)[self._faces].any(1)
        normals = vertex_normals(self.vertices, self._faces[around])
        distance = facing_distance(self.vertices, normals, signed, self.surface, object_, reach)
        return np.minimum(distance, REACH_M)


class _Solid:
    """Signed distance to a ``surface``. For a surface that is not closed, ``field`` gives the
    sign."""

    def __init__(self, surface: ShapedSurface, field: DistanceField | None = None) -> None:
        self._surface, self._field = surface, field

    def signed_distance(self, points: np.ndarray, reach: float) -> np.ndarray:
        """Signed distance (N,) of points (N, 3), clipped to [-``DEEPEST_M``, ``reach``].

        With a ``field``, unsigned distances are computed first. Only points inside that are deeper
        than ``reach`` are computed again with the larger limit.
        """
        if self._field is None:
            return self._surface.signed_distance(points, reach, DEEPEST_M)
        low, high = self._field.box + np.array([[-reach], [reach]])
        found = np.full(len(points), reach)
        near = np.flatnonzero(((points > low) & (points < high)).all(1))
        found[near] = self._surface.distance(points[near], reach)
        inside = near[self._field.inside(points[near])]
        deep = inside[found[inside] >= reach]
        found[deep] = self._surface.distance(points[deep], DEEPEST_M)
        found[inside] *= -1
        return found


def seen_by_cameras(
    points: np.ndarray,
    normals: np.ndarray,
    cameras: Sequence[Camera],
    occluders: Sequence[ShapedSurface],
) -> np.ndarray:
    """Mask (N,) of the surface points that at least one camera sees.

    Visibility is that of the depth camera, or of the colour camera if there is no depth.

    Args:
        points, normals: (N, 3) surface points and outward normals, master frame.
        cameras: the cameras.
        occluders: all surfaces of the frame, the points' own surface included.
    """
    seen = np.zeros(len(points), bool)
    for camera in cameras:
        lens, camera_from_master = (
            (camera.depth, camera.depth_from_master)
            if camera.depth
            else (camera.colour, camera.colour_from_master)
        )
        eye = -camera_from_master[:3, :3].T @ camera_from_master[:3, 3]
        facing = ((eye - points) * normals).sum(1) > 0
        ids = np.flatnonzero(facing & ~seen)
        ids = ids[lens.sees(apply(camera_from_master, points[ids]))]
        if len(ids) == 0:
            continue
        start = points[ids] + 0.002 * normals[ids]  # off the surface, which must not block
        hidden = np.zeros(len(ids), bool)
        for surface in occluders:
            surface.blocks(start, np.broadcast_to(eye, start.shape), hidden)
        seen[ids[~hidden]] = True
    return seen
