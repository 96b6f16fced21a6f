"""The commands of docs/exports.md open what was exported."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from intercap_core.output.export.registry import formats
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted
from tests.helpers.site import merge, write_summaries

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "exports.md").read_text("utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
FILES = [re.findall(r'"((?:\.\./)*\w+[/.][\w/.]*)"', code) for code in SNIPPETS]


@pytest.fixture(scope="module")
def folder(
    captures: Mapping[str, fitted.Capture],
    everything: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """Export of a sequence in the folder of its dataset, whose card is written."""
    results = tmp_path_factory.mktemp("demo")
    merge(write_summaries(captures, results / "summaries"), captures, results, "demo")
    out = results / exported.NAME / "export"
    shutil.copytree(everything, out)
    exported.run(captures[exported.NAME], results / "other", formats=["bvh"])
    shutil.copytree(results / "other" / "bvh", out / "bvh")
    return out


def test_every_format_is_opened() -> None:
    commands = " ".join(re.findall(r"```\w+\n(.*?)```", PAGE, re.DOTALL))
    assert [name for name in formats() if not re.search(rf"\b{name}/|path {name}", commands)] == []


@pytest.mark.parametrize("code", SNIPPETS, ids=[files[0] if files else "loader" for files in FILES])
def test_a_snippet_runs(
    folder: Path, code: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for module in re.findall(r"^(?:import|from) (\w+)", code, re.MULTILINE):
        pytest.importorskip(module)
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {}
    exec(code.replace("cup_drink_s02", exported.NAME), names)
    if "print(" in code:
        assert capsys.readouterr().out.strip()
