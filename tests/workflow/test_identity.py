"""Without studio and truth, the artefacts of all stages have the same bytes."""

from __future__ import annotations

from pathlib import Path

import pytest

from intercap_core.pipeline.step import run_step
from intercap_core.project import load_project
from intercap_core.stage_list import STAGES
from tests.helpers.flow import ONE, Flow

BEFORE_METRICS = (
    "frames",
    "detections",
    "scene",
    "person",
    "object_track",
    "body_fit",
    "joint",
)


@pytest.fixture(scope="module")
def without_truth(recorded: Flow, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Artefacts of one sequence, computed from its recordings in a folder that holds no truth."""
    results = tmp_path_factory.mktemp("without_truth")
    settings = recorded.folder / recorded.settings
    project = load_project(settings, {"results": str(results)})
    project.artefact(ONE, "frames").parent.mkdir(parents=True)
    for stage in BEFORE_METRICS:
        inputs = {name: project.artefact(ONE, name) for name in STAGES[stage].reads}
        run_step(stage, project, ONE, inputs=inputs, output=project.artefact(ONE, stage))
    return project.artefact(ONE, "joint").parent


@pytest.mark.parametrize("stage", BEFORE_METRICS)
def test_artefacts_are_the_same_without_truth(flow: Flow, without_truth: Path, stage: str) -> None:
    made = without_truth / f"{stage}.h5"
    assert made.read_bytes() == flow.artefact(ONE, stage).read_bytes()


def test_artefacts_contain_no_path(flow: Flow) -> None:
    for path in (flow.results / ONE).glob("*.h5"):
        assert str(flow.folder).encode() not in path.read_bytes(), path
