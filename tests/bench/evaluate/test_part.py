"""Recordings without truth, and standard errors of figures."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.evaluate.captures import PART
from bench.evaluate.part import measure_recording, with_spread
from intercap_core.config import Config
from intercap_core.errors import UserError
from intercap_core.project import Project
from tests.helpers.kinect_files import entry_of


def test_a_missing_truth_is_named(tmp_path: Path) -> None:
    """A recording was interrupted, and its results remain."""
    entry = entry_of(tmp_path, cameras=2).model_copy(update={"truth": tmp_path / "truth.h5"})
    config = Config(dataset="trial", results=tmp_path)
    project = Project(config, tmp_path / "config.yaml", {"one": entry}, {}, {})
    with pytest.raises(UserError, match=r"truth.h5: the truth of 'one' is missing.*remove .*one"):
        measure_recording(PART, project, "one")


def test_the_spread_is_the_standard_error_over_recordings() -> None:
    def figures(values: list[float]) -> dict[str, float]:
        return {"mm": sum(values) / len(values), "worst_mm": max(values)}

    found = with_spread(figures, [1.0, 3.0])
    assert found == {"mm": 2.0, "worst_mm": 3.0, "mm_spread": pytest.approx(1.0)}
    assert with_spread(figures, [1.0]) == {"mm": 1.0, "worst_mm": 1.0}
