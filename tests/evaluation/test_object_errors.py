"""Errors of a tracked object, each on a case small enough to work out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.evaluate import track_errors
from intercap_core.evaluation import object_errors
from intercap_core.evaluation.object_errors import ObjectErrors
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup

SQUARE = np.array([[x, y, 0.0] for x in (-1.0, 1) for y in (-1.0, 1)])
QUARTER = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()[None]
STILL, NOWHERE = np.eye(3)[None], np.zeros((1, 3))
HALF_TURN = np.diag([-1.0, -1, 1, 1])


def _mesh(symmetry: SymmetryGroup) -> ObjectMesh:
    faces = np.array([[0, 2, 1], [1, 2, 3], [0, 1, 2], [1, 3, 2]])
    colours = np.zeros((4, 3), np.uint8)
    return ObjectMesh("square", SQUARE, faces, np.zeros(0, int), symmetry, colours)


def _errors(translation: list[float], **changed: object) -> ObjectErrors:
    count = len(translation)
    plain = {
        "rotation": np.zeros(count), "turn": np.full(count, np.nan),
        "centre": np.zeros((count, 3)), "true_centre": np.zeros((count, 3)),
        "views": np.full(count, 6), "moves": np.ones(count, bool), "flagged": np.zeros(count, bool),
    }  # fmt: skip
    return ObjectErrors("a", "cup", 15.0, np.array(translation), **(plain | changed))


def test_add_s_ignores_similar_shapes_mssd_only_symmetries() -> None:
    turned = (QUARTER, NOWHERE, STILL, NOWHERE)
    assert track_errors.add_s(SQUARE, *turned) == pytest.approx([0])
    # a quarter turn moves every corner by 2, of a group with the half turn still by 2
    for group in (SymmetryGroup.none(), SymmetryGroup(np.array([np.eye(4), HALF_TURN]))):
        assert track_errors.mssd(SQUARE, *turned, _mesh(group)) == pytest.approx([2])
    half = (QUARTER @ QUARTER, NOWHERE, STILL, NOWHERE)
    assert track_errors.mssd(SQUARE, *half, _mesh(SymmetryGroup.none())) == pytest.approx(
        [2 * np.sqrt(2)]
    )
    group = SymmetryGroup(np.array([np.eye(4), HALF_TURN]))
    assert track_errors.mssd(SQUARE, *half, _mesh(group)) == pytest.approx([0], abs=1e-9)
    shifted = (STILL, np.array([[0.3, 0, 0]]), STILL, NOWHERE)
    assert track_errors.add_s(SQUARE, *shifted) == pytest.approx([0.3])


def test_undetermined_axes_are_excluded_from_turn_errors() -> None:
    deviation = np.radians(2.0)
    covariance = np.eye(6)[None] * deviation**2
    turned = Rotation.from_rotvec([0, 0, 3 * deviation]).as_matrix()[None]
    none = SymmetryGroup.none()
    found = track_errors.normalised_rotation_error(turned, STILL, covariance, none)
    assert found == pytest.approx([3 / 1.5382], rel=1e-3)
    covariance[:, 2, 2] = np.pi**2
    found = track_errors.normalised_rotation_error(turned, STILL, covariance, none)
    assert found == pytest.approx([0], abs=1e-6)
    covariance[:, 0, 0] = covariance[:, 1, 1] = np.pi**2
    assert np.isnan(track_errors.normalised_rotation_error(turned, STILL, covariance, none)).all()


def test_lost_frames_are_unnoticed_without_a_flag_or_recovered():
    lost = [0.001, 0.2, 0.2, 0.002, 0.2]
    found = object_errors.figures(
        [_errors(lost, flagged=np.array([True, True, False, False, False]))]
    )
    assert found["lost_share"] == pytest.approx(3 / 5)
    assert found["lost_unnoticed_share"] == pytest.approx(2 / 5)
    assert found["flag_precision"] == pytest.approx(1 / 2)
    assert found["recovered_share"] == pytest.approx(1 / 2)
    assert found["first_frame_success"] == 1
    assert found["translation_median_mm"] == pytest.approx(200)
    assert object_errors.figures([]) == {}


def test_figures_by_number_of_views() -> None:
    views = np.array([0, 1, 2, 6, 7])
    found = track_errors.by_views([_errors([0.1, 0.3, 0.02, 0.004, 0.006], views=views)])
    assert list(found) == ["0-1", "2", "6+"]
    assert found["0-1"]["frames"] == 2
    assert found["0-1"]["translation_median_mm"] == pytest.approx(200)
    assert found["6+"]["translation_median_mm"] == pytest.approx(5)
