"""The regression gate of the quick evaluation."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench.evaluate.reference import (
    GatedFigure,
    GateResult,
    passes_gate,
    read_reference,
    update_reference,
)
from intercap_core.errors import UserError

ERROR = GatedFigure(value=7.0, spread=0.5, better="lower")
SCORE = GatedFigure(value=0.9, spread=0.05, better="higher")


@pytest.mark.parametrize(
    ("figure", "now", "expected"),
    [
        (ERROR, 7.5, GateResult.SAME),
        (ERROR, 7.6, GateResult.WORSE),
        (ERROR, 6.4, GateResult.BETTER),
        (SCORE, 0.86, GateResult.SAME),
        (SCORE, 0.84, GateResult.WORSE),
        (SCORE, 0.96, GateResult.BETTER),
        (ERROR, None, GateResult.MISSING),
        (ERROR, float("nan"), GateResult.MISSING),
    ],
)
def test_figure_is_worse_beyond_its_spread_in_its_bad_direction(
    figure: GatedFigure, now: float | None, expected: GateResult
) -> None:
    assert figure.judge(now) == expected


def test_gate_prints_all_figures_and_fails_on_worse_or_missing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    gate = {"error_mm": ERROR, "score": SCORE}
    assert passes_gate({"error_mm": 7.2, "score": 0.95}, gate)
    assert not passes_gate({"error_mm": 8.0, "score": 0.95}, gate)
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["error_mm", "7.000", "7.200", "0.500", "same"] in rows
    assert ["error_mm", "7.000", "8.000", "0.500", "worse"] in rows
    assert not passes_gate({"error_mm": 7.2}, gate)
    assert "or missing: score" in capsys.readouterr().out


def test_update_replaces_values_and_keeps_spreads(tmp_path: Path) -> None:
    path = tmp_path / "reference.json"
    entry = {"value": 7.0, "spread": 0.5, "better": "lower"}
    path.write_text(json.dumps({"error_mm": entry}))
    update_reference({"error_mm": 6.0, "not.gated": 1.0}, path)
    expected = {"error_mm": GatedFigure(value=6.0, spread=0.5, better="lower")}
    assert read_reference(path) == expected
    with pytest.raises(UserError, match=r"not updated.*error_mm"):
        update_reference({}, path)
    assert read_reference(path) == expected
