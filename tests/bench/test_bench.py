"""Every benchmark can be imported, and figures of one area replace no others."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path

import pytest

from bench.command import add_figures

BENCH = Path(__file__).parents[2] / "bench"
MODULES = sorted(path.stem for path in BENCH.glob("*.py"))


@pytest.mark.parametrize("name", MODULES)
def test_module_imports(name: str) -> None:
    import_module(f"bench.{name}")


def test_figures_replace_those_of_their_area_alone(tmp_path: Path) -> None:
    output = tmp_path / "bench.json"
    output.write_text('{"object.old": 1, "object_track.seconds_per_frame": 2}')
    add_figures(output, "object", {"ms_per_frame": 3.00004})
    found = json.loads(output.read_text())
    assert found == {"object_track.seconds_per_frame": 2, "object.ms_per_frame": 3.0}
