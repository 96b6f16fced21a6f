"""Terms of equation 1: finite differences, and compiled against readable forms."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render
from intercap_core.object_track import object_depth, object_silhouette
from tests.geometry.rigid.conftest import catalogue
from tests.geometry.rigid.test_render import LENS
from tests.helpers.synthetic_capture import COLOUR

RNG = np.random.default_rng(5)
HALF_LENS = COLOUR.scaled(0.5)
STEPS = np.eye(6) * 1e-6
MASTER = rigid(  # master_from_camera
    Rotation.from_rotvec([0.2, -0.4, 0.1]).as_matrix(), np.array([0.3, 0.1, -0.2])
)


def _pose(shift=(0, 0, 0), turn=(0, 0, 0)):
    turned = Rotation.from_rotvec(np.add((0.4, 0.8, -0.3), turn))
    return rigid(turned.as_matrix(), np.add((0.25, -0.1, 1.8), shift))


def depth_residuals(observed, hit, normals, origin):
    """Point-to-plane residuals n . (observed - hit) (N,) and their Jacobian (N, 6), metres."""
    gap = np.einsum("ij,ij->i", normals, observed - hit)
    # d/dw [exp(w) n . (p - X')] = n x (p - X) - (X - o) x n = n x (p - o)
    turn = np.cross(normals, observed - origin)
    return gap, np.concatenate([turn, -normals], axis=1)


def silhouette_residuals(points, targets, lens, camera_from_master, origin):
    """Distances of projected points from targets (N,), pixels, and their Jacobian (N, 6)."""
    rotation = camera_from_master[:3, :3]
    in_camera = points @ rotation.T + camera_from_master[:3, 3]
    projected, by_point = lens.project_with_jacobian(in_camera)
    offset = projected - targets
    distance = np.linalg.norm(offset, axis=1)
    direction = offset / np.maximum(distance, 1e-9)[:, None]
    along = np.einsum("ni,nij->nj", direction, by_point) @ rotation
    return distance, np.concatenate([np.cross(points - origin, along), along], axis=1)


def rim_mask(mask):
    """Pixels (h, w) of a mask that touch its outside; it continues beyond the window."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    eroded = cv2.erode(mask.astype(np.uint8), cross, borderType=cv2.BORDER_REPLICATE)
    return mask & (eroded == 0)


@pytest.fixture(scope="module")
def renders():
    """Two renderings of a chair; the second one is the measurement."""
    mesh = ObjectMesh.load(catalogue()["chair"])
    there = _pose((0.01, 0.006, 0.012), (0.02, 0.03, -0.02))
    return mesh, *(render(mesh.vertices, mesh.faces, LENS, pose) for pose in (_pose(), there))


def _move(points, origin, step):
    return (points - origin) @ Rotation.from_rotvec(step[:3]).as_matrix().T + origin + step[3:]


def test_depth_jacobian_against_finite_differences():
    observed, hit = RNG.normal(size=(2, 40, 3)) + np.array([0, 0, 3.0])
    normals = RNG.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    origin = RNG.normal(size=3) + np.array([0, 0, 3.0])

    def value(step):
        turned = normals @ Rotation.from_rotvec(step[:3]).as_matrix().T
        return depth_residuals(observed, _move(hit, origin, step), turned, origin)[0]

    _, jacobian = depth_residuals(observed, hit, normals, origin)
    np.testing.assert_allclose(jacobian, _numeric(value), atol=1e-8)


def test_silhouette_jacobian_against_finite_differences():
    points = RNG.normal(size=(40, 3)) * 0.3 + (0, 0, 2.5)
    camera = rigid(Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix(), np.array([0.1, -0.2, 0.3]))
    targets = HALF_LENS.project(points @ camera[:3, :3].T + camera[:3, 3])
    targets = targets + RNG.normal(size=targets.shape) * 6
    origin = np.array([0.1, 0.0, 2.4])

    def value(step):
        moved = _move(points, origin, step)
        return silhouette_residuals(moved, targets, HALF_LENS, camera, origin)[0]

    _, jacobian = silhouette_residuals(points, targets, HALF_LENS, camera, origin)
    numeric = _numeric(value)
    np.testing.assert_allclose(jacobian, numeric, atol=1e-5 * np.abs(numeric).max())


