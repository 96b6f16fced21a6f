"""The committed meshes: closed, of true size, with plausible contact vertices."""

import numpy as np
import pytest
import trimesh

from intercap_core.geometry.rigid.distance import DistanceField

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
