"""One real run of a tiny capture, shared by the tests of the workflow."""

from __future__ import annotations

import shutil

import pytest

from tests.helpers.flow import OTHER, Flow


@pytest.fixture(scope="session")
def flow(tmp_path_factory: pytest.TempPathFactory) -> Flow:
    """A finished run of two virtual recordings. Tests put back what they edit."""
    flow = Flow.copy(tmp_path_factory.mktemp("flow"))
    done = flow.run()
    logs = [path.read_text()[-600:] for path in sorted((flow.folder / "logs").rglob("*.log"))]
    assert done.returncode == 0, "\n".join([done.stderr[-3000:], *logs])
    return flow


@pytest.fixture(scope="session")
def recorded(flow: Flow, tmp_path_factory: pytest.TempPathFactory) -> Flow:
    """The same recordings without studio and truth, in another folder, run by `intercap run`.

    The recordings of one of the two sequences cannot be read. The stages are replayed.
    """
    other = Flow.copy(
        tmp_path_factory.mktemp("recorded"), settings="config/lab/config.yaml", replay=flow.results
    )
    shutil.copytree(flow.results / "recordings", other.folder / "captures")
    for path in (other.folder / "captures" / OTHER).glob("*.mkv"):
        path.write_bytes(b"not a recording")
    for path in (other.folder / "captures").rglob("truth.h5"):
        path.unlink()
    settings = other.folder / "config" / "lab"
    settings.mkdir()
    (settings / "config.yaml").write_text("dataset: test\nobjects: ../objects.yaml\n")
    shutil.copy2(other.folder / "config" / "test" / "subjects.tsv", settings)
    rows = (other.folder / "config" / "test" / "sequences.tsv").read_text().splitlines()
    without_truth = [row.rpartition("\t")[0] for row in rows]
    text = "\n".join(without_truth).replace("results/test/recordings", "captures") + "\n"
    (settings / "sequences.tsv").write_text(text)
    other.transcript.write_text(other.intercap("run", other.settings, "--cores", "2").stderr)
    return other
