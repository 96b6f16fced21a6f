"""The backends behind one interface: the CPU's against single images, warp's against the CPU's."""

import sys

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.errors import UserError
from intercap_core.geometry.rigid.distance import OcclusionScene
from intercap_core.geometry.rigid.render import (
    CpuRenderer,
    Renderer,
    default_renderer,
    open_renderer,
    render,
)
from intercap_core.geometry.rigid.shots import Shot, Surface
from tests.geometry.rigid.test_render import LENS, PINHOLE

BOUNDARY_PX = 2  # of an image, where fused multiplications may decide otherwise
DEPTH_M = 1e-4


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


@pytest.fixture(scope="module")
def warp_renderer() -> Renderer:
    pytest.importorskip("warp", reason="warp is not installed (pip install 'intercap-core[gpu]')")
    from intercap_core.geometry.rigid.render_warp import WarpRenderer

    return WarpRenderer("cpu")


@pytest.mark.parametrize("threads", [1, 3])
def test_cpu_batches_are_the_single_images(objects, threads):
    mesh, shots = objects["stool"], _shots(9)
    images = CpuRenderer(threads).draw(Surface.of(mesh), shots, margin_px=3)
    for shot, image in zip(shots, images, strict=True):
        one = render(mesh.vertices, mesh.faces, shot.lens, shot.camera_from_mesh, margin_px=3)
        assert (image.x0, image.y0, image.area) == (one.x0, one.y0, one.mask.sum())
        for name in ("depth", "face", "body"):
            np.testing.assert_array_equal(getattr(image, name), getattr(one, name))
    assert images[-3].area > 0 and images[-2].area == 0 and images[-1].area == 0


@pytest.mark.parametrize("name", ["cup", "tennis_racquet", "chair"])
def test_warp_draws_what_the_cpu_draws(objects, warp_renderer, name):
    surface, shots = Surface.of(objects[name]), _shots(10, seed=3)
    ours = CpuRenderer().draw(surface, shots, margin_px=1)
    for one, two in zip(ours, warp_renderer.draw(surface, shots, margin_px=1), strict=True):
        assert (one.x0, one.y0, one.face.shape) == (two.x0, two.y0, two.face.shape)
        assert (one.mask != two.mask).sum() <= BOUNDARY_PX
        assert (one.face != two.face).sum() <= 2 * BOUNDARY_PX
        both = one.mask & two.mask
        assert np.abs(one.depth - two.depth)[both].max(initial=0) < DEPTH_M
        assert np.array_equal(two.body >= 0, two.mask) and (two.depth[~two.mask] == 0).all()


def test_warp_draws_open_surfaces_from_both_sides(warp_renderer):
    sheet = trimesh.creation.box((0.4, 0.3, 0.01))
    surface = Surface(np.asarray(sheet.vertices), np.asarray(sheet.faces)[:6], cull_back=False)
    shots = _shots(6, seed=4)
    for one, two in zip(
        CpuRenderer().draw(surface, shots), warp_renderer.draw(surface, shots), strict=True
    ):
        assert (one.mask != two.mask).sum() <= BOUNDARY_PX


def test_warp_repeats_and_takes_no_shots(objects, warp_renderer):
    surface, shots = Surface.of(objects["cup"]), _shots(5)
    one, two = (warp_renderer.draw(surface, shots) for _ in range(2))
    assert all(np.array_equal(a.depth, b.depth) for a, b in zip(one, two, strict=True))
    assert warp_renderer.draw(surface, []) == []


@pytest.mark.parametrize("backend", ["cpu", "warp"])
def test_visible_vertices(objects, backend, request):
    renderer = CpuRenderer() if backend == "cpu" else request.getfixturevalue("warp_renderer")
    mesh, shots = objects["stool"], _shots(6, seed=5)
    seen = renderer.visible(Surface.of(mesh), shots)
    rays = OcclusionScene(mesh.vertices, mesh.faces)
    for shot, found in zip(shots, seen, strict=True):
        expected = rays.visible(shot.lens, shot.camera_from_mesh)
        assert (found != expected).mean() < 0.002
    assert 0.1 < seen[0].mean() < 0.6 and not seen[-1].any()


def test_device_is_chosen_and_its_absence_told(monkeypatch):
    assert open_renderer("cpu", threads=2).pool.threads == 2
    monkeypatch.setitem(sys.modules, "warp", None)
    monkeypatch.delitem(sys.modules, "intercap_core.geometry.rigid.render_warp", raising=False)
    monkeypatch.delattr("intercap_core.geometry.rigid.render_warp", raising=False)
    assert open_renderer("auto").device == "cpu"
    with pytest.raises(UserError, match=r"intercap-core\[gpu\]"):
        open_renderer("cuda")


def test_a_missing_gpu_is_told():
    warp = pytest.importorskip("warp", reason="warp is not installed")
    if warp.get_cuda_device_count():
        assert open_renderer("auto").device == "cuda:0"
        return
    assert open_renderer("auto").device == "cpu"
    with pytest.raises(UserError, match="no such device"):
        open_renderer("cuda")


def test_threads_of_the_job(monkeypatch):
    default_renderer.cache_clear()
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert default_renderer().pool.threads == 2
    default_renderer.cache_clear()
