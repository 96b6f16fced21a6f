"""Stated errors worked out by hand, and cases without a stated error."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench import verdict as bench
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.verdict.figures import stated_errors, verdict_figures
from intercap_core.evaluation.verdict.hold_out import HeldOut, JudgedPart, ViewErrors
from intercap_core.evaluation.verdict.stated import FACTORS, estimate_error

T = 4


def _held(shift: float, keypoint: float) -> HeldOut:
    none = np.full((T, 3), np.nan)
    empty = ViewErrors(none, none, none, none)
    every = {part: np.full((3, T), shift) for part in JudgedPart}
    still = {part: np.zeros(T) for part in JudgedPart}
    return HeldOut(np.arange(3), np.zeros(T, int), empty, empty, np.full(T, keypoint), every, still)


def test_features_add_up_as_squares() -> None:
    said = estimate_error(
        _held(0.003, 0.02), JudgedPart.BODY, np.full(T, 0.005), np.full(T, 0.004), np.ones(T, bool)
    )
    rest, (shift, keypoint, sigma, moved), spread = FACTORS[JudgedPart.BODY]
    jackknife = np.sqrt(2 / 3 * 3 * 0.003**2)
    expected = np.sqrt(
        rest**2
        + (shift * jackknife) ** 2
        + (keypoint * 0.02) ** 2
        + (sigma * 0.005) ** 2
        + (moved * 0.004) ** 2
    )
    assert said.error == pytest.approx(expected)
    assert said.by_frame == pytest.approx(np.full(T, expected))
    assert said.factor == spread and said.silent == ""


def test_filled_frames_have_no_stated_error() -> None:
    known = np.array([True, True, True, False])
    said = estimate_error(
        _held(0.003, 0.02), JudgedPart.OBJECT, np.full(T, 0.005), np.zeros(T), known
    )
    assert np.isfinite(said.error)
    np.testing.assert_array_equal(np.isfinite(said.by_frame), known)


@pytest.mark.parametrize(
    ("held", "known", "reason"),
    [
        (None, T, "fewer than two cameras"),
        (_held(0.003, 0.02), 1, "only 1 of 4 frames"),
        (_held(np.nan, 0.02), T, "only 0 of 4 frames"),
        (_held(0.003, np.nan), T, "only 0 of 4 frames"),
    ],
)
def test_no_stated_error_without_evidence(held: HeldOut | None, known: int, reason: str) -> None:
    said = estimate_error(
        held, JudgedPart.BODY, np.full(T, 0.005), np.zeros(T), np.arange(T) < known
    )
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


def test_factors_are_found_again() -> None:
    rng = np.random.default_rng(7)
    features = rng.uniform(0.001, 0.02, (400, 3))
    true = np.sqrt(0.004**2 + (features**2 * np.array([2.0, 0.6, 0.0]) ** 2).sum(axis=1))
    noisy = true * np.exp(rng.normal(0, 0.1, len(true)))
    kind = np.array(["a", "b"])[np.arange(len(true)) % 2]
    samples = bench.Samples(features, noisy, kind)
    factors = bench.fit(samples)
    assert factors.rest == pytest.approx(0.004, rel=0.2)
    assert factors.of == pytest.approx((2.0, 0.6, 0.0), abs=0.15)
    # four of five of a normal deviate are within 1.28 deviations
    assert factors.spread == pytest.approx(np.exp(1.28 * 0.1), rel=0.03)
    assert np.median(np.abs(np.log(bench.cross_validated(samples) / true))) < 0.03


def test_file_without_verdict_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert bench.main([str(tmp_path / "absent.h5")]) == 2
    assert "absent.h5" in capsys.readouterr().err
