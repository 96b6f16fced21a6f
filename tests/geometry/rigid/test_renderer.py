"""Batches of images against single images, visible vertices against rays, and the device."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.errors import UserError
from intercap_core.geometry.rigid.distance import OcclusionScene
from intercap_core.geometry.rigid.render import (
    Renderer,
    default_renderer,
    open_renderer,
    render,
)
from intercap_core.geometry.rigid.shots import Shot, Surface
from tests.geometry.rigid.test_render import LENS, PINHOLE


def _shots(count: int, seed: int = 0) -> list[Shot]:
    """Two lenses, poses all around; the last three partly, and wholly, out of view."""
    rng = np.random.default_rng(seed)
    shots = []
    for number in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
        pose[:3, 3] = rng.uniform((-0.4, -0.3, 1.2), (0.4, 0.3, 2.6))
        shots.append(Shot(LENS if number % 2 else PINHOLE, pose))
    shots[-1].camera_from_mesh[:3, 3] = 0, 0, -2
    shots[-2].camera_from_mesh[:3, 3] = 6, 0, 2
    shots[-3].camera_from_mesh[:3, 3] = 0.9, 0.5, 1.5
    return shots


@pytest.mark.parametrize("threads", [1, 3])
def test_cpu_batches_are_the_single_images(objects, threads):
    mesh, shots = objects["stool"], _shots(9)
    images = Renderer(threads).draw(Surface.of(mesh), shots, margin_px=3)
    for shot, image in zip(shots, images, strict=True):
        one = render(mesh.vertices, mesh.faces, shot.lens, shot.camera_from_mesh, margin_px=3)
        assert (image.x0, image.y0, image.area) == (one.x0, one.y0, one.mask.sum())
        for name in ("depth", "face", "body"):
            np.testing.assert_array_equal(getattr(image, name), getattr(one, name))
    assert images[-3].area > 0 and images[-2].area == 0 and images[-1].area == 0


def test_visible_vertices(objects):
    renderer = Renderer()
    mesh, shots = objects["stool"], _shots(6, seed=5)
    seen = renderer.visible(Surface.of(mesh), shots)
    rays = OcclusionScene(mesh.vertices, mesh.faces)
    for shot, found in zip(shots, seen, strict=True):
        expected = rays.visible(shot.lens, shot.camera_from_mesh)
        assert (found != expected).mean() < 0.002
    assert 0.1 < seen[0].mean() < 0.6 and not seen[-1].any()


def test_a_gpu_is_refused_with_the_setting_to_change():
    assert open_renderer("cpu", threads=2).pool.threads == 2
    assert open_renderer("auto", threads=1).pool.threads == 1
    with pytest.raises(UserError, match=r"set object_track\.render_on: cpu"):
        open_renderer("cuda")


def test_threads_of_the_job(monkeypatch):
    default_renderer.cache_clear()
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert default_renderer().pool.threads == 2
    default_renderer.cache_clear()
