"""Results as points, on a capture whose answers are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.body.artefact import read_parameters
from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import apply
from intercap_core.posed import open_sequence
from intercap_core.schemas import BODY_FIT, JOINT
from tests.helpers import fitted_capture as fitted


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> fitted.Capture:
    return fitted.shared_capture(tmp_path_factory)


@pytest.fixture(scope="module")
def settings(capture: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fitted.write_project(tmp_path_factory.mktemp("project"), capture, "cap")


@pytest.mark.parametrize(("stage", "share"), [("joint", 0.5), ("body_fit", 1.0)])
def test_points_match_the_artefacts(capture, settings, stage, share):
    found = open_sequence(settings, "cap", stage=stage, frame="master")
    assert len(found) == 5 and len(found.times) == 5
    vertices, joints = found.bodies()
    down = np.array([0, fitted.BODY_OFFSET_M, 0])
    np.testing.assert_allclose(vertices, capture.vertices + down, atol=1e-5)
    np.testing.assert_allclose(joints, capture.joints + down, atol=1e-5)
    true = capture.mesh.vertices @ capture.rotation.transpose(0, 2, 1)
    true = true + capture.translation[:, None] + [0, share * fitted.OBJECT_OFFSET_M, 0]
    np.testing.assert_allclose(found.objects(), true, atol=1e-6)
    assert found.faces.shape[1] == 3 and found.faces.max() < vertices.shape[1]
    moment = found.at(-1)
    np.testing.assert_allclose(moment.body, vertices[4], atol=1e-6)
    np.testing.assert_array_equal(moment.object_, found.objects([4])[0])
    assert all(moment.trusted.values())
    first = found.at(0).trusted  # its object is lost
    assert first["body"] and not first["object"]
    np.testing.assert_allclose(found.bodies(slice(1, 5, 2))[1], joints[1:5:2], atol=1e-6)
    with pytest.raises(IndexError, match="frame 5 of 5"):
        found.at(5)


def test_shapes_of_both_stages_are_read_alike(capture):
    """One row for all frames after the joint fit, a row a frame before: they broadcast alike."""
    with artefacts.read(capture.paths["joint"], JOINT) as file:
        one, joint = file["betas"], read_parameters(file)
    with artefacts.read(capture.paths["body_fit"], BODY_FIT) as file:
        each, body_fit = file["betas"], read_parameters(file)
    assert one.ndim == 1 and each.shape == (5, *one.shape)
    for betas, read in ((one, joint), (each, body_fit)):
        np.testing.assert_array_equal(np.atleast_2d(betas), read.betas.numpy())
        assert read.batch == 5 and read.vector().shape == joint.vector().shape
        spread = np.broadcast_to(np.atleast_2d(betas), each.shape)
        np.testing.assert_array_equal(read.frames(slice(0, 5)).betas.numpy(), spread)


def test_times_and_cameras_match_the_artefacts(capture, settings):
    seen = {
        frame: open_sequence(settings, "cap", frame=frame) for frame in ("z-up", "master", "k2")
    }
    upright = seen["z-up"].bodies()[0]
    assert abs(upright[..., 2].min() + fitted.BODY_OFFSET_M) < 0.001  # the fit is so much too low
    assert upright[..., 2].max() > 1.5
    assert "ground at z = 0" in seen["z-up"].frame and "k2" in seen["k2"].frame
    master = seen["master"].bodies()[0].reshape(-1, 3)
    by_camera = apply(capture.rig[1].colour_from_master, master)
    np.testing.assert_allclose(seen["k2"].bodies()[0].reshape(-1, 3), by_camera, atol=1e-6)


def test_missing_results_are_reported(settings):
    with pytest.raises(UserError, match="sequence 'cup' is not in the table; it lists cap"):
        open_sequence(settings, "cup")
    with pytest.raises(UserError, match=r"no frame 'k7'; expected z-up, .* k1, k2"):
        open_sequence(settings, "cap", frame="k7")
