"""One real run of a tiny recording, shared by the tests of the workflow."""

from __future__ import annotations

import shutil

import pytest

from tests.helpers.flow import ONE, OTHER, Flow


@pytest.fixture(scope="session")
def flow(tmp_path_factory: pytest.TempPathFactory) -> Flow:
    """A finished project of two virtual recordings. Tests undo their edits.

    The first sequence is computed, the second one is a copy of it under another name.
    """
    flow = Flow.copy(tmp_path_factory.mktemp("flow"))
    _run(flow, *(f"results/test/{name}" for name in (
        f"{ONE}/summary.h5", f"{ONE}/export", f"site/sequences/{ONE}"
    )))  # fmt: skip
    flow.duplicate(ONE, OTHER)
    _run(flow)
    return flow


def _run(flow: Flow, *targets: str) -> None:
    done = flow.run(*targets)
    logs = [path.read_text()[-600:] for path in sorted((flow.folder / "logs").rglob("*.log"))]
    assert done.returncode == 0, "\n".join([done.stderr[-3000:], *logs])


@pytest.fixture(scope="session")
def recorded(flow: Flow, tmp_path_factory: pytest.TempPathFactory) -> Flow:
    """The same recordings without studio and truth in another folder, after init, check and run.

    The recordings of one of the two sequences are unreadable. The summary of the other one has been
    made by replay; its other results are those of ``flow``.
    """
    other = Flow.copy(
        tmp_path_factory.mktemp("recorded"), settings="config/lab/config.yaml", replay=flow.results
    )
    shutil.copytree(flow.results / "recordings", other.folder / "captures")
    for path in (other.folder / "captures").rglob("truth.h5"):
        path.unlink()
    done = other.intercap(
        *("init", "captures", "--output", "config/lab"),
        *("--dataset", "test", "--objects", "config/objects.yaml"),
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 of 2 sequences are ready to run" in done.stdout
    settings = other.folder / "config" / "lab"
    shutil.copy2(other.folder / "config" / "test" / "subjects.tsv", settings)  # genders
    for path in (other.folder / "captures" / OTHER).glob("k*/*.jpg"):
        path.write_bytes(b"no image")
    for place in (ONE, f"site/sequences/{ONE}"):
        shutil.copytree(flow.results / place, other.results / place)
    other.artefact(ONE, "summary").unlink()
    other.rewrite_manifests()
    other.transcript.write_text(other.intercap("run", other.settings, "--cores", "2").stderr)
    return other
