"""Errors of fitted bodies, each on a case that can be worked out by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.evaluate import body_errors
from bench.evaluate.body_errors import CLOUD_KEYS, BodyErrors
from bench.evaluate.part import grouped
from intercap_core.body.keypoints import FACE, KEYPOINT_NAMES
from intercap_core.evaluation import body
from tests.helpers import fitted_capture as fitted

OFFSET = fitted.BODY_OFFSET_M


def _measure(capture: fitted.Capture) -> BodyErrors:
    paths = capture.inputs("frames", "scene", "person", "body_fit")
    return body_errors.measure(paths, capture.paths["truth"], fitted.BODY_MODELS, "neutral")


@pytest.fixture(scope="module")
def shifted(capture: fitted.Capture) -> BodyErrors:
    return _measure(capture)


@pytest.fixture(scope="module")
def true(capture: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> BodyErrors:
    made = capture.copied(tmp_path_factory.mktemp("true"), "body_fit")
    with made.edit("body_fit") as file:
        file["transl"][:, 1] -= OFFSET
        file["failed"][1] = file["bridged"][2] = True
    return _measure(made)


def test_errors_of_a_shifted_body(shifted: BodyErrors) -> None:
    for name in ("pve", "visible", "joints", "hands", "face"):
        assert getattr(shifted, name) == pytest.approx(OFFSET, abs=1e-6), name
    for name in ("hands_wrist", "face_aligned"):
        assert getattr(shifted, name) == pytest.approx(0, abs=1e-6), name
    stated = OFFSET / (0.01 * body.MEDIAN_CHI_3)
    assert shifted.normalised == pytest.approx(stated, rel=1e-4)
    assert shifted.normalised_hands.shape == (5, 30)
    assert shifted.normalised_hands == pytest.approx(stated, rel=1e-4)
    assert shifted.touching.tolist() == [[False, True]] * 5
    assert shifted.interaction == "hold"
    assert not shifted.bad.any() and not shifted.flagged.any()


def test_cloud_distances_of_the_true_body_are_the_floor(
    true: BodyErrors, shifted: BodyErrors
) -> None:
    for name in ("pve", "visible", "joints", "hands", "hands_wrist", "face", "face_aligned"):
        assert getattr(true, name) == pytest.approx(0, abs=1e-6), name
    for key in ("cloud_to_mesh", "mesh_to_cloud_visible"):
        floor = true.clouds[f"{key}_floor"]
        assert len(floor) == 1  # of five frames every fifth
        assert true.clouds[key] == pytest.approx(floor, abs=1e-6)
        assert shifted.clouds[f"{key}_floor"] == pytest.approx(floor, abs=1e-6)
        assert floor < shifted.clouds[key] < OFFSET + floor
    assert true.clouds["cloud_to_mesh"] < 0.0015  # whole millimetres of depth
    assert true.flagged.tolist() == [False, True, True, False, False]


def test_without_depth_there_are_no_points_to_compare_with(
    capture: fitted.Capture, tmp_path: Path
) -> None:
    without = capture.copied(tmp_path, "frames")
    with without.edit("frames") as file:
        file["depth_index"][:] = -1
    found = _measure(without)
    assert all(np.isnan(found.clouds[key]).all() for key in CLOUD_KEYS)
    figures = body_errors.figures([found])
    assert "cloud_to_mesh_mm" not in figures
    assert figures["pve_mm"] == pytest.approx(1e3 * OFFSET, rel=1e-4)


def test_body_of_another_topology_has_only_joint_errors(
    capture: fitted.Capture, tmp_path: Path
) -> None:
    other = capture.copied(tmp_path, "truth")
    with other.edit("truth") as file:
        for key in ("correspondence_face", "correspondence_weights"):
            values, attributes = file[key][:-1], dict(file[key].attrs)
            del file[key]
            file.create_dataset(key, data=values, fletcher32=True).attrs.update(attributes)
    found = _measure(other)
    assert np.isnan(found.pve).all() and np.isnan(found.face).all() and not found.bad.any()
    figures = body_errors.figures([found])
    assert "pve_mm" not in figures
    assert figures["mpjpe_mm"] == pytest.approx(1e3 * OFFSET, rel=1e-4)


def test_landmark_alignment_removes_rigid_motion(
    capture: fitted.Capture,
) -> None:
    model = capture.model
    face = body_errors.landmarks(capture.vertices, model.keypoint_map)
    assert face.shape == (5, 68, 3)
    nose = KEYPOINT_NAMES.index("face_30") - FACE.start  # the tip
    near = np.linalg.norm(capture.vertices - face[:, nose, None], axis=-1).min(1)
    assert near == pytest.approx(0, abs=0.005)
    turned = face @ Rotation.from_rotvec([0.1, -0.4, 0.2]).as_matrix().T + [0.3, 0, -1]
    assert body_errors.landmark_error(turned, face).min() > 0.1
    assert body_errors.landmark_error(turned, face, align=True) == pytest.approx(0, abs=1e-6)
    mirrored = face * [-1, 1, 1]  # which no turn undoes
    assert body_errors.landmark_error(mirrored, face, align=True).min() > 0.001


def test_visible_error_uses_truly_visible_vertices() -> None:
    true = np.zeros((2, 4, 3))
    moved = true.copy()
    moved[0, :, 0] = [0.01, 0.03, 0.5, 0.5]
    visible = np.array([[True, True, False, False], [False] * 4])
    found = body_errors.visible_vertex_error(moved, true, visible)
    assert found == pytest.approx([0.02, np.nan], nan_ok=True)


def _plain(pve_mm: list[float], **changed: object) -> BodyErrors:
    count = len(pve_mm)
    pve = 1e-3 * np.array(pve_mm)
    none = np.zeros(count)
    errors = BodyErrors(
        "cup_drink", Path("a.h5"), pve, none, np.zeros((count, 22)), np.zeros((count, 2)),
        np.zeros((count, 2)), np.zeros((count, 2), bool), none, none, np.full(count, np.nan),
        np.ones((count, 22)), np.ones((count, 30)), np.zeros(count, bool),
    )  # fmt: skip
    return replace(errors, **changed)


def test_flags_are_compared_with_errors_above_40_mm() -> None:
    flagged = np.array([False, True, True, False])
    found = body_errors.flag_figures([_plain([5, 39.9, 40.1, 90], flagged=flagged)])
    assert found == {
        "flagged_share": 0.5, "bad_frames_share": 0.5,
        "bad_frames_recall": 0.5, "bad_frames_precision": 0.5,
    }  # fmt: skip
    fine = body_errors.flag_figures([_plain([5, 6])])
    assert fine == {"flagged_share": 0, "bad_frames_share": 0}


def test_grasping_hands_are_those_that_touch() -> None:
    hands = np.array([[0.01, 0.02], [0.03, 0.04]])
    touching = np.array([[True, False], [False, True]])
    found = body_errors.figures([_plain([1, 3], hands=hands, touching=touching)])
    assert found["hand_mpjpe_mm"] == pytest.approx(25)
    assert found["hand_grasp_mpjpe_mm"] == pytest.approx(25)
    assert found["pve_mm"] == pytest.approx(2)
    nobody = body_errors.figures([_plain([1, 3], hands=hands)])
    assert "hand_grasp_mpjpe_mm" not in nobody and "acceleration_mm" not in nobody
    assert body_errors.figures([]) == {}


def test_frames_of_all_recordings_count_the_same() -> None:
    recordings = [_plain([4, 4, 4]), replace(_plain([8]), interaction="stool_sit")]
    assert body_errors.figures(recordings)["pve_mm"] == pytest.approx(5)
    assert list(grouped(recordings, "interaction")) == ["cup_drink", "stool_sit"]
    joints = np.zeros((4, 22))
    joints[3, 20] = 0.1
    found = body_errors.joint_figures([_plain([1] * 4, joints=joints)])
    assert found["joint_left_wrist_mm"] == pytest.approx(25)
