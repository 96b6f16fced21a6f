"""Poses from artefacts with depth images of a furnished room and measured distances of joints."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.body.keypoints import KEYPOINT_INDEX
from intercap_core.calibrate import rig_poses
from intercap_core.calibrate.evidence import Views
from intercap_core.calibrate.found_rig import FoundRig
from intercap_core.calibrate.placement import reference_points
from intercap_core.geometry.camera.transforms import apply
from tests.calibrate.synthetic_views import views_of_walker
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
TRUTH, UP = ring(4)
_, JOINTS, VIEWS = views_of_walker(4, SETS, noise_px=4.0, depth=True, seed=417)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> FoundRig:
    """Poses by joints that err by 4 px and 2 cm, refined on the surfaces of the room."""
    folder, rng = tmp_path_factory.mktemp("depth"), np.random.default_rng(417)
    images = [to_millimetres(room_depth(camera, UP, ROOM), rng) for camera in TRUTH]
    unknown = TRUTH.moved(np.tile(np.eye(4), (len(TRUTH), 1, 1)))
    frames = write_frames(
        folder / "frames.h5", unknown, num_sets=SETS,
        depths=[np.broadcast_to(image, (SETS, *image.shape)) for image in images],
    )  # fmt: skip
    people = np.zeros((SETS, 4, 135, 3))
    people[:, :, : len(JOINTS[0]), :2] = VIEWS.pixels
    people[:, :, : len(JOINTS[0]), 2] = VIEWS.confidence
    detections = write_detections(
        folder / "detections.h5", TRUTH, [[[body] for body in bodies] for bodies in people]
    )

    def find_views(*_: object) -> Views:
        return VIEWS

    with pytest.MonkeyPatch.context() as patch:
        # the depth images show no person
        patch.setattr(rig_poses, "find_views", find_views)
        return rig_poses.find_poses(
            [(frames, detections)], board=None, height_m=None, distance=None
        )


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
