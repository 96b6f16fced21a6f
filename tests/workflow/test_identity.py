"""Without studio and truth, the artefacts of all stages have the same bytes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.flow import ONE, ROOT, Flow

BEFORE_METRICS = (
    "frames",
    "detections",
    "scene",
    "person",
    "object_track",
    "body_fit",
    "joint",
)


# Runs in a process of its own, as a job does: the number of threads must be set before a numerical
# library is imported. The jobs of the workflow have one thread.
COMPUTE = """
import sys
from pathlib import Path
from intercap_core.pipeline.job import set_threads
set_threads(2)
from intercap_core.pipeline.step import run_step
from intercap_core.project import load_project
settings, results, sequence, *stages = sys.argv[1:]
project = load_project(Path(settings), {"results": results})
project.artefact(sequence, stages[0]).parent.mkdir(parents=True)
for stage in stages:
    run_step(stage, project, sequence)
"""


@pytest.fixture(scope="module")
def without_truth(recorded: Flow, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Artefacts of one sequence, computed from its recordings in a folder that holds no truth."""
    results = tmp_path_factory.mktemp("without_truth")
    settings = recorded.folder / recorded.settings
    done = subprocess.run(
        [sys.executable, "-c", COMPUTE, str(settings), str(results), ONE, *BEFORE_METRICS],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    return results / recorded.results.name / ONE


@pytest.mark.parametrize("stage", BEFORE_METRICS)
def test_artefacts_are_the_same_without_truth_and_with_two_threads(
    flow: Flow, without_truth: Path, stage: str
) -> None:
    made = without_truth / f"{stage}.h5"
    assert made.read_bytes() == flow.artefact(ONE, stage).read_bytes()
