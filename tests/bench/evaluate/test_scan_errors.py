"""Alignment of scans and their distances, in cases worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from bench.evaluate.scan_errors import (
    Mesh,
    ScanErrors,
    TrackErrors,
    align,
    distances,
    figures,
)
from intercap_core.geometry.camera.transforms import apply, rigid
from intercap_core.studio.objects import true_mesh
from tests.helpers.fitted_capture import object_entry

MOVED = rigid(Rotation.from_rotvec([1.9, -0.8, 1.1]).as_matrix(), np.array([0.3, -1.2, 2.0]))


def _sphere(radius: float) -> Mesh:
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return Mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces))


def _errors(scan: Mesh, truth: Mesh, name: str = "cup") -> ScanErrors:
    aligned = scan.moved(align(scan, truth))
    return ScanErrors(name, *distances(aligned, truth), scan.is_watertight)


def test_concentric_spheres_are_apart_by_the_difference_of_their_radii() -> None:
    errors = _errors(_sphere(0.102).moved(MOVED), _sphere(0.100))
    assert errors.chamfer == pytest.approx(0.002, rel=0.01)
    assert errors.p95 == pytest.approx(0.002, rel=0.05)


def test_a_turned_and_shifted_copy_has_no_error() -> None:
    vertices, faces, _ = true_mesh(object_entry("chair"), 9201)
    truth = Mesh(vertices, faces)
    scan = truth.moved(MOVED)
    np.testing.assert_allclose(apply(align(scan, truth), scan.vertices), vertices, atol=2e-4)
    assert _errors(scan, truth).chamfer < 5e-5


def test_noise_and_a_missing_handle_appear_in_the_distances() -> None:
    """Stand-in for a scan: the true cup with noise of 0.5 mm, in another frame, without its handle
    (closed over)."""
    vertices, faces, _ = true_mesh(object_entry("cup"), 9201)
    truth = Mesh(vertices, faces)
    noise = np.random.default_rng(1).normal(0, 0.0005, vertices.shape)
    noisy = Mesh(vertices + noise, faces).moved(MOVED)
    aligned = noisy.moved(align(noisy, truth))
    errors = ScanErrors("cup", *distances(aligned, truth), aligned.is_watertight)
    assert errors.watertight
    assert 0.0001 < errors.chamfer < 0.0006
    handle = (vertices[faces][:, :, 0] > 0.042).any(1)
    rest = trimesh.Trimesh(aligned.vertices, faces[~handle])
    rest.fill_holes()
    closed = Mesh(np.asarray(rest.vertices), np.asarray(rest.faces))
    without = ScanErrors("cup", *distances(closed, truth))
    assert without.to_scan.max() > 0.02 > 0.005 > without.to_truth.max()
    assert without.to_scan.mean() > 1.5 * errors.to_scan.mean()


def test_figures_are_means_over_objects_and_a_geometric_mean_of_ratios() -> None:
    def scan(size: float, *ratios: float) -> ScanErrors:
        tracks = [TrackErrors(np.full(5, 0.004), np.full(5, 0.004 * r)) for r in ratios]
        return ScanErrors("cup", np.full(4, size), np.full(4, 3 * size), True, "", tracks)

    failed = ScanErrors("chair", np.zeros(0), np.zeros(0), problem="not seen")
    found = figures([scan(0.001, 1.0, 2.0), scan(0.003, 4.0), failed])
    assert found == pytest.approx(
        {
            "solved_share": 2 / 3,
            "watertight_share": 2 / 3,
            "chamfer_mm": 4.0,
            "p95_mm": 6.0,
            "object_ratio": 2.0,
        }
    )
    assert figures([]) == {}
    assert "chamfer_mm" not in figures([failed])
