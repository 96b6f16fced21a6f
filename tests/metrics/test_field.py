"""Figures of recordings as outside a studio, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.camera.transforms import rigid
from intercap_core.metrics.extrinsics import displacement
from intercap_core.metrics.field import (
    FieldScene,
    floor_figures,
    start_figures,
    stated_displacement,
)


def _scene(fps: float, late_ms: list[float], **values: object) -> FieldScene:
    count = len(late_ms)
    made: dict[str, np.ndarray] = {
        "apart_s": np.zeros(count),
        "sigma_s": np.full(count, 0.002),
        "set_aside": np.zeros(count, bool),
        "before": np.full(count, 0.010),
        "after": np.full(count, 0.003),
        "stated": np.full(count, 0.003),
    }
    made |= {key: np.array(value) for key, value in values.items()}
    return FieldScene("a", fps, late_s=1e-3 * np.array(late_ms), **made)


def test_cameras_are_solved_within_half_a_set_or_named() -> None:
    # at 20 frames a second half a set is 25 ms
    scene = _scene(20, [2.0, -4.0, 40.0, 300.0], set_aside=[False, False, False, True])
    found = start_figures([scene])
    assert found["offset_cameras"] == 4 and found["offset_wrong"] == 1
    assert found["offset_solved_share"] == pytest.approx(0.5)
    assert found["offset_error_ms"] == pytest.approx(3.0)
    assert found["offset_error_worst_ms"] == pytest.approx(4.0)
    assert found["offset_sigma_ms"] == pytest.approx(2.0)
    # a normal deviate is above 0.6745 deviations in half of the cases
    assert found["offset_normalised"] == pytest.approx(1.5 / 0.6745)


def test_cameras_that_end_worse_than_given_are_counted() -> None:
    scene = _scene(15, [0, 0], before=[0.004, 0.008], after=[0.0052, 0.0085], stated=[0.0052, 0])
    found = floor_figures([scene])
    assert found["extrinsics_worse_cameras"] == 1
    assert found["extrinsics_floor_heavy_given_mm"] == pytest.approx(6.0)
    assert found["extrinsics_floor_heavy_mm"] == pytest.approx(6.85)
    assert found["extrinsics_normalised"] == pytest.approx(1.0)


def test_nothing_measured_gives_no_figures() -> None:
    assert start_figures([]) == {} and floor_figures([]) == {}


def test_stated_displacement_is_that_of_poses_drawn_from_the_covariance() -> None:
    rng = np.random.default_rng(2)
    poses = np.stack(
        [
            rigid(Rotation.from_euler("y", angle).as_matrix(), [2 * np.sin(angle), 0.3, 1.0])
            for angle in (0.0, 1.0, 2.0)
        ]
    )
    root = rng.normal(size=(6, 6)) * np.repeat([2e-3, 3e-3], 3)[:, None]
    covariance = np.zeros((3, 7, 3, 7))
    covariance[1, :6, 1, :6] = root @ root.T
    drawn = []
    for _ in range(4000):
        turn, shift = np.split(root @ rng.normal(size=6), 2)
        moved = poses.copy()
        moved[1, :3, :3] = Rotation.from_rotvec(turn).as_matrix() @ poses[1, :3, :3]
        moved[1, :3, 3] += shift
        drawn.append(displacement(moved, poses, 0)[1])
    expected = np.sqrt(np.mean(np.square(drawn)))
    found = stated_displacement(poses, covariance)
    assert found[1] == pytest.approx(expected, rel=0.05)
    assert found[[0, 2]] == pytest.approx(0)
