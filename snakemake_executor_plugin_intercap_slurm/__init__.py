"""Snakemake's Slurm executor, with what a dataset of hundreds of sequences asks of it.

Executor ``intercap-slurm`` submits, asks and cancels as ``snakemake-executor-plugin-slurm`` does,
whose settings it has under its own prefix. Beyond that:

- A job that failed by a user's mistake is not submitted again; one that was killed is.
- Jobs that outlived their Snakemake are found again, and waited for instead of started twice;
  where what they compute is asked for otherwise by now, they are cancelled.
- A controller that does not answer is waited for: no job is lost, no submission fails.
- A job is one start of Snakemake on its node, not two.
- A job that Slurm has forgotten, or holds after a failed launch, is not waited for for ever.
- Ctrl-C cancels all jobs; where the controller does not answer, it says that they go on.
- Why a job failed is told by stage, also where several went as one submission.
"""

from __future__ import annotations

import threading
import time
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snakemake_executor_plugin_slurm import Executor as SlurmExecutor
from snakemake_executor_plugin_slurm import ExecutorSettings as SlurmSettings
from snakemake_executor_plugin_slurm import common_settings as common_settings
from snakemake_interface_common.exceptions import WorkflowError
from snakemake_interface_executor_plugins.executors.base import SubmittedJobInfo
from snakemake_interface_executor_plugins.jobs import JobExecutorInterface

from .ledger import Entry, Ledger, by_outputs, run_name
from .slurm import HELD, LIVE, cancel, states, wait_for_controller
from .words import Ending, endings

LONGEST_BETWEEN_CHECKS_S = 20.0
SHARE_BETWEEN_CHECKS = 0.25  # of the time since a job was last submitted: short jobs, short waits
FORGOTTEN_AFTER_S = 120.0  # longer than a controller takes to come back and read its state
NOT_REACHED = "Unable to contact slurm controller (connect failure)"  # then nothing was submitted
ENTRY = "intercap_entry"


@dataclass
class ExecutorSettings(SlurmSettings):
    """The Slurm plugin's own settings."""


