"""Errors of scanned meshes against the true mesh of the recorded object.

The frame of a scan is arbitrary. The scan is aligned to the truth by rigid iterative closest point
(Besl and McKay 1992) from many rotations. True meshes must be solids without cavities, so that no
part of their surface is hidden from every side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.evaluation.known import finite, over_known
from intercap_core.geometry.camera.transforms import apply, invert, rigid
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.surfaces import face_normals, sample_surface

SAMPLES = 30_000  # points of each surface whose distances are measured
# Stages of the alignment: sample points, iterations, number of best starts that are kept
_STAGES = ((200, 6, 16), (1000, 12, 3), (8000, 30, 1))


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh."""

    vertices: np.ndarray
    """(V, 3) metres."""
    faces: np.ndarray
    """(F, 3) vertex indices, facing outward."""

    def moved(self, pose: np.ndarray) -> Mesh:
        """The mesh moved by a transform (4, 4)."""
        return Mesh(apply(pose, self.vertices), self.faces)

    def samples(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Points (count, 3) evenly over the surface and their outward normals (count, 3)."""
        chosen = sample_surface(self.vertices, self.faces, count)
        normals = face_normals(self.vertices, self.faces)[chosen.faces]
        return chosen.of(self.vertices, self.faces), normals

    @property
    def is_watertight(self) -> bool:
        """Whether each edge has two faces of opposite direction."""
        return bool(trimesh.Trimesh(self.vertices, self.faces).is_watertight)


@dataclass(frozen=True, eq=False)
class TrackErrors:
    """Errors of a tracked object over T frames with one mesh: MSSD, metres; inf = lost."""

    given: np.ndarray
    """(T,) with the mesh of objects.yaml."""
    scanned: np.ndarray
    """(T,) with the scanned mesh."""


@dataclass(frozen=True, eq=False)
class ScanErrors:
    """Errors of one scanned object."""

    object_: str
    to_truth: np.ndarray
    """(N,) distances of points of the scan from the true surface, metres; empty without a scan."""
    to_scan: np.ndarray
    """(N,) distances of points of the true surface from the scan, metres."""
    watertight: bool = False
    problem: str = ""
    """Why there is no scan."""
    tracks: Sequence[TrackErrors] = field(default_factory=list)
    """Errors in other recordings of the object, tracked with both meshes."""
    way: str = "turned"
    """How the recording was scanned."""
    before: float = float("nan")
    """Chamfer distance of the mesh that was improved, metres; NaN = none."""

    @property
    def chamfer(self) -> float:
        """Mean of the mean distances in both directions, metres."""
        return float(self.to_truth.mean() + self.to_scan.mean()) / 2

    @property
    def p95(self) -> float:
        """95th percentile of the distances of both directions, metres."""
        return float(np.percentile(np.concatenate([self.to_truth, self.to_scan]), 95))


def distances(scan: Mesh, truth: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Distances (N,) of the aligned scan's points from the truth and (N,) of the reverse, metres.

    N = ``SAMPLES``.
    """
    return (
        DistanceField(truth.vertices, truth.faces, threads=1).distance(scan.samples(SAMPLES)[0]),
        DistanceField(scan.vertices, scan.faces, threads=1).distance(truth.samples(SAMPLES)[0]),
    )


def align(scan: Mesh, truth: Mesh) -> np.ndarray:
    """truth_from_scan (4, 4) of least distance between both surfaces.

    Starts are the 60 rotations of the icosahedron and the 24 of the cube between the principal
    axes of both surfaces. All of them are refined with few points, the best ones with more. Pairs
    of nearest points in both directions are aligned point to point first, then point to plane.
    """
    around = [_principal_axes(mesh) for mesh in (truth, scan)]
    (true_centre, true_axes), (centre, axes) = around
    poses = []
    for group in ("I", "O"):
        for turn in Rotation.create_group(group).as_matrix():
            rotation = true_axes @ turn @ axes.T
            poses.append(rigid(rotation, true_centre - rotation @ centre))
    for number, (count, iterations, keep) in enumerate(_STAGES):
        pair = _Pair(scan, truth, count)
        refined = [pair.refined(pose, iterations, to_plane=number > 0) for pose in poses]
        order = np.argsort([pair.mean_distance(pose) for pose in refined])
        poses = [refined[i] for i in order[:keep]]
    return poses[0]


def _principal_axes(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Centre (3,) of the surface and a rotation (3, 3) whose columns are its principal axes."""
    points = mesh.samples(4000)[0]
    centre = points.mean(0)
    axes = np.linalg.eigh(np.cov((points - centre).T))[1]
    axes[:, 0] *= np.linalg.det(axes)
    return centre, axes


class _Pair:
    """Points of a scan and of the truth that are aligned."""

    def __init__(self, scan: Mesh, truth: Mesh, count: int) -> None:
        self._points = scan.samples(count)[0]
        self._true_points, self._true_normals = truth.samples(count)
        self._surface = DistanceField(scan.vertices, scan.faces, threads=1)
        self._true_surface = DistanceField(truth.vertices, truth.faces, threads=1)

    def _matched(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Scan points (2N, 3) moved by ``pose``, nearest true points and their normals."""
        moved = apply(pose, self._points)
        nearest = self._true_surface.closest(moved)
        reverse = self._surface.closest(apply(invert(pose), self._true_points))
        return (
            np.concatenate([moved, apply(pose, reverse.points)]),
            np.concatenate([nearest.points, self._true_points]),
            np.concatenate([nearest.normals, self._true_normals]),
        )

    def mean_distance(self, pose: np.ndarray) -> float:
        """Mean distance of nearest points in both directions, metres."""
        points, goals, _ = self._matched(pose)
        return float(np.linalg.norm(points - goals, axis=1).mean())

    def refined(self, pose: np.ndarray, iterations: int, *, to_plane: bool) -> np.ndarray:
        """The pose after iterations of closest points."""
        for number in range(iterations):
            points, goals, normals = self._matched(pose)
            if to_plane and number >= 3:
                step = _plane_step(points, goals, normals)
            else:
                step = align_points(points, goals)
            pose = step @ pose
            if np.abs(step - np.eye(4)).max() < 1e-7:
                break
        return pose


def align_points(points: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Rigid transform (4, 4) of least squared distance from points to goals (N, 3); Kabsch 1976."""
    middle, goal = points.mean(0), goals.mean(0)
    rotation = Rotation.align_vectors(goals - goal, points - middle)[0].as_matrix()
    return rigid(rotation, goal - rotation @ middle)


def _plane_step(points: np.ndarray, goals: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Rigid transform (4, 4) of least squared distance along the normals, linearised.

    Motions that change no distance, such as the rotation of a sphere, stay zero.
    """
    centre = points.mean(0)
    radius = np.sqrt(((points - centre) ** 2).sum(1).mean())
    design = np.concatenate([np.cross((points - centre) / radius, normals), normals], 1)
    offset = ((goals - points) * normals).sum(1)
    motion = np.linalg.lstsq(design, offset, rcond=1e-3)[0]
    rotation = Rotation.from_rotvec(motion[:3] / radius).as_matrix()
    return rigid(rotation, centre + motion[3:] - rotation @ centre)


def figures(scans: Sequence[ScanErrors]) -> dict[str, float]:
    """Mean errors over objects, millimetres, of the scan and of the mesh before it; shares; error
    of tracks with scanned meshes over that with given ones, geometric mean over recordings."""
    if not scans:
        return {}
    solved = [scan for scan in scans if len(scan.to_truth)]
    ratios = [
        np.median(track.scanned) / np.median(track.given) for s in solved for track in s.tracks
    ]
    return finite(
        {
            "solved_share": len(solved) / len(scans),
            "watertight_share": float(np.mean([scan.watertight for scan in scans])),
            "chamfer_mm": 1e3 * over_known(np.mean, [scan.chamfer for scan in solved]),
            "p95_mm": 1e3 * over_known(np.mean, [scan.p95 for scan in solved]),
            "before_mm": 1e3 * over_known(np.nanmean, [scan.before for scan in solved]),
            "object_ratio": float(np.exp(over_known(np.mean, np.log(ratios)))),
        }
    )
