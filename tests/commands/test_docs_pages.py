"""Files that the pages name are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
NAMED = re.compile(r"`(?:python )?((?:[\w.]+/)*\w+\.(?:py|smk))`")


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_source_files_that_a_page_names_exist(page: Path) -> None:
    missing = [
        name
        for name in NAMED.findall(page.read_text(encoding="utf-8"))
        if not (ROOT / name).is_file()
        and not (ROOT / "intercap_core" / name).is_file()
        and not any((ROOT / "intercap_core").rglob(name))
    ]
    assert not missing
