"""Frame and symmetry of a scanned mesh."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import trimesh

from intercap_core.entries import ContinuousSymmetry, Symmetry
from intercap_core.geometry.camera.transforms import rotation_exp
from intercap_core.geometry.rigid.distance import DistanceField

ALIKE_M = 0.003  # surfaces this near to each other are equal; error of a scan
ALIKE_SHARE = 0.95  # least share of the surface that a symmetry maps onto itself
ORDERS = (2, 3, 4, 6)
SAMPLES = 4000


@dataclass(frozen=True)
class ProposedSymmetry:
    """A symmetry of the shape, and how well it fits."""

    symmetry: Symmetry
    """As in objects.yaml."""
    words: str
    """Description, with the distance between the surface and its turned copy."""


def standing_frame(vertices: np.ndarray, faces: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Rigid transform (4, 4) to a frame with z up, x along the object, the origin in its centre.

    The centre is that of mass. An axis of the inertia within 10 degrees of ``up`` (3,) replaces it,
    because an object rarely stands exactly upright in a hand.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    _, axes = np.linalg.eigh(mesh.moment_inertia)
    along = axes.T @ up
    nearest = int(np.argmax(np.abs(along)))
    z = up / np.linalg.norm(up)
    if abs(along[nearest]) > np.cos(np.radians(10.0)):
        z = axes[:, nearest] * np.sign(along[nearest])
    # the axis of least inertia among those across z: the object's longest horizontal extent
    x = next(axis for axis in axes.T if abs(axis @ z) < np.sqrt(0.5))
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ mesh.center_mass
    return pose


def propose_symmetry(vertices: np.ndarray, faces: np.ndarray) -> ProposedSymmetry:
    """Rotations about the axes of the frame that map the surface onto itself.

    The mesh is in its :func:`standing_frame`. A continuous axis is tried before turns of order
    2, 3, 4 and 6. Colours are not compared.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    points = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)[0]
    field = DistanceField(vertices, faces)

    def distance(axis: np.ndarray, angles: np.ndarray) -> float:
        """Largest of the distances that most of the surface keeps, over some angles."""
        turned = [points @ rotation_exp(angle * axis).T for angle in angles]
        return max(float(np.quantile(field.distance(p), ALIKE_SHARE)) for p in turned)

    axes = np.eye(3)[[2, 0, 1]]
    turns = np.radians(np.arange(15.0, 360.0, 30.0))
    around = [distance(axis, turns) for axis in axes]
    if max(around) < ALIKE_M:
        return ProposedSymmetry(Symmetry(sphere=True), f"sphere, {_mm(max(around))}")
    if min(around) < ALIKE_M:
        best = int(np.argmin(around))
        axis = tuple(axes[best].tolist())
        symmetry = Symmetry(continuous=(ContinuousSymmetry(axis=axis),))
        return ProposedSymmetry(symmetry, f"all turns about {'zxy'[best]}, {_mm(around[best])}")
    found = list(_discrete(axes, distance))
    matrices = tuple(tuple(matrix.ravel().round(6).tolist()) for matrix, _ in found)
    words = "; ".join(text for _, text in found) or "none"
    return ProposedSymmetry(Symmetry(discrete=matrices), words)


def _discrete(
    axes: np.ndarray, distance: Callable[[np.ndarray, np.ndarray], float]
) -> Iterator[tuple[np.ndarray, str]]:
    """Turns of the highest order about each axis, and words on them."""
    for axis, name in zip(axes, "zxy", strict=True):
        for order in reversed(ORDERS):
            angle = 2 * np.pi / order
            off = distance(axis, np.array([angle]))
            if off < ALIKE_M:
                matrix = np.eye(4)
                matrix[:3, :3] = rotation_exp(angle * axis)
                yield matrix, f"{order} turns about {name}, {_mm(off)}"
                break


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm off at {ALIKE_SHARE:.0%} of the surface"