def test_the_rim_excludes_the_image_edge():
    mask = np.zeros((9, 12), bool)
    mask[2:6, 5:] = True
    expected = np.zeros_like(mask)
    expected[2, 5:] = expected[5, 5:] = expected[2:6, 5] = True
    pixels, _ = object_silhouette.rim_pixels(mask)
    np.testing.assert_array_equal(pixels, np.argwhere(expected)[:, ::-1])


def _check_sums(hessian, gradient, jacobian, residual, scale, trust, rtol):
    """Compare the compiled sums with those of Geman-McClure weighted rows."""
    weight = trust * (scale**2 / (scale**2 + residual**2)) ** 2
    for found, right in ((hessian, jacobian), (gradient, residual)):
        expected = (jacobian * weight[:, None]).T @ right
        atol = 0.1 * rtol * np.abs(expected).max()
        np.testing.assert_allclose(found, expected, rtol=rtol, atol=atol)


def _numeric(value):
    """Central differences (N, 6) of a function of the step."""
    return np.stack([(value(s) - value(-s)) / 2e-6 for s in STEPS], 1)


def _measurements(image):
    """Measured depth (H, W) in the whole image, and the points it measures, master frame."""
    depth = np.zeros((LENS.height, LENS.width), np.float32)
    depth[image.window] = image.depth
    local = np.concatenate([LENS.rays * depth[..., None], depth[..., None]], -1)
    return depth, (local @ MASTER[:3, :3].T + MASTER[:3, 3]).astype(np.float32)


def test_the_compiled_depth_term_equals_the_readable_one(renders):
    mesh, image, other = renders
    measured, points = _measurements(other)
    trust = RNG.uniform(size=measured.shape).astype(np.float32)
    trust[::3] = 0
    pose = MASTER @ _pose()
    gate, scale = 0.04, 0.015
    hessian, gradient, count = object_depth.normal_equations(
        image.depth, image.face, (image.x0, image.y0), measured, points, trust,
        mesh.face_normals, pose[:3, :3], pose[:3, 3], MASTER[:3, 3], gate, scale,
    )  # fmt: skip
    here = (slice(image.y0, None), slice(image.x0, None))
    near = image.mask & (measured[image.window] > 0) & (trust[image.window] > 0)
    near &= np.abs(measured[image.window] - image.depth.astype(float)) < gate
    v, u = np.nonzero(near)
    observed = points[here][v, u].astype(float)
    rays = np.column_stack([LENS.rays[here][v, u], np.ones(len(u))]).astype(float)
    hit = (rays * image.depth[v, u, None]) @ MASTER[:3, :3].T + MASTER[:3, 3]
    normals = mesh.face_normals[image.face[v, u]] @ pose[:3, :3].T
    residual, jacobian = depth_residuals(observed, hit, normals, pose[:3, 3])
    assert count == len(u) > 300
    _check_sums(hessian, gradient, jacobian, residual, scale, trust[here][v, u], 1e-4)
    gap, across, where = object_depth.matches(
        image.depth, image.face, (image.x0, image.y0), measured, points, mesh.face_normals,
        pose[:3, :3], MASTER[:3, 3],
    )  # fmt: skip
    kept = (np.abs(gap) < gate) & (trust[where[:, 1], where[:, 0]] > 0)
    np.testing.assert_allclose(across[kept], np.abs(residual), atol=1e-6)


