"""The site through Snakemake's own report."""

from __future__ import annotations

import zipfile

from tests.helpers.browser import CHROMIUM, visit
from tests.helpers.flow import ONE, OTHER, Flow


def test_snakemake_s_report_holds_the_site(flow: Flow) -> None:
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
    told = (flow.folder / "unpacked" / "report" / "report.html").read_text()
    assert "Dataset" in told and "Sequences" in told and ONE in told
    if CHROMIUM is not None:
        with visit(page) as visited:
            visited.wait()
        assert visited.console == []
