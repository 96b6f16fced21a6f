"""Files and formats that the pages name are there."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from intercap_core.formats.calibration.files import calibration_readers
from intercap_core.formats.detections.keypoints import readers as keypoint_readers
from intercap_core.formats.recordings.layouts import INPUTS
from intercap_core.formats.recordings.ros.layout import SCHEMES
from intercap_core.output.export.registry import formats as export_formats

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


def test_the_readme_lists_every_format_and_its_library() -> None:
    """Formats of the registries are in the table; its versions are those of the test extra."""
    section = (ROOT / "README.md").read_text("utf-8").partition("## Formats")[2]
    rows = [line.split("|")[1:4] for line in section.partition("\n## ")[0].splitlines()]
    texts = {
        direction: " ".join(name for name, way, _ in (r for r in rows if len(r) == 3)
                            if way.strip() == direction)
        for direction in ("read", "written")
    }  # fmt: skip
    for name in export_formats():
        assert f"`{name}`" in texts["written"]
    read = [*(f"`{name}" for name in INPUTS), "ROS:"]
    read += [reader.tool for reader in (*calibration_readers(), *keypoint_readers())]
    assert [name for name in read if name not in texts["read"]] == []
    recorders = {scheme.read.__module__.rpartition(".")[2] for scheme in SCHEMES} - {"standard"}
    assert len(recorders) == 2 and all(name in texts["read"].lower() for name in recorders)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    stated = [*project["dependencies"], *project["optional-dependencies"]["test"]]
    ranges = {r.name.lower(): r.specifier for r in map(Requirement, stated)}
    tested = [re.match(r" (\w[\w-]*) (\d[\d.]*)\b", row[2]) for row in rows if len(row) == 3]
    libraries = {match[1].lower(): match[2] for match in tested if match}
    assert len(libraries) >= 10
    for library, version in libraries.items():
        assert version in ranges[library], f"{library} {version}: the tests use {ranges[library]}"
