"""Depth pixels that show the object, in each frame set of a recording.

A pixel shows the object if the mask of one of its candidates covers it, the person's mask does not,
and its point is not on the skin of the fitted body. Pixels of everything else are kept as well:
space in front of them is free.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from intercap_core import artefacts
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.clouds import colour_lookup, depth_points
from intercap_core.geometry.camera.masks import Runs
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.open3d_core import o3d
from intercap_core.schemas import PERSON, SCENE

UNKNOWN, OBJECT, OTHER = 0, 1, 2  # what a pixel shows
ON_SKIN_M = 0.008  # points this near to the fitted skin may be skin; mean error of hands
GAP_M = 0.10  # parts of an object that a hand separates are nearer to each other: its breadth
MIN_POINTS = 60  # of a part in one frame set, all cameras
NORMAL_RADIUS_M = 0.015  # neighbourhood of a normal: three pixels of a Kinect at 2 m


@dataclass(frozen=True, eq=False)
class ViewSurface:
    """Points of one depth image that may be the object. N points."""

    camera: int
    """Index in the rig."""
    pixels: np.ndarray
    """(N,) flat depth pixels."""
    points: np.ndarray
    """(N, 3) float32, metres, master frame."""
    normals: np.ndarray
    """(N, 3) float32 unit normals, towards the camera."""
    colour_pixels: np.ndarray
    """(N,) flat pixels of the colour image; -1 = not seen there."""

    def subset(self, kept: np.ndarray) -> ViewSurface:
        """The points of a mask (N,)."""
        arrays = (self.pixels, self.points, self.normals, self.colour_pixels)
        return ViewSurface(self.camera, *(values[kept] for values in arrays))


class DepthImages:
    """Depth images of cameras with known poses."""

    def __init__(self, frames: Frames, rig: Rig, cameras: Sequence[int], bias: np.ndarray) -> None:
        """Take the ``cameras`` of ``rig``, whose depth is too large by ``bias`` (C,) metres."""
        self.frames, self.rig, self.cameras, self.bias = frames, rig, cameras, bias

    def depth(self, t: int, c: int) -> np.ndarray | None:
        """Depth (H, W) float32, metres, without the camera's bias; 0 = none."""
        image = self.frames.depth(t, c)
        if image is None:
            return None
        return np.where(image > 0, image * np.float32(1e-3) - np.float32(self.bias[c]), 0)


class Recording(DepthImages):
    """Images, masks and bodies of a recording, by moment."""

    def __init__(
        self,
        frames: Frames,
        detections: Path,
        scene: Path,
        person: Path,
        skin: Callable[[int], np.ndarray],
        labels: Sequence[str],
    ) -> None:
        """Open the artefacts of a sequence.

        Args:
            frames: the recording.
            detections, scene, person: artefacts of these stages.
            skin: returns vertices (V, 3) of the fitted body at a moment, master frame, metres.
                Points on it are left out of the object.
            labels: detector classes of the object; empty = all candidates but the person.
        """
        rig = Rig.from_scene(scene)
        with artefacts.read(scene, SCENE) as source:
            self._count = len(source["times"])
            frames = frames.showing(source["image_of"])
            bias = np.nan_to_num(source["depth_bias"])
            self.zup_from_master = source["zup_from_master"]
            moments = Detections.load(detections).showing(source["image_of"])
            usable = source["present"] & np.isfinite(rig.master_from_colour).all((1, 2))
        cameras = [c for c, camera in enumerate(rig) if camera.depth is not None and usable[c]]
        super().__init__(frames, rig, cameras, bias)
        self.detections = moments.with_candidates_of(person)
        self.labels = frozenset(labels)
        with artefacts.read(person, PERSON) as source:
            self._masks = artefacts.unpack_ragged(source["mask_offsets"], source["mask_rle"])
        self._skin = skin

    def __len__(self) -> int:
        return self._count

    def person_mask(self, t: int, c: int) -> Runs | None:
        """The person's mask in the colour image; None = not known."""
        rle = self._masks[t * len(self.rig) + c]
        lens = self.rig[c].colour
        return Runs(rle, lens.height, lens.width) if rle else None

    def surfaces(self, t: int) -> list[ViewSurface]:
        """Points of all cameras that candidates cover, at moment t."""
        tree = cKDTree(self._skin(t))
        views = (self._surface(t, c, tree) for c in self.cameras)
        return [view for view in views if view is not None]

    def _surface(self, t: int, c: int, skin: cKDTree) -> ViewSurface | None:
        image = self.frames.depth(t, c)
        candidates = [
            candidate.runs
            for candidate in self.detections.candidates(t, c)
            if not self.labels or candidate.label in self.labels
        ]
        if image is None or not candidates:
            return None
        camera = self.rig[c]
        width = camera.colour.width
        lookup = colour_lookup(image, camera)
        seen = lookup.shown
        row, column = np.divmod(np.where(seen, lookup.colour_index, 0), width)
        covered = np.zeros(len(seen), bool)
        for runs in candidates:
            covered |= runs.sample(column, row)
        covered &= seen
        mask = self.person_mask(t, c)
        if mask is not None:
            covered &= ~mask.sample(column, row)
        shown = image.copy()
        shown[floating(image)] = 0
        index = lookup.depth_index[covered]
        kept = shown.ravel()[index] > 0
        index, colour = index[kept], lookup.colour_index[covered][kept]
        local = depth_points(shown, camera, index).points
        if len(local) < MIN_POINTS:
            return None
        local *= ((local[:, 2] - self.bias[c]) / local[:, 2])[:, None]
        points = apply(camera.master_from_depth, local)
        off = skin.query(points, distance_upper_bound=ON_SKIN_M)[0] > ON_SKIN_M
        points, index, colour = points[off], index[off], colour[off]
        if len(points) < MIN_POINTS:
            return None
        normals = _normals(points, camera.master_from_depth[:3, 3])
        return ViewSurface(c, index, points.astype(np.float32), normals.astype(np.float32), colour)


def floating(image: np.ndarray) -> np.ndarray:
    """Mask (H, W) of pixels at a depth edge, whose measurement mixes two surfaces.

    ``image``: (H, W) uint16 mm. More than 3 cm of depth between neighbours is an edge.
    """
    block = np.ones((3, 3), np.uint8)
    values = image.astype(np.float32)
    nearest = cv2.erode(np.where(image == 0, np.float32(65535), values), block)
    return (image > 0) & (values - nearest > 30.0)


def _normals(points: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Unit normals (N, 3) of points (N, 3) of one depth image, towards its camera at ``eye``."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(NORMAL_RADIUS_M, 40))
    cloud.orient_normals_towards_camera_location(eye)
    return np.asarray(cloud.normals)


def connected_parts(points: np.ndarray, gap_m: float = GAP_M) -> Iterator[np.ndarray]:
    """Yield the indices of the connected parts of points (N, 3), the largest first.

    Points nearer than about ``gap_m`` are connected. Parts of fewer than ``MIN_POINTS`` are left
    out.
    """
    cells, cell_of = np.unique(np.floor(2 * points / gap_m), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(2.0, output_type="ndarray")
    ones = np.ones(len(pairs), bool)
    graph = coo_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(len(cells), len(cells)))
    _, number = connected_components(graph, directed=False)
    part_of = number[cell_of.ravel()]
    counts = np.bincount(part_of)
    for part in np.argsort(-counts, kind="stable"):
        if counts[part] >= MIN_POINTS:
            yield np.flatnonzero(part_of == part)