class Executor(SlurmExecutor):
    """Submits to Slurm; see the module."""

    def __init__(self, workflow: Any, logger: Any) -> None:
        # Before the executor's own start, which begins to look for jobs that have ended.
        self._ledger = Ledger(Path(".snakemake") / "slurm_jobs")
        self._left: dict[tuple[str, ...], Entry] | None = None
        self._looking = threading.Lock()
        self._ending = threading.Event()
        self._asked: dict[JobExecutorInterface, Entry] = {}
        self._not_reached: set[JobExecutorInterface] = set()
        self._looked_at: list[SubmittedJobInfo] = []
        self._over: set[int] = set()
        self._final: set[JobExecutorInterface] = set()
        self._missing_since: dict[str, float] = {}
        self._last_submission = time.monotonic()
        super().__init__(workflow, logger)

    def __post_init__(self, test_mode: bool = False) -> None:
        super().__post_init__(test_mode)
        # One name for all runs of a folder: a job's state is asked by name.
        self.run_uuid = run_name(self.workflow.executor_settings.jobname_prefix)
        self.logger.info(f"Slurm's name for this folder's jobs: {self.run_uuid}")

    def additional_general_args(self) -> str:
        """The submission itself computes; a Slurm step of its own would start Snakemake again."""
        return "--executor local"

    def get_account_arg(self, job: JobExecutorInterface) -> Iterator[str]:
        """Where no account is named, none is guessed: Slurm takes the user's default."""
        return super().get_account_arg(job) if job.resources.get("slurm_account") else iter([""])

    def run_job(self, job: JobExecutorInterface) -> None:
        """Submit one job, unless an earlier run has: then wait for that one."""
        try:
            self._submit_or_adopt(job)
        except Exception as error:  # in a thread of its own: nobody else would hear of it
            words = f"It could not be submitted: {type(error).__name__}: {error}. "
            self._report_job_error_threadsafe(SubmittedJobInfo(job), words)

    def _submit_or_adopt(self, job: JobExecutorInterface) -> None:
        wait_for_controller(self.logger, self._ending)
        if self._ending.is_set():
            return
        entry = Entry.of(job)
        left = self._left_by_earlier_runs().pop(entry.outputs, None)
        if left is not None and left.digest == entry.digest:
            self.logger.info(f"{_computes(left)}; it is waited for.")
            aux = {"slurm_logfile": self.slurm_logdir / left.slurm_log, ENTRY: left}
            self._report_job_submission_threadsafe(SubmittedJobInfo(job, left.slurm_id, aux))
            return
        if left is not None:
            self.logger.info(f"{_computes(left)} from what has changed since; it is cancelled.")
            cancel(left.slurm_id, self.run_uuid)
            self._ledger.remove(left.slurm_id)
        self._asked[job] = entry
        super().run_job(job)
        while job in self._not_reached and not self._ending.is_set():
            self._not_reached.discard(job)
            wait_for_controller(self.logger, self._ending)
            super().run_job(job)

    def _report_job_error_threadsafe(self, job_info: SubmittedJobInfo, msg: str) -> None:
        """A submission that did not reach the controller has not failed: it is made again."""
        if NOT_REACHED in msg:
            self._not_reached.add(job_info.job)
        else:
            super()._report_job_error_threadsafe(job_info, msg)

    def _left_by_earlier_runs(self) -> dict[tuple[str, ...], Entry]:
        """Jobs in the ledger that Slurm still has, by what they write; looked up once."""
        with self._looking:
            if self._left is None:
                known = states(self.run_uuid)
                while known is None and not self._ending.is_set():
                    wait_for_controller(self.logger, self._ending)
                    known = states(self.run_uuid)
                live = {number for number, state in (known or {}).items() if state in LIVE}
                self._left = by_outputs(self._ledger.keep(live)) if known is not None else {}
            return self._left

    def report_job_submission(self, job_info: SubmittedJobInfo, register_job: bool = True) -> None:
        """Write the job into the ledger, so that a later run finds it."""
        self._last_submission = time.monotonic()
        aux = job_info.aux or {}
        if ENTRY not in aux:
            log = Path(aux["slurm_logfile"]).relative_to(self.slurm_logdir)
            entry = self._asked.pop(job_info.job, None) or Entry.of(job_info.job)
            aux[ENTRY] = entry.submitted(str(job_info.external_jobid), str(log))
            self._ledger.write(aux[ENTRY])
        super().report_job_submission(job_info, register_job)

    async def check_active_jobs(
        self, active_jobs: list[SubmittedJobInfo]
    ) -> AsyncIterator[SubmittedJobInfo]:
        """Jobs that have not ended: all of them where Slurm does not answer."""
        self._looked_at = active_jobs
        self._over.clear()
        known = states(self.run_uuid) if active_jobs else {}
        if known is not None:  # else the plugin would ask sacct, which may be down as well
            async for _ in super().check_active_jobs(active_jobs):
                pass
        for info in active_jobs:
            if id(info) not in self._over and not self._is_lost(info, known):
                yield info
        wait = self.workflow.executor_settings.init_seconds_before_status_checks
        if active_jobs and not self._over:  # else others are about to be submitted
            quiet = SHARE_BETWEEN_CHECKS * (time.monotonic() - self._last_submission)
            wait = max(wait, min(quiet, LONGEST_BETWEEN_CHECKS_S))
        self.next_seconds_between_status_checks = wait

    def _is_lost(self, info: SubmittedJobInfo, known: dict[str, str] | None) -> bool:
        """Whether Slurm will not end the job: it has not known it for long, or holds it after a
        failed launch. A controller that crashed does the latter to a job that it had no time to
        note as running, and that has ended since: so the job's logs tell how it ended."""
        number = str(info.external_jobid)
        state = None if known is None else known.get(number)
        if known is None or (state is not None and state != HELD):
            self._missing_since.pop(number, None)
            return False
        if state == HELD:
            why = f"Slurm could not launch job '{number}', and holds it; it is cancelled. "
            cancel(number, self.run_uuid)
        else:
            why = f"Slurm knows nothing of job '{number}' any more. "
            since = self._missing_since.setdefault(number, time.monotonic())
            if time.monotonic() - since < FORGOTTEN_AFTER_S:
                return False
        if all(ending.state == "finished" for ending in _endings(info)):
            self.logger.info(f"{why}By its log it had finished.")
            self.report_job_success(info)
        else:
            self.report_job_error(info, msg=why)
        return True

    def report_job_success(self, job_info: SubmittedJobInfo) -> None:
        self._end(job_info)
        super().report_job_success(job_info)

    def report_job_error(
        self, job_info: SubmittedJobInfo, msg: str | None = None, **kwargs: Any
    ) -> None:
        """Say which stage failed and why; where by a user's mistake, it is not tried again."""
        if ENTRY in (job_info.aux or {}):
            found = _endings(job_info)
            for ending in found:
                self.logger.error(ending.line(str(job_info.external_jobid)))
            if any(ending.is_mistake for ending in found):
                self._final.add(job_info.job)
        self._end(job_info)
        super().report_job_error(job_info, msg=msg, **kwargs)

    def _end(self, job_info: SubmittedJobInfo) -> None:
        self._over.add(id(job_info))
        if job_info.external_jobid is not None:
            self._ledger.remove(job_info.external_jobid)

    def cancel(self) -> None:
        """On Ctrl-C what waits for the controller gives up, and Slurm's jobs are cancelled."""
        self._ending.set()
        super().cancel()

    def cancel_jobs(self, active_jobs: list[SubmittedJobInfo]) -> None:
        """Those too that are being looked at just now, and are not among the active for so long."""
        looked_at = [info for info in self._looked_at if id(info) not in self._over]
        jobs = {info.external_jobid: info for info in [*active_jobs, *looked_at]}
        try:
            super().cancel_jobs(list(jobs.values()))
        except WorkflowError as error:
            self.logger.warning(
                f"{error}\nSlurm's jobs go on, and the next run waits for them; to end them: "
                f"scancel --name {self.run_uuid}"
            )

    def handle_job_error(self, job: JobExecutorInterface) -> None:
        """Called before Snakemake compares the job's attempts with those that it may have."""
        super().handle_job_error(job)
        if job in self._final:
            self._final.discard(job)
            self.logger.info("It is not tried again: what is wrong has to be put right first.")
            job.attempt = job.restart_times + 1


def _endings(info: SubmittedJobInfo) -> list[Ending]:
    return endings(info.job, info.aux[ENTRY], Path(info.aux["slurm_logfile"]))


def _computes(left: Entry) -> str:
    return f"Slurm job {left.slurm_id} of an earlier run computes {', '.join(left.outputs)}"
