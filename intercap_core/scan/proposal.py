"""Frame and symmetry of a scanned mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from intercap_core.entries import ContinuousSymmetry, Symmetry
from intercap_core.geometry.camera.transforms import rigid, rotation_exp
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

    def distance(rotation: np.ndarray) -> float:
        """Distance within which most of the turned surface is, metres."""
        return float(np.quantile(field.distance(points @ rotation.T), ALIKE_SHARE))

    axes = np.eye(3)[[2, 0, 1]]
    turns = np.radians(np.arange(15.0, 360.0, 30.0))
    around = [max(distance(rotation_exp(turn * axis)) for turn in turns) for axis in axes]
    if max(around) < ALIKE_M:
        return ProposedSymmetry(Symmetry(sphere=True), f"sphere, {_mm(max(around))}")
    if min(around) < ALIKE_M:
        best = int(np.argmin(around))
        axis = tuple(axes[best].tolist())
        symmetry = Symmetry(continuous=(ContinuousSymmetry(axis=axis),))
        return ProposedSymmetry(symmetry, f"all turns about {'zxy'[best]}, {_mm(around[best])}")
    turns_found, nearest = [], (np.inf, "")
    for axis, name in zip(axes, "zxy", strict=True):
        for order in reversed(ORDERS):
            rotation = rotation_exp(2 * np.pi / order * axis)
            off = distance(rotation)
            text = f"{order} turns about {name}, {_mm(off)}"
            nearest = min(nearest, (off, text))
            if off < ALIKE_M:
                turns_found.append((rotation, text))
                break
    if not turns_found:
        return ProposedSymmetry(Symmetry(), f"none; the nearest is {nearest[1]}")
    matrices = [rigid(rotation, np.zeros(3)).ravel().round(6) for rotation, _ in turns_found]
    symmetry = Symmetry(discrete=tuple(tuple(matrix.tolist()) for matrix in matrices))
    return ProposedSymmetry(symmetry, "; ".join(text for _, text in turns_found))


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm off at {ALIKE_SHARE:.0%} of the surface"
