"""Every benchmark can be imported, and every one with a command line prints its help."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from bench.command import add_figures

BENCH = Path(__file__).parents[2] / "bench"
MODULES = sorted(path.stem for path in BENCH.glob("*.py"))
COMMANDS = [
    name
    for name in MODULES
    if "__main__" in (text := (BENCH / f"{name}.py").read_text(encoding="utf-8"))
    and ("ArgumentParser" in text or "from_command_line(" in text)
]


@pytest.mark.parametrize("name", MODULES)
def test_module_imports(name: str) -> None:
    import_module(f"bench.{name}")


@pytest.mark.parametrize("name", COMMANDS)
def test_command_prints_its_help(name: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", f"bench.{name}", "--help"], capture_output=True, text=True
    )
    assert done.returncode == 0 and "usage:" in done.stdout, done.stderr


def test_figures_replace_those_of_their_area_alone(tmp_path: Path) -> None:
    output = tmp_path / "bench.json"
    output.write_text('{"object.old": 1, "object_track.seconds_per_frame": 2}')
    add_figures(output, "object", {"ms_per_frame": 3.00004})
    found = json.loads(output.read_text())
    assert found == {"object_track.seconds_per_frame": 2, "object.ms_per_frame": 3.0}
