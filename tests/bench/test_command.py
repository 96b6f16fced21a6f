"""Where the comparisons put their figures."""

from __future__ import annotations

import json
from pathlib import Path

from bench.command import add_figures


def test_figures_replace_older_ones_and_leave_the_others(tmp_path: Path) -> None:
    output = tmp_path / "bench.json"
    output.write_text('{"object.old": 1, "object_track.seconds_per_frame": 2}')
    add_figures(output, "object", {"ms_per_frame": 3.00004})
    found = json.loads(output.read_text())
    assert found == {"object_track.seconds_per_frame": 2, "object.ms_per_frame": 3.0}
