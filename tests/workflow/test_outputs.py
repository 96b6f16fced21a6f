"""Outputs of a run: Snakemake's report contains the site, artefacts contain no path."""

from __future__ import annotations

import zipfile

from tests.helpers.browser import CHROMIUM, visit
from tests.helpers.flow import ONE, OTHER, Flow


def test_the_snakemake_report_contains_the_site(flow: Flow) -> None:
    done = flow.ask("--report", "report.zip")
    assert done.returncode == 0, done.stderr
    with zipfile.ZipFile(flow.folder / "report.zip") as archive:
        archive.extractall(flow.folder / "unpacked")
    pages = {
        path.read_text(): path for path in flow.folder.glob("unpacked/report/data/raw/*/*.html")
    }
    site = flow.results / "site"
    assert (site / "index.html").read_text() in pages
    for name in (ONE, OTHER):
        own = site / "sequences" / name
        page = pages[(own / "index.html").read_text()]
        assert page.with_name("viewer.js").read_bytes() == (own / "viewer.js").read_bytes()
    text = (flow.folder / "unpacked" / "report" / "report.html").read_text()
    assert "Dataset" in text and "Sequences" in text and ONE in text
    if CHROMIUM is not None:
        with visit(page) as visited:
            visited.wait()
        assert visited.console == []


def test_artefacts_contain_no_path(flow: Flow) -> None:
    for path in (flow.results / ONE).glob("*.h5"):
        assert str(flow.folder).encode() not in path.read_bytes(), path
