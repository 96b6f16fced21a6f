"""Answers of Slurm's commands and the executor's reactions; without Slurm."""

from __future__ import annotations

import asyncio
import logging
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
from snakemake_executor_plugin_slurm import Executor as SlurmExecutor
from snakemake_interface_common.exceptions import WorkflowError
from snakemake_interface_executor_plugins.executors.base import SubmittedJobInfo

import snakemake_executor_plugin_intercap_slurm as plugin
from snakemake_executor_plugin_intercap_slurm import slurm
from snakemake_executor_plugin_intercap_slurm.ledger import JobEntry
from tests.slurm.test_ledger import Job, log


def answer(monkeypatch: pytest.MonkeyPatch, text: str, status: int = 0) -> None:
    done = subprocess.CompletedProcess([], status, text, "")
    monkeypatch.setattr(slurm, "_run", lambda command: done)


def test_jobs_held_by_slurm_differ_from_user_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    answer(
        monkeypatch,
        "1|RUNNING|None\n2|PENDING|launch failed requeued held\n3|PENDING|JobHeldUser\n\n"
        "4|PENDING|launch_failed_requeued_held\n5|PENDING|JobHoldMaxRequeue\n6|COMPLETED|None\n",
    )
    assert slurm.states("name") == {
        "1": "RUNNING", "2": slurm.HELD, "3": "PENDING", "4": slurm.HELD, "5": slurm.HELD,
        "6": "COMPLETED",
    }  # fmt: skip
    assert slurm.HELD in slurm.LIVE


def test_no_answer_is_not_an_empty_queue(monkeypatch: pytest.MonkeyPatch) -> None:
    answer(monkeypatch, "")
    assert slurm.states("name") == {}
    answer(monkeypatch, "", status=1)
    assert slurm.states("name") is None
    monkeypatch.setattr(slurm, "_run", lambda command: None)  # not in time
    assert slurm.states("name") is None


class Executor(plugin.Executor):
    """One that was not started, and writes down what it reports."""

    def __init__(self) -> None:
        self.run_uuid, self.logger = "name", logging.getLogger(__name__)
        self._polled: list[SubmittedJobInfo] = []
        self._over: set[int] = set()
        self._missing_since: dict[str, float] = {}
        self._last_submission = 0.0
        settings = SimpleNamespace(init_seconds_before_status_checks=5)
        self.workflow = SimpleNamespace(executor_settings=settings)
        self.reported: list[str] = []

    def report_job_success(self, job_info: SubmittedJobInfo) -> None:
        self.reported.append("success")

    def report_job_error(self, job_info: SubmittedJobInfo, msg: str | None = None, **_) -> None:
        self.reported.append(str(msg))

    def still_active(self, *jobs: SubmittedJobInfo) -> list[SubmittedJobInfo]:
        async def collect() -> list[SubmittedJobInfo]:
            return [info async for info in self.check_active_jobs(list(jobs))]

        return asyncio.run(collect())


def submitted(folder: Path, number: str) -> SubmittedJobInfo:
    job = Job(folder)
    aux = {plugin.ENTRY: JobEntry.of(job), "slurm_logfile": folder / f"{number}.log"}
    return SubmittedJobInfo(job, number, aux)


def test_jobs_stay_active_if_the_controller_does_not_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plugin, "states", lambda name: None)
    monkeypatch.setattr(SlurmExecutor, "check_active_jobs", None)
    jobs = [submitted(tmp_path, "7"), submitted(tmp_path, "8")]
    executor = Executor()
    assert executor.still_active(*jobs) == jobs
    assert executor.reported == []


@pytest.mark.parametrize("finished", [True, False])
def test_a_held_job_is_cancelled_and_judged_by_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, finished: bool
) -> None:
    async def none_ended(self: object, jobs: list[SubmittedJobInfo]):
        for info in jobs:
            yield info

    cancelled: list[str] = []
    monkeypatch.setattr(plugin, "states", lambda name: {"7": slurm.HELD, "8": "PENDING"})
    monkeypatch.setattr(plugin, "cancel", lambda number, name: cancelled.append(number))
    monkeypatch.setattr(SlurmExecutor, "check_active_jobs", none_ended)
    held, waits = submitted(tmp_path, "7"), submitted(tmp_path, "8")
    if finished:
        log(tmp_path, "joint", "finished in 3.0 s")
    executor = Executor()
    assert executor.still_active(held, waits) == [waits]
    assert cancelled == ["7"]
    (said,) = executor.reported
    assert ("success" if finished else "Slurm could not launch job '7'") in said


def test_ctrl_c_cancels_jobs_that_are_being_polled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    cancelled: list[str | None] = []

    def no_answer(self: object, jobs: list[SubmittedJobInfo]) -> None:
        cancelled.extend(info.external_jobid for info in jobs)
        raise WorkflowError("Unable to cancel jobs")

    monkeypatch.setattr(SlurmExecutor, "cancel_jobs", no_answer)
    active, looked_at, ended = (submitted(tmp_path, number) for number in "789")
    executor = Executor()
    executor._polled = [active, looked_at, ended]
    executor._over = {id(ended)}
    executor.cancel_jobs([active])
    assert cancelled == ["7", "8"]
    assert "scancel --name name" in caplog.text
