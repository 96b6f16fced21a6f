"""Slip, planted feet and stated contact, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from bench.evaluate.sequence_figures import (
    calibration_error,
    detected_figures,
    hold_figures,
    slip_by_object,
    stated_contact_figures,
    worse_objects,
)
from intercap_core.evaluation.contact_figures import reliability
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.motion import Floor, foot_errors, slip_speed, support
from intercap_core.schemas import METRIC_REGIONS

FPS = 10.0  # a slip's window of 0.2 s is two frames
FLOOR = Floor(np.array([0.0, 0.0, 1.0]), 0.0)


def up(points: np.ndarray) -> np.ndarray:
    """The normals of a flat top."""
    return np.tile([0.0, 0.0, 1.0], (len(points), 1))


def sliding(velocity: tuple[float, float, float], total: int = 5) -> np.ndarray:
    """Two points (T, 2, 3) that move at this velocity, m/s."""
    start = np.array([[0.0, 0, 0], [1, 0, 0]])
    return start + np.arange(total)[:, None, None] / FPS * np.array(velocity)


def test_slip_is_tangential_motion_beyond_the_truth() -> None:
    touching = np.ones((5, 2), bool)
    still = sliding((0, 0, 0))
    # 3-4-5 along the surface, and any speed away from it
    found = slip_speed(sliding((0.03, 0.04, 0.5)), still, touching, up, FPS)
    np.testing.assert_allclose(found[:3], 0.05)
    assert np.isnan(found[3:]).all()
    # skin that truly slides is to slide: what stays where it should glide is as wrong
    truly = sliding((0.02, 0, 0))
    np.testing.assert_allclose(slip_speed(truly, truly, touching, up, FPS)[:3], 0.0, atol=1e-12)
    np.testing.assert_allclose(slip_speed(still, truly, touching, up, FPS)[:3], 0.02)


def test_slip_requires_contact_at_both_ends() -> None:
    touching = np.ones((5, 2), bool)
    touching[2:, 1] = False  # the second lets go after 0.2 s
    fitted = sliding((0, 0, 0))
    fitted[:, 1] += np.arange(5)[:, None] * [1.0, 0, 0]
    found = slip_speed(fitted, sliding((0, 0, 0)), touching, up, FPS)
    np.testing.assert_allclose(found[:3], 0.0)
    touching[:] = False
    assert np.isnan(slip_speed(fitted, fitted, touching, up, FPS)).all()


def sole(height: np.ndarray, forward: np.ndarray, count: int = 20) -> np.ndarray:
    """A flat sole (T, S, 3) at these heights and ways (T,), metres."""
    points = np.zeros((len(height), count, 3))
    points[:, :, 0] = np.linspace(0, 0.2, count) + forward[:, None]
    points[:, :, 2] = height[:, None]
    return points


def test_support_is_low_and_still() -> None:
    height = np.array([0.0, 0.0, 0.0, 0.10, 0.10])
    forward = np.array([0.0, 0.0, 0.05, 0.05, 0.05])  # glides from 1 to 2, is high at rest after
    carrying = support(sole(height, forward), FLOOR, FPS)
    assert carrying.any(1).tolist() == [True, False, False, False]
    # one vertex of twenty that brushes the floor carries nobody, five of them do
    for lowest, stands in ((1, False), (5, True)):
        tiptoe = sole(np.full(2, 0.05), np.zeros(2))
        tiptoe[:, :lowest, 2] = 0.0
        assert support(tiptoe, FLOOR, FPS).any() == stands


def test_support_on_a_beam_is_near_its_top() -> None:
    standing = sole(np.full(3, 0.2), np.zeros(3))
    assert not support(standing, FLOOR, FPS).any()
    assert support(standing, FLOOR, FPS, np.full(3, 0.2)).all()
    # it comes over the beam between the first and the second frame
    assert support(standing, FLOOR, FPS, np.array([0.0, 0.2, 0.2])).any(1).tolist() == [False, True]


def test_planted_foot_has_speed_and_height_errors() -> None:
    true = sole(np.zeros(3), np.zeros(3))
    carrying = support(true, FLOOR, FPS)
    fitted = true + np.arange(3)[:, None, None] * [0.003, 0.0, 0.002]  # 30 mm/s, and rises
    found = foot_errors(fitted, true, carrying, FLOOR, FPS)
    np.testing.assert_allclose(found.speed, 0.03)
    np.testing.assert_allclose(found.height, [0.002, 0.004])
    assert np.isnan(found.swing).all()


def test_swinging_foot_has_position_errors() -> None:
    true = sole(np.full(3, 0.1), np.array([0.0, 0.1, 0.2]))
    frozen = sole(np.full(3, 0.1), np.zeros(3))
    found = foot_errors(frozen, true, support(true, FLOOR, FPS), FLOOR, FPS)
    np.testing.assert_allclose(found.swing, [0.1, 0.2])
    assert np.isnan(found.speed).all() and np.isnan(found.height).all()


def test_stated_contact_is_counted_by_frame_and_region() -> None:
    true = np.array([[True, False], [True, False], [True, True], [False, False]])
    probability = np.array([[0.9, 0.8], [0.9, 0.1], [0.4, 0.4], [0.6, 0.0]])
    distance = np.where(true, 0.0, np.array([[0, 0.02], [0, 0.2], [0, 0], [0.2, 0.2]]))
    found = detected_figures(probability, true, distance, ("hand", "foot"))
    # hand: two found, one missed, one false; foot: none found, one missed, one false
    assert found["contact_detected_precision"] == pytest.approx(2 / 4)
    assert found["contact_detected_recall"] == pytest.approx(2 / 4)
    assert found["contact_detected_f1"] == pytest.approx(0.5)
    assert found["contact_detected_hand_f1"] == pytest.approx(4 / 6)
    assert found["contact_detected_worst_region_f1"] == 0.0
    assert found["contact_detected_near_precision"] == pytest.approx(2 / 3)  # 0.2 m is not near
    squares = [0.01, 0.64, 0.01, 0.01, 0.36, 0.36, 0.36, 0.0]
    assert found["contact_detected_brier"] == pytest.approx(np.mean(squares))


def sequence(name: str, object_: str, **values: np.ndarray) -> SequenceMetrics:
    return SequenceMetrics(name, "p01", object_, FPS, True, values)


def held(name: str, object_: str, slip: list[float]) -> SequenceMetrics:
    """Two frames in which the left hand touches."""
    key, nan = "truth/joint/", np.full((2, 2), np.nan)
    offset = np.zeros((2, 22, 3))
    offset[:, :, 0] = [[0.003], [0.005]]
    region = np.zeros((2, len(METRIC_REGIONS)), bool)
    region[:, 0] = True
    return sequence(
        name,
        object_,
        **{
            f"{key}slip": np.array(slip),
            f"{key}fingertips": np.array([[0.01, 0.09], [0.03, 0.09]]),
            f"{key}joint_offset": offset,
            f"{key}acceleration_feet": np.array([0.001, 0.003]),
            f"{key}planted_speed": np.array([[np.nan, 0.02], [0.04, np.nan]]),
            f"{key}planted_height": nan,
            f"{key}foot_swing": nan,
            "truth/contact_region": region,
            "truth/region_distance": np.where(region, 0.0, 0.25),
            "contact_probability": np.where(region, 0.9, 0.0),
        },
    )


def test_slip_is_averaged_over_objects() -> None:
    some = [held("a", "cup", [0.1, np.nan]), held("b", "cup", [0.2, 0.3]), held("c", "bat", [0, 0])]
    assert slip_by_object(some, "joint") == pytest.approx({"bat": 0.0, "cup": 200.0})
    found = hold_figures(some, "joint")
    assert found["slip_mm_s"] == pytest.approx(100.0)
    assert found["fingertip_touching_mm"] == pytest.approx(20.0)  # the right hand is free
    assert found["joints_constant_mm"] == pytest.approx(4.0)
    assert found["joints_varying_mm"] == pytest.approx(1.0)
    assert found["acceleration_feet_mm"] == pytest.approx(2.0)
    assert found["planted_mm_s"] == pytest.approx(30.0)
    assert "floor_mm" not in found and "foot_swing_mm" not in found  # nobody is known to stand
    assert hold_figures(some, "body_fit") == {}
    stated = stated_contact_figures(some)
    assert stated["contact_detected_f1"] == 1.0
    assert stated["contact_detected_brier"] == pytest.approx(0.01 / len(METRIC_REGIONS))


def tracked(name: str, object_: str, before: float, after: float) -> SequenceMetrics:
    values: dict[str, np.ndarray] = {}
    for stage, error in (("object_track", before), ("joint", after)):
        key = f"truth/{stage}/object_"
        values |= {
            f"{key}translation": np.full(4, error),
            f"{key}rotation": np.zeros(4),
            f"{key}turn": np.zeros(4),
            f"{key}centre": np.zeros((4, 3)),
            f"{key}flagged": np.zeros(4, bool),
        }
    views, moving = np.full(4, 3), np.zeros(4, bool)
    true = {"views": views, "moving": moving, "centre": np.zeros((4, 3))}
    return sequence(name, object_, **values, **{f"truth/object_{k}": v for k, v in true.items()})


def test_an_object_is_worse_beyond_a_share_and_an_amount() -> None:
    some = [
        tracked("a", "cup", 0.0040, 0.0043),  # 7 % and 0.3 mm
        tracked("b", "bat", 0.0010, 0.0011),  # 10 %, but a tenth of a millimetre
        tracked("c", "box", 0.0200, 0.0205),  # half a millimetre, but 2 %
        tracked("d", "car", 0.0040, 0.0030),
    ]
    assert worse_objects(some) == ["cup"]


def test_reliability_by_hand() -> None:
    probability = np.array([[0.0, 0.01, 0.4, 0.4], [0.4, 0.45, 0.99, 1.0]])
    true = np.array([[0, 0, 1, 0], [0, 0, 1, 1]], bool)
    found = reliability(probability, true)
    np.testing.assert_array_equal(found.count, [2, 4, 2])
    np.testing.assert_allclose(found.stated, [0.005, 0.4125, 0.995])
    np.testing.assert_allclose(found.true, [0.0, 0.25, 1.0])
    np.testing.assert_allclose(calibration_error(probability, true), 0.4125 - 0.25)


def test_certain_statements_have_no_calibration_error() -> None:
    assert np.isnan(calibration_error(np.array([0.0, 1.0]), np.array([False, True])))
