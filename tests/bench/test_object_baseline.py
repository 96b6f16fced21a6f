"""The paper's recipe on synthetic views of a box whose pose is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from bench.object_baseline import (
    Crops,
    Energy,
    FrameFit,
    Recipe,
    fit_by_adam,
    rotation_matrix,
)
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.geometry.rigid.twist import moved
from intercap_core.object_track.view import View, ViewGeometry
from tests.helpers.object_capture import ObjectCapture

START = np.concatenate([np.radians(10) * np.array([0.6, -0.64, 0.48]), [0.02, -0.017, 0.015]])


@pytest.fixture(scope="module")
def mesh() -> ObjectMesh:
    box = trimesh.creation.box((0.4, 0.25, 0.15))
    vertices, faces = trimesh.remesh.subdivide(box.vertices, box.faces)
    grey = np.full((len(vertices), 3), 128, np.uint8)
    none = np.zeros(0, np.int64)
    return ObjectMesh("box", vertices, faces.astype(np.int32), none, SymmetryGroup.none(), grey)


@pytest.fixture(scope="module")
def capture(mesh: ObjectMesh) -> ObjectCapture:
    return ObjectCapture.make(mesh, 2, cameras=3)


def _views(capture: ObjectCapture, t: int) -> list[View]:
    views = []
    for c, camera in enumerate(capture.rig):
        geometry = ViewGeometry.for_object(camera, capture.mesh.diameter)
        views.append(View.build(geometry, *capture.image(t, c)))
    return views


def _fit(capture: ObjectCapture, t: int, pose: np.ndarray, recipe: Recipe, steps: int) -> FrameFit:
    views, labels = _views(capture, t), ("suitcase",)
    return fit_by_adam(capture.mesh, views, pose, recipe, steps, min_overlap=0.3, labels=labels)


def _apart(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    turn = Rotation.from_matrix(a[:3, :3] @ b[:3, :3].T).magnitude()
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(np.degrees(turn))


def test_rotation_matrix_is_the_exponential() -> None:
    for vector in ([0.3, -1.1, 0.7], [0.0, 0.0, 0.0], [1e-4, 0.0, -2e-4]):
        found = rotation_matrix(torch.tensor(vector, dtype=torch.float64)).numpy()
        assert np.allclose(found, Rotation.from_rotvec(vector).as_matrix(), atol=1e-9)


@pytest.mark.parametrize(("kind", "steps"), [("overdraw", 120), ("soft", 60)])
def test_reaches_the_truth_from_3_cm_and_10_degrees(
    capture: ObjectCapture, kind: str, steps: int
) -> None:
    """Depth noise 2 mm, distractors, a post in front."""
    if kind == "overdraw":
        pytest.importorskip("deodr")
    recipe = Recipe(rasteriser=kind, learning_rate_m=2e-3, learning_rate_rad=4e-3)
    start = moved(capture.poses[0], START)
    assert _apart(start, capture.poses[0]) == pytest.approx((0.03, 10.0), rel=0.02)
    fit = _fit(capture, 0, start, recipe, steps)
    assert len(fit.poses) == len(fit.seconds) == steps + 1
    shift, turn = _apart(fit.poses[-1], capture.poses[0])
    assert shift < 0.004 and turn < 1.0


def test_nothing_seen_leaves_the_pose(capture: ObjectCapture) -> None:
    away = capture.poses[0].copy()
    away[:3, 3] += 1.5  # no candidate overlaps
    fit = _fit(capture, 0, away, Recipe(), 5)
    assert np.array_equal(fit.poses, away[None])


def test_crops_hold_the_true_mask_and_depth(mesh: ObjectMesh, capture: ObjectCapture) -> None:
    """At the true pose nearly every mask pixel is drawn, and measured depth is the drawn one."""
    pose = capture.poses[0]
    crops = Crops.cut(mesh, _views(capture, 0), pose, 0.3, ("suitcase",))
    assert crops is not None and len(np.unique(crops.pixels.view)) == len(capture.rig)
    assert (crops.depth > 0).mean() > 0.2
    silhouette = Energy(mesh, crops, pose, Recipe(rasteriser="soft", depth_weight=0.0))
    place = torch.tensor(pose[:3, 3], dtype=torch.float32)
    assert float(silhouette(torch.zeros(3), place)) < 0.06 * len(crops.depth)
    robust = Recipe(rasteriser="soft", depth_scale_m=0.02, depth_weight=1 / 0.02**2)
    whole = Energy(mesh, crops, pose, robust)
    outliers = float(whole(torch.zeros(3), place) - silhouette(torch.zeros(3), place))
    assert outliers < 0.1 * (crops.depth > 0).sum()
