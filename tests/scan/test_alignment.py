"""Registration of points to a model of the object."""

from __future__ import annotations

import numpy as np
import trimesh

from intercap_core.geometry.camera.transforms import apply, invert, rigid, rotation_exp
from intercap_core.scan.alignment import Cloud, Model, track_from
from intercap_core.scan.handled import cloud_of
from intercap_core.scan.multiview import align_together
from tests.scan.turned_object import Turned, relative, turning

BOX = trimesh.creation.box((0.12, 0.16, 0.20))


def cloud(count: int = 3000) -> Cloud:
    points, faces = trimesh.sample.sample_surface(BOX, count, seed=0)
    return Cloud(points, BOX.face_normals[faces])


def test_a_known_motion_is_recovered() -> None:
    true = rigid(rotation_exp(np.array([0.08, -0.05, 0.1])), np.array([0.5, 0.01, -0.012]))
    start = rigid(np.eye(3), np.array([0.5, 0.0, 0.0]))
    found = Model(cloud()).register(cloud(2000).moved(true), start)
    assert found.share > 0.95  # points at edges have no partner of their normal
    np.testing.assert_allclose(found.pose, true, atol=5e-4)


def test_points_of_another_shape_do_not_correspond() -> None:
    sphere = trimesh.creation.icosphere(radius=0.2)
    other = Cloud(sphere.vertices, sphere.vertices / 0.2)
    assert Model(cloud()).register(other, np.eye(4)).share < 0.5


def test_the_sides_of_a_thin_plate_stay_apart() -> None:
    grid = np.stack(np.meshgrid(*[np.linspace(0, 0.1, 50)] * 2), -1).reshape(-1, 2)
    top = np.column_stack([grid, np.full(len(grid), 0.001)])
    up = np.tile([0.0, 0, 1], (len(grid), 1))
    plate = Cloud(np.concatenate([top, top * (1, 1, -1)]), np.concatenate([up, -up]))
    thin = plate.thinned(0.01)
    assert set(np.sign(thin.points[:, 2])) == {-1.0, 1.0}
    np.testing.assert_allclose(abs(thin.points[:, 2]), 0.001)


def test_tracking_follows_a_turning_object() -> None:
    poses = turning(5, 4.0, np.linspace([0, 0, 0], [0.03, 0.02, 0], 5))
    recording = Turned([(BOX.vertices.copy(), BOX.faces.copy())], poses[None])
    clouds = {t: cloud_of(recording.surfaces(t)) for t in range(5)}
    found = track_from(clouds, 2, 0.004)
    assert sorted(found) == [0, 1, 2, 3, 4]
    for t in range(5):
        # in the object's own frame, found and true motions differ by the choice of the frame
        frame = invert(poses[2]) @ found[2].pose
        motion = frame @ invert(found[2].pose) @ found[t].pose @ invert(frame)
        moved = apply(motion, BOX.vertices) - apply(relative(poses, 2, t), BOX.vertices)
        assert np.linalg.norm(moved, axis=1).max() < 0.002


def test_multiview_registration_removes_drift() -> None:
    rng, count = np.random.default_rng(0), 12
    turns = [rotation_exp(np.array([0.0, 0.0, angle])) for angle in np.linspace(0, 2, count)]
    true = np.stack([rigid(turn, np.array([0.1, 0, 0])) for turn in turns])
    drift = [rigid(rotation_exp(np.array([0, 0.005, 0.005]) * k), 0.002 * k) for k in range(count)]
    clouds = []
    for pose in true:
        seen = cloud()
        noisy = Cloud(seen.points + rng.normal(0, 0.001, seen.points.shape), seen.normals)
        clouds.append(noisy.moved(invert(pose)).subset(rng.random(3000) < 0.7))
    drifted = np.stack(drift) @ true
    found = align_together(clouds, clouds, drifted, reach_m=(0.06, 0.009), view_deg=35.0)

    def largest_error(poses: np.ndarray) -> float:
        """Of the corners, relative to the first pose, metres."""
        moved = [
            apply(pose, apply(invert(exact), BOX.vertices))
            for pose, exact in zip(poses, true, strict=True)
        ]
        return float(np.linalg.norm(np.stack(moved) - moved[0], axis=2).max())

    assert largest_error(drifted) > 0.02
    assert largest_error(found) < 0.001
