"""Order of the workflows, their expected work, and their remaining work."""

from __future__ import annotations

from pathlib import Path

import pytest

from intercap_core.commands.evaluate.part import Targets
from intercap_core.commands.evaluate.run import PARTS
from intercap_core.commands.evaluate.workflows import (
    Job,
    ProjectRun,
    expected_seconds,
    frames_of_recordings,
    jobs_by_part,
    plan_runs,
    progress,
)
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


def test_a_smaller_ring_is_expected_to_take_less() -> None:
    """The studio renders all cameras; a stage reads those that the settings select."""
    four, six, of_six = (
        load_project(Path(f"config/{name}.yaml"))
        for name in ("field/rates", "field/shoes", "body/four_view")
    )
    for stage in ("studio", "scene"):
        some, every, start = (
            expected_seconds(Job(project, "", stage), frames)
            for project, frames in ((four, 60), (six, 60), (six, 0))
        )
        assert some - start == pytest.approx(4 / 6 * (every - start))
    scene, studio = (expected_seconds(Job(of_six, "", stage), 60) for stage in ("scene", "studio"))
    assert scene == expected_seconds(Job(four, "", "scene"), 60)
    assert studio == expected_seconds(Job(six, "", "studio"), 60)


def test_each_part_is_expected_to_keep_to_its_budget(wanted: dict[str, Targets]) -> None:
    frames = frames_of_recordings(project for targets in wanted.values() for _, project in targets)
    for part, jobs in jobs_by_part(wanted).items():
        seconds = [
            expected_seconds(
                job, frames.get(job.project.sequences[job.sequence].recordings.resolve(), 45)
            )
            for job in jobs
        ]
        assert sum(seconds) / 120 <= PARTS[part].budget_minutes
    assert sum(part.budget_minutes for part in PARTS.values()) <= 60


def test_remaining_work_shrinks_as_jobs_end(tmp_path: Path) -> None:
    project = load_project(Path("config/test/config.yaml"))
    run = ProjectRun(project, ["scene"], {"frames": [10.0, 30.0], "scene": [60.0, 60.0]})
    assert run.left() == (160.0, 0.0)

    class Watcher:
        transcript = tmp_path / "snakemake.log"

        def jobs(self) -> dict[str, object]:
            return {"a: frames": type("State", (), {"state": "finished"})}

    run.watcher = Watcher()  # type: ignore[assignment]
    run.watcher.transcript.write_text(
        "Job stats:\njob  count\n---\nframes  1\nscene  2\ntotal  3\n"
    )
    assert run.left() == (120.0, 20.0)
    assert progress([run], 2, 0.0) == "0 of 1 projects done after 0 minutes, at most 1 left"
    run.status = 0
    assert run.left() == (0.0, 140.0)
