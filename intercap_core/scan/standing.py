"""The object that stands on a plane, among the surfaces that a hand-held camera has seen."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from intercap_core.errors import UserError
from intercap_core.geometry.camera.clouds import colour_lookup
from intercap_core.geometry.camera.rig import ring_centre
from intercap_core.geometry.camera.transforms import apply, invert, rigid
from intercap_core.geometry.rigid.open3d_core import o3d
from intercap_core.scan.fusion import Posed
from intercap_core.scan.surfaces import ViewSurface, connected_parts
from intercap_core.scan.walk import HandHeld, Walk

AROUND = 0.6  # radius around the point that the camera faces, share of its distance
ON_PLANE_M = 0.008  # distance of points on a plane: noise of depth, and of the poses together
STANDS_M = 0.03  # largest height of the lowest points of an object that stands on the plane
UPRIGHT_DEG = 40.0  # largest angle between the plane's normal and the camera's mean up direction
MIN_PLANE = 0.03  # least share of the points on a plane
PLANES = 6  # that are tried
JOINED_M = 0.025  # gap between parts of one object: openings of a handle
RIM_M = 0.10  # width of the plane around the object in which points of the plane are looked for
SECTORS, MIN_SECTORS = 12, 9  # around the object; least number with points of the plane
SECOND = 0.2  # share of the object's points from which another part is a second object
MAX_GAP_DEG = 75.0  # largest angle between neighbouring directions of view, seen from above


@dataclass(frozen=True, eq=False)
class Standing:
    """An object on a plane: z of its frame is up, z = 0 the plane."""

    world_from_object: np.ndarray
    """(4, 4)."""
    points: np.ndarray
    """(N, 3) of the object, its frame, metres."""


@dataclass(frozen=True, eq=False)
class _Plane:
    """Plane n . x = offset of the world, with n up, metres."""

    normal: np.ndarray
    offset: float

    def heights(self, points: np.ndarray) -> np.ndarray:
        """(N,) of points (N, 3)."""
        return points @ self.normal - self.offset


def find_standing(walk: Walk, where: str) -> Standing:
    """The object that the camera faces, and the plane on which it stands.

    The plane is the highest one below the point that the camera faces on which a part of the other
    points stands, with the plane visible around it.

    Raises UserError if there is none, if two objects stand on the plane, or if the camera did not
    get around the object.

    Args:
        where: words before the message, with the sequence.
    """
    rig = walk.rig
    focus, eyes = ring_centre(rig), walk.poses[:, :3, 3]
    up = -walk.poses[:, :3, 1].mean(0)
    radius = AROUND * float(np.median(np.linalg.norm(eyes - focus, axis=1)))
    cloud = walk.cloud().thinned(ON_PLANE_M)
    near = cloud.points[np.linalg.norm(cloud.points - focus, axis=1) < radius]
    planes = [p for p in _planes(near, up / np.linalg.norm(up)) if p.heights(focus) > -STANDS_M]
    for plane in sorted(planes, key=lambda p: float(p.heights(focus))):
        parts = _standing_parts(near, plane)
        if not parts:
            continue
        frame = _frame(plane, focus)
        away = [np.linalg.norm(apply(invert(frame), part)[:, :2], axis=1).min() for part in parts]
        chosen = int(np.argmin(away))
        object_ = parts[chosen]
        if away[chosen] > STANDS_M:
            continue
        others = [p for p in parts if p is not object_ and len(p) > SECOND * len(object_)]
        if others:
            first, second = (_size(invert(frame), part) for part in (object_, others[0]))
            raise UserError(
                f"{where}: two objects stand next to each other, {first} and {second}; expected "
                "one: take the other away, or walk closer around the object"
            )
        local = apply(invert(frame), object_)
        frame = frame @ rigid(np.eye(3), np.array([*np.median(local[:, :2], axis=0), 0.0]))
        _require_around(apply(invert(frame), eyes), where)
        return Standing(frame, apply(invert(frame), object_))
    raise UserError(
        f"{where}: no object on a plane in the middle of the view; {len(planes)} level planes were "
        f"found within {radius:.1f} m of the point that the camera faces. Let the object stand "
        "alone on a table or on the floor, with some of it visible all around, and keep it in the "
        "middle of the image"
    )


def _planes(points: np.ndarray, up: np.ndarray) -> Iterator[_Plane]:
    """Level planes of points (N, 3), the largest first; ``up``: (3,) rough direction."""
    o3d.utility.random.seed(0)
    left = points
    for _ in range(PLANES):
        if len(left) < 3:
            return
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(left))
        _, inliers = cloud.segment_plane(ON_PLANE_M, 3, 2000)
        if len(inliers) < MIN_PLANE * len(points):
            return
        on = left[inliers]
        middle = on.mean(0)
        normal = np.linalg.svd(on - middle, full_matrices=False)[2][2]
        normal *= np.sign(normal @ up)
        if normal @ up > np.cos(np.radians(UPRIGHT_DEG)):
            yield _Plane(normal, float(normal @ middle))
        left = np.delete(left, inliers, axis=0)


def _standing_parts(points: np.ndarray, plane: _Plane) -> list[np.ndarray]:
    """Parts (N, 3) of points that stand on a plane and are surrounded by it."""
    heights = plane.heights(points)
    on = points[np.abs(heights) < ON_PLANE_M]
    above = points[heights > ON_PLANE_M]
    parts = (above[index] for index in connected_parts(above, JOINED_M))
    return [part for part in parts if _stands(part, on, plane)]


def _stands(part: np.ndarray, on: np.ndarray, plane: _Plane) -> bool:
    """Whether a part has low points, and points ``on`` the plane surround them."""
    low = part[plane.heights(part) < STANDS_M]
    if len(low) < 3:
        return False
    frame = invert(_frame(plane, low.mean(0)))
    low, around = (apply(frame, points)[:, :2] for points in (low, on))
    reach = np.linalg.norm(low, axis=1).max()
    distance = np.linalg.norm(around, axis=1)
    ring = around[(distance < reach + RIM_M) & (cKDTree(low).query(around)[0] < RIM_M)]
    outside = ring[np.linalg.norm(ring, axis=1) > 0.5 * reach]
    angles = np.arctan2(outside[:, 1], outside[:, 0])
    seen = set(np.floor((angles + np.pi) / (2 * np.pi) * SECTORS).astype(int).tolist())
    return len(seen) >= MIN_SECTORS


def _frame(plane: _Plane, point: np.ndarray) -> np.ndarray:
    """world_from_plane (4, 4): z up, the origin on the plane below a point (3,)."""
    z = plane.normal
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    origin = point - float(plane.heights(point)) * z
    return rigid(np.stack([x, np.cross(z, x), z], 1), origin)


def _size(plane_from_world: np.ndarray, part: np.ndarray) -> str:
    """Size and place of a part, for people."""
    local = apply(plane_from_world, part)
    width = np.linalg.norm(np.ptp(local[:, :2], axis=0))
    return f"{100 * width:.0f} cm wide and {100 * local[:, 2].max():.0f} cm high"


def _require_around(eyes: np.ndarray, where: str) -> None:
    """Raise UserError unless the camera got around the object; ``eyes``: (K, 3), its frame."""
    angles = np.sort(np.degrees(np.arctan2(eyes[:, 1], eyes[:, 0])))
    gaps = np.diff(np.append(angles, angles[0] + 360))
    if gaps.max() > MAX_GAP_DEG:
        raise UserError(
            f"{where}: the camera saw the object from {360 - gaps.max():.0f} of 360 degrees; at "
            f"most {MAX_GAP_DEG:.0f} may be missing. Walk once around it, until the start is in "
            "view again"
        )


def posed(images: HandHeld, walk: Walk, standing: Standing) -> Posed:
    """The keyframes with the pixels that show the object, and its pose in the camera's frame."""
    tree = cKDTree(standing.points)
    low, high = standing.points.min(0) - JOINED_M, standing.points.max(0) + JOINED_M
    surfaces, poses = {}, {}
    for key, world_from_camera in zip(walk.keyframes, walk.poses, strict=True):
        object_from_camera = invert(standing.world_from_object) @ world_from_camera
        seen = images.oriented(key.t)
        assert seen is not None  # of a keyframe
        pixels, points, normals = seen
        local = apply(object_from_camera, points)
        inside = ((local > low) & (local < high)).all(1) & (local[:, 2] > ON_PLANE_M)
        index = np.flatnonzero(inside)
        near = tree.query(local[index], distance_upper_bound=JOINED_M)[0]
        index = index[np.isfinite(near)]
        image = images.frames.depth(key.t, 0)
        assert image is not None
        lookup = colour_lookup(image, images.rig[0])
        colour = np.full(image.size, -1)
        colour[lookup.depth_index[lookup.shown]] = lookup.colour_index[lookup.shown]
        surfaces[key.t] = [
            ViewSurface(
                0, pixels[index], points[index].astype(np.float32),
                normals[index].astype(np.float32), colour[pixels[index]],
            )
        ]  # fmt: skip
        poses[key.t] = invert(object_from_camera)
    return Posed(images, surfaces, poses)
