"""The simulated detector with a real detector's errors: offsets, duration, hands, face."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from intercap_core.body.keypoints import LEFT_HAND, RIGHT_HAND
from intercap_core.geometry.camera.rig import Camera
from intercap_core.studio.measured_detector import ERRORS, MeasuredDetector, groups
from intercap_core.studio.noise import NoiseSource
from tests.studio.studio_stage import make_stage

FRAMES, FPS = 600, 15
LEFT_SHOULDER, RIGHT_SHOULDER, LEFT_KNEE = 5, 2, 13


@cache
def still_person() -> tuple[Camera, np.ndarray, np.ndarray]:
    """A camera, keypoints (T, 135, 3) that do not move, and the pelvis's axes (T, 3, 3)."""
    stage = make_stage("walk_and_wave", "s02", 5, 2)
    moment = stage.at(np.zeros(1))
    points = stage.to_master(stage.keypoints(moment))
    axes = stage.rig.master_from_stage[:3, :3] @ moment.pelvis
    return stage.rig.true[0], np.repeat(points, FRAMES, 0), np.repeat(axes, FRAMES, 0)


def detected(
    hidden: np.ndarray | None = None, holding: bool = False, seed: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Errors (T, 135, 2) in mm, and confidences (T, 135), of a person who stands still."""
    camera, points, axes = still_person()
    detector = MeasuredDetector.build(NoiseSource(seed, 1.0, "a", FPS), FRAMES)
    hidden = np.zeros((FRAMES, 135), bool) if hidden is None else hidden
    grasp = np.full((FRAMES, 2), holding)
    found = detector.detect(camera, points, axes, hidden, grasp)
    at = points @ camera.colour_from_master[:3, :3].T + camera.colour_from_master[:3, 3]
    size = 1e3 * at[..., 2:] / camera.colour.fx
    return (found[..., :2] - camera.colour.project(at)) * size, found[..., 2]


def hidden_points(*points: int | slice) -> np.ndarray:
    hidden = np.zeros((FRAMES, 135), bool)
    for rows in points:
        hidden[:, rows] = True
    return hidden


def test_offsets_have_the_measured_length_and_are_mirrored() -> None:
    bias = MeasuredDetector.build(NoiseSource(3, 1.0, "a", FPS), 2).body_bias
    for name, points in groups().items():
        length = 1e3 * np.linalg.norm(bias[points], axis=1)
        np.testing.assert_allclose(length, ERRORS[name].bias, err_msg=name)
    np.testing.assert_allclose(bias[LEFT_SHOULDER], bias[RIGHT_SHOULDER] * (-1, 1, 1))
    np.testing.assert_allclose(bias[LEFT_HAND], bias[RIGHT_HAND] * (-1, 1, 1))


@pytest.mark.parametrize(
    ("points_hidden", "holding", "least", "most"),
    [(0, False, 0.9, 1.0), (8, False, 0.65, 0.95), (8, True, 0.2, 0.6), (21, True, 0.0, 0.25)],
)
def test_a_hand_is_found_if_it_is_visible_and_empty(
    points_hidden: int, holding: bool, least: float, most: float
) -> None:
    """``points_hidden``: of the 21 points of the left hand."""
    hidden = hidden_points(slice(25, 25 + points_hidden))
    found = [detected(hidden, holding, seed)[1][:, LEFT_HAND] > 0 for seed in range(3)]
    assert (np.array(found).any(2) == np.array(found).all(2)).all()  # all its points or none
    assert least <= np.mean(found) <= most


def test_the_face_is_found_from_the_front_only() -> None:
    camera, points, _ = still_person()
    detector = MeasuredDetector.build(NoiseSource(2, 1.0, "a", FPS), FRAMES)
    forward = points[0, 0] - points[0, 17:19].mean(0)
    forward /= np.linalg.norm(forward)
    shares = []
    for side in (1, -1):  # the camera is in front of the person, and behind
        moved = points + (camera.master_from_colour[:3, 3] - side * 2.5 * forward - points[0, 0])
        seen = detector._sees_face(np.random.default_rng(0), camera, moved)
        shares.append(seen.mean())
    assert shares[0] > 0.9 and shares[1] == 0


def test_views_share_the_errors_of_hidden_joints() -> None:
    """The second camera has the pose of the first: what they have in common is in both images."""
    camera, points, axes = still_person()
    detector = MeasuredDetector.build(NoiseSource(6, 1.0, "a", FPS), FRAMES)
    hidden, hands = hidden_points(slice(0, 25)), np.zeros((FRAMES, 2), bool)
    twin = Camera("k9", camera.colour, camera.depth, camera.colour_from_depth,
                  camera.master_from_colour)  # fmt: skip
    both = [
        detector.detect(view, points, axes, hidden, hands)[:, groups()["elbows"], :2]
        for view in (camera, twin)
    ]
    first, second = (np.clip(e - np.median(e, 0), -100, 100).ravel() for e in both)
    assert 0.15 < np.corrcoef(first, second)[0, 1] < 0.7
