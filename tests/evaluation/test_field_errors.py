"""Figures of recordings as outside a studio, worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench.evaluate.field_errors import (
    FieldScene,
    beam_figures,
    floor_error,
    floor_figures,
    start_figures,
    stated_displacement,
)
from intercap_core.evaluation.motion import Floor
from intercap_core.evaluation.scene_errors import displacement
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.solve.robust import SIGMA_PER_MAD


def _scene(fps: float, late_ms: list[float], **values: object) -> FieldScene:
    count = len(late_ms)
    made: dict[str, np.ndarray] = {
        "sigma_s": np.full(count, 0.002),
        "set_aside": np.zeros(count, bool),
        "before": np.full(count, 0.010),
        "after": np.full(count, 0.003),
        "stated": np.full(count, 0.003),
    }
    made |= {key: np.array(value) for key, value in values.items()}
    return FieldScene(fps, late_s=1e-3 * np.array(late_ms), floor_m=0.004, tilt_deg=0.2, **made)


def test_cameras_are_solved_within_half_a_set_or_named() -> None:
    # at 20 frames a second half a set is 25 ms
    scene = _scene(20, [2.0, -4.0, 40.0, 300.0], set_aside=[False, False, False, True])
    found = start_figures([scene])
    assert found["offset_cameras"] == 4 and found["offset_wrong"] == 1
    assert found["offset_solved_share"] == pytest.approx(0.5)
    assert found["offset_error_ms"] == pytest.approx(3.0)
    assert found["offset_error_worst_ms"] == pytest.approx(4.0)
    assert found["offset_sigma_ms"] == pytest.approx(2.0)
    assert found["offset_normalised"] == pytest.approx(1.5 * SIGMA_PER_MAD)


def test_cameras_made_worse_are_counted() -> None:
    scene = _scene(15, [0, 0], before=[0.004, 0.008], after=[0.0052, 0.0085], stated=[0.0052, 0])
    found = floor_figures([scene])
    assert found["extrinsics_worse_cameras"] == 1
    assert found["extrinsics_floor_heavy_given_mm"] == pytest.approx(6.0)
    assert found["extrinsics_floor_heavy_mm"] == pytest.approx(6.85)
    assert found["extrinsics_normalised"] == pytest.approx(1.0)


def test_a_floor_is_measured_under_the_feet() -> None:
    true = Floor(np.array([0.0, 0.0, 1.0]), 0.0)
    feet = np.array([[1.0, 0.0, 0.25], [-1.0, 0.0, 0.0], [0.0, 2.0, 0.1]])
    level = floor_error(np.array([0.0, 0, 0.03]), true.normal, true, feet)
    assert level == pytest.approx((0.03, 0.0))
    # tilted by one degree about y through the origin: 17.5 mm at either side, 0 on the axis
    tilt = np.radians(1.0)
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    height, angle = floor_error(np.zeros(3), normal, true, feet)
    assert height == pytest.approx(2 / 3 * np.sin(tilt)) and angle == pytest.approx(1.0)
    unknown = np.full(3, np.nan)
    assert np.isnan(floor_error(unknown, unknown, true, feet)).all()


def test_a_missing_floor_is_counted_but_no_error() -> None:
    without = replace(_scene(15, [0]), floor_m=float("nan"), tilt_deg=float("nan"))
    found = beam_figures([_scene(15, [0]), without])
    assert found["beam_floor_missing"] == 1 and found["beam_floor_mm"] == pytest.approx(4.0)
    assert beam_figures([without]) == {"beam_floor_missing": 1.0}


def test_nothing_measured_gives_no_figures() -> None:
    assert start_figures([]) == {} and floor_figures([]) == {} and beam_figures([]) == {}


def test_stated_displacement_matches_sampled_poses() -> None:
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
