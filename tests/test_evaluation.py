"""What `intercap evaluate` refuses and prints; the workflow itself is tested elsewhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from intercap_core.capture_evaluation import CaptureEvaluation, evaluate_captures, print_captures
from intercap_core.errors import UserError
from intercap_core.metrics import capture
from intercap_core.metrics.capture import CaptureErrors, SlipCounts
from intercap_core.project import load_project

CONFIGS = sorted(Path("config/capture").glob("*.yaml"))


def test_captures_of_the_evaluation_are_apart_from_all_others() -> None:
    seeds: list[int] = []
    for path in CONFIGS:
        studio = load_project(path).config.studio
        assert studio is not None and studio.slips == "silent"
        rooms = [entry.room for entry in studio.captures.values()]
        assert {"furnished", "bare"} == set(rooms)
        seeds += [entry.seed for entry in studio.captures.values()]
    for other in ("demo", "test", "bench", "evaluation"):
        studio = load_project(Path(f"config/{other}/config.yaml")).config.studio
        assert studio is not None
        seeds += {entry.seed for entry in studio.captures.values()}
    assert len(CONFIGS) == 3 and len(seeds) == len(set(seeds))


def test_captures_without_truth_cannot_be_evaluated() -> None:
    with pytest.raises(UserError, match="has no truth to be evaluated against"):
        evaluate_captures(load_project(Path("config/config.yaml")))


def test_every_capture_and_figure_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    none = np.zeros(0)
    slips = SlipCounts(found=1, missed=1, false=0, images_wrong=3, images=50)
    many = CaptureErrors(
        "many", "bare", np.array([0.02]), np.array([0.004]), np.array([-0.001]), np.array([np.nan]),
        slips, 0.0015, 0.05, none,
    )  # fmt: skip
    alone = CaptureErrors("alone", "", none, none, none, none, slips, np.nan, np.nan, none)
    errors = [many, alone]
    found = CaptureEvaluation("capture", errors, capture.figures(errors), ["broken"], 1)
    print_captures([found])
    printed = capsys.readouterr().out
    for words in ("many", "alone", "broken", "1 of 2", "1.50", "extrinsics_floor_only_mm"):
        assert words in printed
    assert "nan" not in printed
