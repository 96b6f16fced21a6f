"""Rendering against closed forms, projected vertices and an independent ray caster."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.open3d_core import o3d
from intercap_core.geometry.rigid.render import (
    Renderer,
    default_renderer,
    render,
    render_scene,
)
from intercap_core.geometry.rigid.shots import Drawable, Shot, Surface

PINHOLE = Intrinsics(640, 576, 504.0, 505.0, 321.3, 287.6)
LENS = Intrinsics(  # a Kinect's colour lens at half size: strong rational distortion
    960, 540, 456.0, 456.5, 478.2, 272.4,
    np.array([0.45, -2.6, 1e-3, -4e-4, 1.43, 0.33, -2.42, 1.36]),
)  # fmt: skip


def _pose(translation, rotation_vector=(0, 0, 0)):
    return rigid(Rotation.from_rotvec(rotation_vector).as_matrix(), np.array(translation))


@pytest.mark.parametrize("lens", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_sphere_depth_and_outline(lens):
    """Radius 110 mm; 82 k triangles lie up to 0.02 mm inside the true sphere."""
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.11)
    centre = np.array([0.35, -0.25, 1.7])
    image = render(ball.vertices, ball.faces, lens, _pose(centre))
    rays = lens.rays[image.window].astype(float)
    rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], -1)
    a, b = (rays**2).sum(-1), rays @ centre
    root = b**2 - a * (centre @ centre - 0.11**2)
    expected = (b - np.sqrt(np.maximum(root, 0))) / a
    miss = np.sqrt(centre @ centre - b**2 / a)  # distance of the ray from the centre
    assert image.mask[miss < 0.1098].all() and not image.mask[miss > 0.11].any()
    inner = miss < 0.100
    assert np.abs(image.depth - expected)[inner].max() < 1e-4
    assert image.mask.sum() > 1500 and (image.depth[~image.mask] == 0).all()


@pytest.mark.parametrize("name", ["stool", "tennis_racquet", "cup"])
def test_equals_an_independent_ray_caster(objects, name):
    mesh = objects[name]
    pose = _pose((0.3, -0.2, 1.4), (0.7, -0.4, 0.9))
    image = render(mesh.vertices, mesh.faces, LENS, pose, margin_px=5)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    rows, columns = image.window
    v, u = np.mgrid[rows, columns]
    rays = LENS.unproject(np.stack([u, v], -1)) @ pose[:3, :3]
    eye = np.broadcast_to(-pose[:3, :3].T @ pose[:3, 3], rays.shape)
    answer = scene.cast_rays(o3d.core.Tensor(np.concatenate([eye, rays], -1).astype(np.float32)))
    depth = answer["t_hit"].numpy()
    hit = np.isfinite(depth)
    assert (hit != image.mask).mean() < 1e-3
    both = hit & image.mask
    close = np.abs(depth - image.depth)[both] < 1e-5
    assert close.mean() > 0.998


@pytest.mark.parametrize("corner", [(-0.7, -0.4), (0.75, 0.35), (0.1, 0.4)])
def test_large_triangles_bend_as_the_lens_bends_them(corner):
    """Twelve triangles of hundreds of pixels cover what thousands of small ones do."""
    box = trimesh.creation.box((0.5, 0.35, 0.2))
    vertices, faces = np.asarray(box.vertices), np.asarray(box.faces)
    for turn in (0.0, 0.5, 1.1):
        pose = _pose((*corner, 1.1), (turn, 0.4 - turn, 0.7 * turn))
        few = render(vertices, faces, LENS, pose, margin_px=8)
        fine = render(*trimesh.remesh.subdivide_to_size(vertices, faces, 0.03), LENS, pose)
        assert fine.mask.sum() > 10_000
        assert (few.full_mask(LENS) != fine.full_mask(LENS)).sum() <= 4


def test_nearer_mesh_hides_the_farther():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    near = Drawable(ball.vertices, ball.faces, _pose((0, 0, 1.0)))
    far = Drawable(ball.vertices, ball.faces, _pose((0.2, 0, 2.0)))
    for order in ([near, far], [far, near]):
        image = render_scene(order, PINHOLE)
        number = order.index(near)
        alone = render(ball.vertices, ball.faces, PINHOLE, near.camera_from_mesh)
        assert (image.body == number).sum() == alone.mask.sum()
    assert (image.body == order.index(far)).sum() > 0


def _shots(count: int, seed: int = 0) -> list[Shot]:
    """Two lenses, poses all around; the last three partly, and wholly, out of view."""
    rng = np.random.default_rng(seed)
    shots = []
    for number in range(count):
        place = rng.uniform((-0.4, -0.3, 1.2), (0.4, 0.3, 2.6))
        pose = rigid(Rotation.random(rng=rng).as_matrix(), place)
        shots.append(Shot(LENS if number % 2 else PINHOLE, pose))
    shots[-1].camera_from_mesh[:3, 3] = 0, 0, -2
    shots[-2].camera_from_mesh[:3, 3] = 6, 0, 2
    shots[-3].camera_from_mesh[:3, 3] = 0.9, 0.5, 1.5
    return shots


@pytest.mark.parametrize("threads", [1, 3])
def test_batches_equal_single_images(objects, threads):
    mesh, shots = objects["stool"], _shots(9)
    images = Renderer(threads).draw(Surface.of(mesh), shots, margin_px=3)
    for shot, image in zip(shots, images, strict=True):
        one = render(mesh.vertices, mesh.faces, shot.lens, shot.camera_from_mesh, margin_px=3)
        assert (image.x0, image.y0, image.area) == (one.x0, one.y0, one.mask.sum())
        for name in ("depth", "face", "body"):
            np.testing.assert_array_equal(getattr(image, name), getattr(one, name))
    assert images[-3].area > 0 and images[-2].area == 0 and images[-1].area == 0


def test_threads_of_the_job(monkeypatch):
    default_renderer.cache_clear()
    monkeypatch.setenv("INTERCAP_THREADS", "2")
    assert default_renderer().pool.threads == 2
    default_renderer.cache_clear()
