"""One floor under cameras that share no piece of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.transforms import apply
from intercap_core.scene.constraints import FloorConstraint
from intercap_core.scene.ground import fit_ground
from intercap_core.scene.registration import STATIC, Registration, RigEstimate
from intercap_core.scene.surfaces import DepthSurface, surface_from_depth
from intercap_core.scene.up import rough_up
from tests.helpers.synthetic_capture import perturbed, ring, room_depth, to_millimetres

TRUTH, UP = ring()
NO_GRAVITY = np.full((6, 3), np.nan)


@pytest.fixture(scope="module")
def patches() -> dict[int, DepthSurface]:
    """Each camera's own sixth of a bare floor: no two cameras share any of it."""
    rng, found = np.random.default_rng(0), {}
    for c, camera in enumerate(TRUTH):
        depth = to_millimetres(room_depth(camera, UP, np.zeros((0, 2, 3)), None), rng, noise=0.3)
        surface = surface_from_depth(depth, camera.depth, cell_m=0.03, max_depth_m=5.0)
        world = apply(UP @ camera.master_from_depth, surface.points)
        sector = np.arctan2(world[:, 1], world[:, 0]) - 2 * np.pi * c / 6
        off = np.abs((sector + np.pi) % (2 * np.pi) - np.pi)
        found[c] = surface.subset(
            np.flatnonzero((off < np.radians(22)) & (np.hypot(*world.T[:2]) > 0.4))
        )
    return found


def floor_of(rig, patches) -> FloorConstraint:
    points = [apply(rig[c].master_from_depth, s.points) for c, s in patches.items()]
    normals = [s.normals @ rig[c].master_from_depth[:3, :3].T for c, s in patches.items()]
    ground = fit_ground(
        np.concatenate(points), np.concatenate(normals), rig, rough_up(rig, NO_GRAVITY),
        tolerance_m=0.03, cell_m=0.03,
    )  # fmt: skip
    floor = FloorConstraint.of(rig, patches, ground)
    assert floor is not None
    return floor


def test_height_and_tilt_come_back_without_overlap(patches):
    start = perturbed(TRUTH, np.random.default_rng(2), 0.01, 0.3)
    registration = Registration(start, {STATIC: [patches]}, 0)
    assert not registration.residuals(RigEstimate.start(start), STATIC)
    refined = registration.solve(RigEstimate.start(start), [floor_of(start, patches)]).estimate

    def errors(poses: np.ndarray) -> tuple[float, float]:
        heights, tilts = [], []
        for pose, true in zip(poses[1:], TRUTH.master_from_colour[1:], strict=True):
            moved = UP @ pose @ np.linalg.inv(true) @ np.linalg.inv(UP)
            middle = apply(UP @ true, np.array([[0.0, 0, 2.5]]))
            heights.append(abs((apply(moved, middle) - middle)[0, 2]))
            tilts.append(np.degrees(np.arccos(min(1.0, moved[2, 2]))))
        return float(np.mean(heights)), float(np.mean(tilts))

    before, after = errors(start.master_from_colour), errors(refined.poses)
    assert after[0] < 0.5 * before[0] and after[1] < 0.6 * before[1]


def test_equations_are_those_of_the_distance_to_the_best_plane(patches):
    start = perturbed(TRUTH, np.random.default_rng(3), 0.003, 0.05)
    floor = floor_of(start, patches)
    none = np.zeros(6)
    poses = start.master_from_colour
    matrix, gradient = floor(poses, none)
    flat = matrix.reshape(36, 36)
    np.testing.assert_allclose(flat, flat.T, atol=1e-6 * np.abs(flat).max())
    assert np.linalg.eigvalsh(flat).min() > -1e-6 * np.abs(flat).max()
    # Turning or moving all cameras together leaves one floor one floor.
    centres, together = poses[:, :3, 3], np.zeros((6, 6, 6))
    for axis in range(3):
        together[:, axis, axis] = 1
        together[:, 3:, axis] = np.cross(np.eye(3)[axis], centres)
        together[:, 3 + axis, 3 + axis] = 1
    motion = together.reshape(36, 6)
    assert np.abs(flat @ motion).max() < 2e-2 * np.abs(flat).max()
    # A step against the gradient brings the floors together.
    step = -1e-3 * gradient / np.abs(gradient).max()
    moved = poses.copy()
    moved[:, :3, :3] = Rotation.from_rotvec(step[:, :3]).as_matrix() @ moved[:, :3, :3]
    moved[:, :3, 3] += step[:, 3:]
    assert np.linalg.norm(floor(moved, none)[1]) < np.linalg.norm(gradient)


def test_floor_seen_by_one_camera_is_no_constraint(patches):
    ground = fit_ground(
        apply(TRUTH[0].master_from_depth, patches[0].points),
        patches[0].normals @ TRUTH[0].master_from_depth[:3, :3].T,
        TRUTH, rough_up(TRUTH, NO_GRAVITY), tolerance_m=0.03, cell_m=0.03,
    )  # fmt: skip
    assert FloorConstraint.of(TRUTH, {0: patches[0]}, ground) is None
