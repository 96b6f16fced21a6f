"""The bench of a fit's growth: its scene is fitted to the truth, its figures are all there."""

import numpy as np
import pytest

from bench import object_scaling
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import CpuRenderer
from tests.geometry.rigid.conftest import catalogue


@pytest.fixture(scope="module")
def mesh() -> ObjectMesh:
    return ObjectMesh.load(catalogue()["toolbox"])


def test_the_scene_is_fitted_to_its_true_pose(mesh):
    scene = object_scaling.Scene.make(object_scaling.with_faces(mesh, 600), 4)
    pose = scene.fit(CpuRenderer())
    np.testing.assert_allclose(pose, scene.pose, atol=2e-3)


def test_meshes_have_the_faces_asked_for(mesh):
    for count in (150, 10_000):
        assert len(object_scaling.with_faces(mesh, count).faces) == pytest.approx(count, rel=0.05)


def test_every_size_has_its_figure(mesh, monkeypatch):
    sizes = {"VIEWS": (1, 2), "FACES": (150,), "STEPS": (4,), "SHOTS": (2,), "REPEATS": 1}
    for name, value in sizes.items():
        monkeypatch.setattr(object_scaling, name, value)
    figures = object_scaling.tracking_scaling(mesh)
    wanted = {"fit_ms_views_1", "fit_ms_views_2", "fit_ms_faces_150", "fit_ms_step_4"}
    assert wanted | {"fit_ms_threads_2", "draw_ms_cpu_2_images"} <= set(figures)
    assert all(value > 0 for value in figures.values())
