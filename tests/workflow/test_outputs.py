"""Outputs of a run: the site in Snakemake's report, artefacts without paths, shared processes."""

from __future__ import annotations

import zipfile

from intercap_core.stage_list import STAGES
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


def test_stages_that_share_a_process_write_the_same_bytes(flow: Flow) -> None:
    """The run of the fixture joined frames to person, and joint to summary."""
    benchmarks = flow.folder / "benchmarks" / "test" / ONE
    shared = {"frames_to_person", "joint_to_summary"}
    assert {path.stem for path in benchmarks.glob("*.tsv")} >= {*STAGES, *shared}
    stages = ("detections", "scene", "person", "metrics", "summary")
    kept = {path: path.read_bytes() for path in (flow.artefact(ONE, stage) for stage in stages)}
    for path in kept:
        path.unlink()
    try:
        targets = [str(path.relative_to(flow.folder)) for path in kept]
        done = flow.run(*targets, "--config", "one_process=[]")
        assert done.returncode == 0, done.stderr[-3000:]
        assert {path: path.read_bytes() for path in kept} == kept
    finally:
        for path, content in kept.items():
            path.write_bytes(content)
