"""Stated errors worked out by hand, and cases without a stated error."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from intercap_core.body.joints import FIRST_FINGER, JOINT_INDEX
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.verdict.figures import stated_errors, verdict_figures
from intercap_core.evaluation.verdict.hold_out import HeldOut, JudgedPart, ViewErrors
from intercap_core.evaluation.verdict.judge import start_sigma
from intercap_core.evaluation.verdict.stated import CALIBRATION, estimate_error
from intercap_core.joint.sequential import SequentialFits

T = 4


def _held(shift: float, surface: float = 0.02, common: float = 0.005) -> HeldOut:
    none = np.full((T, 3), np.nan)
    empty = ViewErrors(none, none, none, none)

    def every(*values: float) -> dict[JudgedPart, np.ndarray]:
        return {part: np.tile(np.array(values)[:, None], (1, T)).squeeze() for part in JudgedPart}

    return HeldOut(
        np.arange(3), np.zeros(T, int), empty, empty,
        every(shift, shift, shift), every(surface), every(common), every(0.0),
    )  # fmt: skip


JACKKNIFE = np.sqrt(2 / 3 * 3 * 0.003**2)  # of three cameras that each move a part by 3 mm


@pytest.mark.parametrize(
    ("part", "features"),
    [
        (JudgedPart.BODY, (JACKKNIFE, 0.02, 0.005, 0.004)),
        (JudgedPart.HANDS, (JACKKNIFE, 0.02, 0.005, 0.004)),
        (JudgedPart.OBJECT, (JACKKNIFE, 0.005)),  # without surface points and sigma
    ],
)
def test_features_add_up_as_squares(part: JudgedPart, features: tuple[float, ...]) -> None:
    said = estimate_error(_held(0.003), part, np.full(T, 0.004), np.ones(T, bool))
    expected = CALIBRATION[part].scale * np.linalg.norm(features)
    assert said.features == pytest.approx([JACKKNIFE, 0.02, 0.005, 0.004])
    assert said.error == pytest.approx(expected)
    assert said.by_frame == pytest.approx(np.full(T, expected))
    assert said.factor == CALIBRATION[part].spread and said.silent == ""


def test_fingers_have_the_errors_of_the_smoothed_hand_and_of_the_wrist() -> None:
    """The body fit's own deviation of an unseen hand does not count: neighbours determine it."""
    joints = np.full((T, 55), 0.035)
    joints[:, [JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"]]] = [0.003, 0.012]
    hands = np.tile([0.004, 0.005], (T, 1))
    fits = cast(SequentialFits, SimpleNamespace(joint_sigma=joints, hand_sigma=hands))
    fingers = np.where(np.arange(55) < FIRST_FINGER, 0, 1 / 30)
    sigma = start_sigma(fits, JudgedPart.HANDS, fingers)
    np.testing.assert_allclose(sigma, np.sqrt(3 * (0.005**2 + 0.013**2) / 2))


def test_filled_frames_have_no_stated_error() -> None:
    known = np.array([True, True, True, False])
    said = estimate_error(_held(0.003), JudgedPart.OBJECT, np.full(T, 0.005), known)
    assert np.isfinite(said.error)
    np.testing.assert_array_equal(np.isfinite(said.by_frame), known)


@pytest.mark.parametrize(
    ("held", "known", "reason"),
    [
        (None, T, "fewer than two cameras"),
        (_held(0.003), 1, "only 1 of 4 frames"),
        (_held(np.nan), T, "only 0 of 4 frames"),
        (_held(0.003, common=np.nan), T, "does not compare its images"),
    ],
)
def test_no_stated_error_without_evidence(held: HeldOut | None, known: int, reason: str) -> None:
    said = estimate_error(held, JudgedPart.OBJECT, np.full(T, 0.005), np.arange(T) < known)
    assert np.isnan(said.error) and np.isnan(said.by_frame).all()
    assert reason in said.silent


def _sequence(name: str, stated: float, true: float, silent: str = "") -> SequenceMetrics:
    values = {
        "verdict/part_names": np.array(["body"]),
        "verdict/error": np.array([1e-3 * stated]),
        "verdict/error_factor": np.array([1.5]),
        "verdict/silent": np.array([silent]),
        "verdict/error_frame": np.full((1, 3), 1e-3 * stated),
        "truth/joint/body_pve": np.full(3, 1e-3 * true),
    }
    return SequenceMetrics(name, "p", "cup", 30.0, True, values)


def test_figures_of_stated_errors() -> None:
    # three in order, one of them off by a factor of 2; a fourth of which nothing is said
    sequences = [
        _sequence("a", 6, 6),
        _sequence("b", 12, 24),
        _sequence("c", 30, 40),
        _sequence("d", np.nan, 50, "no camera"),
    ]
    found = verdict_figures(sequences)
    assert found["rank_correlation_body"] == pytest.approx(1)
    assert found["within_factor_share"] == pytest.approx(2 / 3)
    assert found["bad_sequence_recall"] == pytest.approx(1 / 2)
    assert found["silent_share"] == pytest.approx(1 / 4)
    assert found["coverage_body"] == pytest.approx(2 / 3)  # 24 is outside 8 to 18
    assert found["range_factor_body"] == pytest.approx(1.5)


def test_the_true_error_is_that_of_frames_with_a_stated_one() -> None:
    """Where a pose is filled in, nothing is stated, and the flags say so."""
    sequence = _sequence("a", 6, 6)
    sequence.values["truth/joint/body_pve"] = np.array([0.006, 0.008, 0.9])
    sequence.values["verdict/error_frame"] = np.array([[0.006, 0.006, np.nan]])
    assert stated_errors(sequence)[0].true == pytest.approx(7)
    sequence = replace(sequence, values=dict(sequence.values))
    sequence.values["verdict/error_frame"] = np.full((1, 3), np.nan)  # of no frame: then of all
    assert stated_errors(sequence)[0].true == pytest.approx(1e3 * (0.006 + 0.008 + 0.9) / 3)


def test_odd_against_even_is_of_frames_with_a_stated_error() -> None:
    sequence = _sequence("a", 6, 6)
    assert np.isnan(stated_errors(sequence)[0].repeated)  # older metrics, or nothing held out
    sequence = replace(sequence, values=dict(sequence.values))
    sequence.values["verdict/repeated"] = np.array([[0.001, 0.003, 0.5]])
    sequence.values["verdict/error_frame"] = np.array([[0.006, 0.006, np.nan]])
    assert stated_errors(sequence)[0].repeated == pytest.approx(2)


def test_no_figures_without_verdict_or_truth() -> None:
    bare = SequenceMetrics("a", "p", "cup", 30.0, False, {})
    assert not stated_errors(bare) and verdict_figures([bare]) == {}
