"""The part ``detector`` of the evaluation: slip of grips, and a machine without MediaPipe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from intercap_core.commands.evaluate.detector import grip_slips
from intercap_core.commands.evaluate.run import evaluate
from intercap_core.errors import UserError
from intercap_core.studio.mediapipe import VARIABLE


def test_a_grip_slips_by_what_its_error_changes() -> None:
    true = np.zeros((20, 2, 3))
    true[:, 0, 0] = np.linspace(0, 0.05, 20)  # a true slip is no error
    fitted = true + np.array([0.02, 0, 0])  # neither is a constant error
    holding = np.zeros((20, 2), bool)
    holding[2:18, 0] = True
    assert grip_slips(fitted, true, holding, 15.0) == [pytest.approx(0.0, abs=1e-12)]
    fitted[10:18, 0, 1] = 0.03  # half of the grip is 30 mm off: 15 mm from the mean
    assert grip_slips(fitted, true, holding, 15.0) == [pytest.approx(0.015)]


def test_short_touches_are_no_grips() -> None:
    wrists = np.random.default_rng(0).normal(size=(20, 2, 3))
    holding = np.zeros((20, 2), bool)
    holding[3:7, 1] = True  # 0.27 s
    assert grip_slips(wrists, np.zeros_like(wrists), holding, 15.0) == []


def test_without_mediapipe_the_part_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "none"))
    with pytest.raises(UserError, match="make mediapipe"):
        evaluate({"detector": []}, tmp_path / "out.json")
    assert not (tmp_path / "out.json").exists()
