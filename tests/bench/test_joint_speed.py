"""By which rules the joint stage and the paper's recipe are compared."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from bench.joint_speed import _known, moment


def test_the_first_state_as_good_as_wanted() -> None:
    assert moment(np.array([6.0, 5.2, 5.05, 4.0]), 5.0) == (2, True)


def test_the_best_state_where_none_is_as_good() -> None:
    assert moment(np.array([6.0, 5.6, 5.5, 5.8]), 5.0) == (2, False)


def test_the_start_is_nobodys_result() -> None:
    assert moment(np.array([4.0, 6.0, 5.0, 5.0]), 5.0) == (2, True)
    assert moment(np.array([4.0, 6.0, 5.6]), 5.0) == (2, False)


def test_the_figure_of_the_whole_run_stays(tmp_path: Path) -> None:
    output = tmp_path / "bench.json"
    assert _known(output, "joint.peak_memory_mb") == {}
    output.write_text(json.dumps({"joint.peak_memory_mb": 700.0, "joint.frames": 3}))
    assert _known(output, "joint.peak_memory_mb") == {"peak_memory_mb": 700.0}
