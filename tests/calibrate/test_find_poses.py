"""Found poses of given views of joints and boards, with and without depth; estimated errors."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.calibrate import rig_poses
from intercap_core.calibrate.evidence import NUM_JOINTS, Views
from intercap_core.calibrate.found_rig import FoundRig
from intercap_core.calibrate.placement import reference_points
from intercap_core.calibrate.scale import scale_by_height
from intercap_core.errors import UserError
from intercap_core.formats.calibration.boards import parse_board
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from tests.calibrate.synthetic_views import board_poses_around, views_of_walker, with_board
from tests.calibrate.test_background import ROOM
from tests.helpers.synthetic_capture import (
    extrinsics_error,
    ring,
    room_depth,
    to_millimetres,
    write_frames,
)
from tests.helpers.synthetic_people import write_detections

SETS = 30
BOARD = parse_board("checkerboard:3x4:0.1")
TRUTH, UP = ring(4)
_, JOINTS, VIEWS = views_of_walker(4, SETS, noise_px=4.0, depth=True, seed=417)


def find(
    folder: Path, rig: Rig, views: Views, depths: list[np.ndarray] | None = None, **options: Any
) -> FoundRig:
    """Poses by ``views`` of joints and boards; the depth images show no person."""
    sets = len(views.times)
    unknown = rig.moved(np.tile(np.eye(4), (len(rig), 1, 1)))
    frames = write_frames(folder / "frames.h5", unknown, num_sets=sets, depths=depths)
    people = np.zeros((sets, len(rig), 135, 3))
    people[:, :, :NUM_JOINTS, :2] = np.nan_to_num(views.pixels[:, :, :NUM_JOINTS])
    people[:, :, :NUM_JOINTS, 2] = views.confidence[:, :, :NUM_JOINTS]
    detections = write_detections(
        folder / "detections.h5", rig, [[[body] for body in bodies] for bodies in people]
    )

    def find_views(*_: object) -> Views:
        return views

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rig_poses, "find_views", find_views)
        usual: dict[str, Any] = {"board": None, "height_m": None, "distance": None}
        return rig_poses.find_poses([(frames, detections)], **(usual | options))


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> FoundRig:
    """Poses by joints that err by 4 px and 2 cm, refined on the surfaces of the room."""
    rng = np.random.default_rng(417)
    images = [to_millimetres(room_depth(camera, UP, ROOM), rng) for camera in TRUTH]
    depths = [np.broadcast_to(image, (SETS, *image.shape)) for image in images]
    return find(tmp_path_factory.mktemp("depth"), TRUTH, VIEWS, depths)


def test_surfaces_refine_the_poses(found: FoundRig) -> None:
    assert found.scale == "depth"
    assert extrinsics_error(found.rig, TRUTH, JOINTS.mean((0, 1))).max() < 0.005


def test_residuals_are_those_of_the_final_poses(found: FoundRig) -> None:
    points = reference_points(found.rig, VIEWS, range(4), None)
    hips = points[:, [KEYPOINT_INDEX["left_hip"], KEYPOINT_INDEX["right_hip"]]].mean(1)
    np.testing.assert_allclose(found.residuals.walk, hips, atol=1e-6)
    errors = []
    for c, camera in enumerate(found.rig):
        pixels = camera.colour.project(apply(camera.colour_from_master, points.reshape(-1, 3)))
        errors.append(np.linalg.norm(pixels - VIEWS.pixels[:, c].reshape(-1, 2), axis=1))
    # joints of the adjustment also obey the distances
    np.testing.assert_allclose(found.residuals.joint_px, np.median(errors, 1), rtol=0.1)


def error_over_estimate(found: FoundRig, rig: Rig, centre: np.ndarray) -> np.ndarray:
    """True over estimated error (P,) of every pair of cameras."""
    poses, true = found.rig.master_from_colour, rig.master_from_colour
    ratios = []
    for a, b in combinations(range(len(rig)), 2):
        aligned = found.rig.moved(true[a] @ invert(poses[a]) @ poses)
        error = extrinsics_error(aligned, rig, centre)[b]
        ratios.append(error / found.pair_sigma_m(a, b))
    return np.array(ratios)


def test_pairs_state_their_evidence(found: FoundRig) -> None:
    assert [pair.cameras for pair in found.residuals.pairs] == list(combinations(range(4), 2))
    for pair in found.residuals.pairs:
        assert pair.joints == SETS * NUM_JOINTS and 1.0 < pair.joint_px < 6.0
        assert 1e-4 < pair.background_m < 0.02
        assert pair.boards == 0 and np.isnan(pair.corner_px)
    # the depth of this room has no systematic error, which the estimate contains
    assert error_over_estimate(found, TRUTH, JOINTS.mean((0, 1))).max() < 1.5


@pytest.mark.parametrize("seed", [5081, 5082, 5083])
def test_estimated_errors_of_pairs_contain_errors_that_frames_share(
    tmp_path: Path, seed: int
) -> None:
    """Each joint errs by 4 px in all images of a camera, and by 2 px in each image."""
    rig, joints, views = views_of_walker(4, 60, noise_px=2.0, seed=seed)
    shared = np.random.default_rng(seed).normal(0, 4.0, (1, 4, NUM_JOINTS, 2))
    baseline = float(np.linalg.norm(rig[2].master_from_colour[:3, 3]))
    views = replace(views, pixels=views.pixels + shared)
    found = find(tmp_path, rig, views, distance=("k1", "k3", baseline))
    ratios = error_over_estimate(found, rig, joints.mean((0, 1)))
    assert 0.2 < np.median(ratios) < 1.7 and ratios.max() < 3


def views_with_board() -> tuple[Rig, np.ndarray, Views, float]:
    """A person and a board of 12 places in one recording, and the height at which both agree."""
    rig, joints, views = views_of_walker(4, 60, noise_px=2.0, seed=93)
    poses = np.full((60, 4, 4), np.nan)
    poses[::5] = board_poses_around(joints.mean((0, 1)), 12)
    views = with_board(views, rig, BOARD, poses, noise_px=0.3)
    return rig, joints, views, 1 / scale_by_height(joints, 1.0)[0]


def test_person_and_board_together_give_poses_and_scale(tmp_path: Path) -> None:
    rig, joints, views, height_m = views_with_board()
    found = find(tmp_path, rig, views, board=BOARD, height_m=height_m)
    assert found.scale == "board" and not found.notes
    assert extrinsics_error(found.rig, rig, joints.mean((0, 1))).max() < 0.01
    assert all(pair.boards > 5 and pair.corner_px < 1.5 for pair in found.residuals.pairs)
    assert all(pair.joint_px < 4 for pair in found.residuals.pairs)


def test_a_board_of_another_size_contradicts_the_height(tmp_path: Path) -> None:
    rig, _, views, height_m = views_with_board()
    larger = parse_board("checkerboard:3x4:0.125")
    with pytest.raises(UserError, match=r"subject's height, the board is 0.8. times.*--board"):
        find(tmp_path, rig, views, board=larger, height_m=height_m)


def test_a_stated_distance_that_contradicts_the_board_is_noted(tmp_path: Path) -> None:
    rig, _, views, _ = views_with_board()
    baseline = float(np.linalg.norm(rig[2].master_from_colour[:3, 3]))
    found = find(tmp_path, rig, views, board=BOARD, distance=("k1", "k3", 1.1 * baseline))
    assert any("stated distance, the rig is 1.10 times" in note for note in found.notes)
