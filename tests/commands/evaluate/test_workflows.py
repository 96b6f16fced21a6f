"""Order of the workflows, and their jobs."""

from __future__ import annotations

import pytest

from intercap_core.commands.evaluate.part import Targets
from intercap_core.commands.evaluate.run import PARTS
from intercap_core.commands.evaluate.workflows import jobs_by_part, plan_runs
from intercap_core.project import load_project


@pytest.fixture(scope="module")
def wanted() -> dict[str, Targets]:
    return {
        name: part.targets([load_project(path) for path in part.settings])
        for name, part in PARTS.items()
    }


def test_projects_wait_for_those_that_make_their_recordings(
    wanted: dict[str, Targets],
) -> None:
    runs = plan_runs(wanted)
    by_name = {run.project.config.dataset: run for run in runs}
    assert len(runs) == len(by_name) == 1 + 3 + 3 + 6 + 4 + 7 + 2
    assert runs[0] is by_name["object"]  # what most wait for comes first
    stages = [PARTS[part].stage for part in ("sequences", "objects", "bodies")]
    assert by_name["object"].stages == stages
    for name in ("object_no_detector", "body_two_view"):
        assert by_name[name].after == [by_name["object"]]
    assert by_name["detector_measured"].after == [by_name["detector"]]
    assert by_name["object_noise2"].after == []


def test_only_people_without_object_are_exported(wanted: dict[str, Targets]) -> None:
    to_export = [run for run in plan_runs(wanted) if "export" in run.stages]
    assert [run.project.config.dataset for run in to_export] == ["field_alone"]
    assert to_export[0].stages == ["export"]
    jobs = jobs_by_part({"field": [("export", to_export[0].project)]})["field"]
    for name in to_export[0].project.sequences:
        own = [job.stage for job in jobs if job.sequence == name]
        assert own[0] == "studio" and own[-2:] == ["metrics", "export"] and len(own) == 10