def test_compiled_rims_and_nearest_pixels():
    mask = cv2.GaussianBlur(RNG.normal(size=(60, 80)), (0, 0), 4) > 0
    pixels, starts = object_silhouette.rim_pixels(mask)
    expected = np.argwhere(rim_mask(mask))[:, ::-1]
    np.testing.assert_array_equal(pixels, expected)
    np.testing.assert_array_equal(np.diff(starts), np.bincount(expected[:, 1], minlength=60))
    for x, y in RNG.integers(-10, 90, size=(300, 2)):
        distance = np.linalg.norm(pixels - (x, y), axis=1)
        for limit in (4.0, 1e3):
            index = object_silhouette.nearest(pixels, starts, x, y, limit)
            if 0 <= y < 60 or index >= 0:
                assert (index < 0) == (distance.min() >= limit)
            if index >= 0:
                assert distance[index] == distance.min()


def test_the_compiled_silhouette_term_equals_the_readable_one(renders):
    _, image, other = renders
    left, top = min(image.x0, other.x0) - 5, min(image.y0, other.y0) - 5
    shape = (max(image.y0, other.y0) + 400 - top, max(image.x0, other.x0) + 400 - left)
    inside, drawn = np.zeros(shape, bool), np.zeros(shape, bool)
    for target, source in ((inside, other), (drawn, image)):
        y, x = np.nonzero(source.mask)
        target[y + source.y0 - top, x + source.x0 - left] = True
    person = np.zeros(shape, bool)
    person[: shape[0] // 3] = True
    person &= ~inside
    border, starts = object_silhouette.rim_pixels(inside)
    limit, scale, corner = 9.0, 5.0, (image.x0, image.y0)
    at, target, missed, size = object_silhouette.correspondences(
        image.face, corner, inside, person, (left, top), border, border, starts, True, limit, 12
    )
    own = np.argwhere(rim_mask(drawn))[:, ::-1]
    assert size == len(own) and 0 < missed < len(at)

    def reach(points, others):
        distance = np.linalg.norm(points[:, None] - others[None], axis=2).min(1)
        return np.sort(distance[distance < limit])

    outside = own[~inside[own[:, 1], own[:, 0]] & ~person[own[:, 1], own[:, 0]]]
    lengths = np.linalg.norm(at - target, axis=1)
    misses = border[~drawn[border[:, 1], border[:, 0]]]
    np.testing.assert_allclose(np.sort(lengths[:missed]), reach(misses, own))
    np.testing.assert_allclose(np.sort(lengths[missed:]), reach(outside, border))

    origin = (MASTER @ _pose())[:3, 3]
    hessian, gradient, residuals = object_silhouette.normal_equations(
        at, target, image.depth, corner, LENS.rays, LENS.parameters, MASTER, origin, scale
    )
    z = image.depth[at[:, 1] - image.y0, at[:, 0] - image.x0].astype(float)
    local = np.column_stack([LENS.rays[at[:, 1], at[:, 0]] * z[:, None], z])
    points = local @ MASTER[:3, :3].T + MASTER[:3, 3]
    residual, jacobian = silhouette_residuals(
        points, target.astype(float), LENS, np.linalg.inv(MASTER), origin
    )
    np.testing.assert_allclose(residuals, residual, atol=1e-3)
    _check_sums(hessian, gradient, jacobian, residual, scale, 1.0, 1e-3)


def test_rim_points_are_kept_before_measured_background(renders):
    _, image, _ = renders
    at = np.argwhere(rim_mask(image.mask))[:, ::-1] + (image.x0, image.y0)
    at = at.astype(np.int32)
    measured = np.zeros((LENS.height, LENS.width), np.float32)
    measured[:, ::2] = image.depth.max() + 0.5
    measured[:, 1::4] = image.depth[image.mask].min() - 0.1
    clear = object_silhouette.sees_past(
        at, image.depth, (image.x0, image.y0), LENS.rays, np.eye(4), LENS.parameters, measured,
        (0, 0), 0.03,
    )  # fmt: skip
    np.testing.assert_array_equal(clear, at[:, 0] % 4 != 1)
