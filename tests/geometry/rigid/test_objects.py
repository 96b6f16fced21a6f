"""The committed meshes: closed, of true size, with plausible contact vertices."""

import numpy as np
import pytest
import trimesh

from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.surfaces import vertex_normals
from intercap_core.studio.objects import true_mesh
from tests.geometry.rigid.conftest import CONFIG, catalogue

SIZES_M = {  # outer size along x, y, z in the standing pose
    "suitcase": (0.40, 0.22, 0.55),
    "skateboard": (0.80, 0.20, 0.157),
    "football": (0.22, 0.22, 0.22),
    "umbrella": (0.14, 0.072, 0.90),
    "tennis_racquet": (0.257, 0.04, 0.685),
    "toolbox": (0.40, 0.20, 0.20),
    "chair": (0.42, 0.50, 0.86),
    "bottle": (0.07, 0.07, 0.26),
    "cup": (0.116, 0.08, 0.095),
    "stool": (0.365, 0.365, 0.45),
}
NAMES = sorted(SIZES_M)


@pytest.mark.parametrize("name", NAMES)
def test_mesh_is_closed_outward_and_of_true_size(objects, name):
    mesh = objects[name]
    peer = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert mesh.watertight and peer.is_watertight and peer.is_winding_consistent
    assert peer.volume > 0 and peer.body_count == 1
    assert 342 <= len(mesh.vertices) <= 4000
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), SIZES_M[name], atol=0.009)
    for centre in (0, peer.center_mass):
        np.testing.assert_allclose(mesh.centre_of_mass, centre, atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_symmetry_maps_the_surface_onto_itself(objects, name):
    mesh = objects[name]
    field = DistanceField(mesh.vertices, mesh.faces)
    for element in mesh.symmetry.elements(7):
        moved = mesh.vertices @ element[:3, :3].T + element[:3, 3]
        assert field.distance(moved).max() < 0.0025


@pytest.mark.parametrize("name", NAMES)
def test_contact_vertices_are_where_people_touch(objects, name):
    mesh = objects[name]
    touched = mesh.vertices[mesh.contact_vertices]
    normals = vertex_normals(mesh.vertices, mesh.faces)[mesh.contact_vertices]
    bottom, top = mesh.vertices[:, 2].min(), mesh.vertices[:, 2].max()
    height = touched[:, 2] - bottom
    assert len(touched) >= 100
    if name == "suitcase":  # the handles alone, on top and at the side
        assert ((height > 0.50) | (touched[:, 0] > 0.17)).all()
        assert (height > 0.545).any() and (touched[:, 0] > 0.20).any()
    if name in ("chair", "stool"):  # the seat's top is at 45 cm
        seat = (normals[:, 2] > 0.8) & (np.abs(height - 0.45) < 0.01)
        assert seat.sum() > 50
        assert height.min() > 0.1
    if name == "skateboard":
        assert (normals[:, 2] > 0.7).mean() > 0.4 and height.min() > 0.08
    if name == "cup":  # rim and handle, never the hollow's floor
        assert top - touched[:, 2].max() < 1e-6
        assert touched[:, 0].max() > mesh.vertices[:, 0].max() - 1e-6
        deep = (np.hypot(*touched[:, :2].T) < 0.03) & (height < 0.08)
        assert not deep.any()
    if name == "tennis_racquet":
        assert ((height < 0.19) | (height > 0.59)).all() and (height < 0.15).any()
    if name == "umbrella":
        assert (height > 0.43).all() and (height > 0.85).any()


@pytest.mark.parametrize(("name", "height"), [("suitcase", 0.5285), ("toolbox", 0.1545)])
def test_fingers_fit_through_the_handle(objects, name, height):
    """A 22 mm thick finger passes under the grip, across the handle."""
    mesh = objects[name]
    inside_gap = (0, 0, mesh.vertices[:, 2].min() + height)
    field = DistanceField(mesh.vertices, mesh.faces)
    path = np.array(inside_gap) + np.linspace(-0.05, 0.05, 21)[:, None] * np.array([0, 1, 0])
    assert field.signed_distance(path).min() > 0.011
    above = np.add(inside_gap, (0, 0, 0.08))
    assert field.signed_distance(above[None])[0] > 0
    between = np.linspace(inside_gap, above, 200)
    assert field.inside(between).any(), "there is a grip above the gap"


def test_cup_is_hollow_and_its_handle_has_a_gap(objects):
    mesh = objects["cup"]
    field = DistanceField(mesh.vertices, mesh.faces)
    floor = mesh.vertices[:, 2].min() + 0.007
    hollow = [(0, 0, floor + 0.002), (0, 0, 0.02), (0.03, 0, 0.0)]
    assert not field.inside(np.array(hollow)).any()
    gap = np.array([[mesh.vertices[:, 0].max() - 0.02, 0, 0.011]])
    assert field.signed_distance(gap)[0] > 0.008


@pytest.mark.parametrize("name", ["chair", "cup", "football"])
def test_the_true_mesh_differs_slightly(objects, name):
    entry, mesh = catalogue()[name], objects[name]
    vertices, faces, colours = true_mesh(entry, 5)
    again = true_mesh(entry, 5)
    other = true_mesh(entry, 6)
    assert all(np.array_equal(a, b) for a, b in zip((vertices, faces, colours), again, strict=True))
    assert not np.array_equal(vertices, other[0])
    assert len(faces) == 4 * len(mesh.faces) and len(colours) == len(vertices)
    peer = trimesh.Trimesh(vertices, faces, process=False)
    assert peer.is_watertight and peer.volume > 0
    mean, true_mean = (np.linalg.norm(v[: len(mesh.vertices)], axis=1).mean()
                       for v in (mesh.vertices, vertices))  # fmt: skip
    scale = 1.005 if true_mean > mean else 0.995
    off = DistanceField(mesh.vertices, mesh.faces).distance(vertices / scale)
    radius = np.sqrt((mesh.vertices**2).sum(1).mean())
    assert 0.003 < np.sqrt((off**2).mean()) / radius < 0.009
    assert off.max() < 0.03 * radius


def test_committed_meshes_equal_those_of_the_tool(monkeypatch):
    pytest.importorskip("manifold3d")
    monkeypatch.syspath_prepend(str(CONFIG.parent / "tools"))
    import build_objects

    for name in ("09_cup", "10_stool"):
        built = build_objects.BUILDERS[name]()
        committed = trimesh.load(CONFIG / "objects" / f"{name}.ply", process=False)
        assert len(committed.vertices) == len(built.vertices)
        np.testing.assert_allclose(committed.vertices, built.vertices, atol=1e-6)
