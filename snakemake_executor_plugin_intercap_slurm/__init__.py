"""Slurm executor for datasets of hundreds of sequences.

The executor ``intercap-slurm`` extends ``snakemake-executor-plugin-slurm``, which submits, polls
and cancels jobs. It has the same settings under its own prefix. In addition:

- A job that failed by a user's mistake is not submitted again; a job that was killed is.
- Jobs that a killed Snakemake has left in Slurm are adopted instead of submitted twice; if their
  inputs or parameters have changed since, they are cancelled.
- If the controller does not answer, submissions wait for it.
- A job starts Snakemake once on its node instead of twice.
- A job that Slurm has lost, or holds after a failed launch, is reported as failed.
- Ctrl-C cancels all jobs, and warns if the controller does not answer.
- The reason of a failure is reported by stage, also for grouped jobs.
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

from .endings import Ending, endings
from .ledger import JobEntry, Ledger, by_outputs, run_name
from .slurm import HELD, LIVE, cancel, states, wait_for_controller

MAX_POLL_INTERVAL_S = 20.0
POLL_INTERVAL_SHARE = 0.25  # of the time since the last submission, so that short jobs end early
LOST_AFTER_S = 120.0  # longer than a controller takes to restart and read its state
NOT_REACHED = "Unable to contact slurm controller (connect failure)"  # nothing was submitted
ENTRY = "intercap_entry"


@dataclass
class ExecutorSettings(SlurmSettings):
    """The Slurm plugin's own settings."""


class Executor(SlurmExecutor):
    """Slurm executor; see the module's docstring."""

    def __init__(self, workflow: Any, logger: Any) -> None:
        # Set before the base class starts to poll jobs.
        self._ledger = Ledger(Path(".snakemake") / "slurm_jobs")
        # Jobs of earlier runs by their outputs; None = not queried yet.
        self._left: dict[tuple[str, ...], JobEntry] | None = None
        self._adoption_lock = threading.Lock()
        self._ending = threading.Event()  # set when Ctrl-C ends the run
        self._entries: dict[JobExecutorInterface, JobEntry] = {}  # of jobs being submitted
        # Jobs whose submission did not reach the controller.
        self._not_reached: set[JobExecutorInterface] = set()
        self._polled: list[SubmittedJobInfo] = []  # jobs of the last poll
        self._over: set[int] = set()  # ``id`` of the jobs whose end was reported since that poll
        self._final: set[JobExecutorInterface] = set()  # jobs that are not submitted again
        # Monotonic time at which Slurm first did not know a job, by job number.
        self._missing_since: dict[str, float] = {}
        self._last_submission = time.monotonic()
        super().__init__(workflow, logger)

    def __post_init__(self, test_mode: bool = False) -> None:
        super().__post_init__(test_mode)
        # All runs of a folder use one name, by which the states of their jobs are queried.
        self.run_uuid = run_name(self.workflow.executor_settings.jobname_prefix)
        self.logger.info(f"Slurm's name for this folder's jobs: {self.run_uuid}")

    def additional_general_args(self) -> str:
        """Run the job in the submission itself; a Slurm step would start Snakemake twice."""
        return "--executor local"

    def get_account_arg(self, job: JobExecutorInterface) -> Iterator[str]:
        """Without a named account, use Slurm's default of the user instead of guessing one."""
        return super().get_account_arg(job) if job.resources.get("slurm_account") else iter([""])

    def run_job(self, job: JobExecutorInterface) -> None:
        """Submit a job, or wait for the same job of an earlier run."""
        try:
            self._submit_or_adopt(job)
        except Exception as error:  # this thread's exceptions would be lost
            words = f"It could not be submitted: {type(error).__name__}: {error}. "
            self._report_job_error_threadsafe(SubmittedJobInfo(job), words)

    def _submit_or_adopt(self, job: JobExecutorInterface) -> None:
        """Wait for the controller, then adopt the same job of an earlier run, or submit the job."""
        wait_for_controller(self.logger, self._ending)
        if self._ending.is_set():
            return
        entry = JobEntry.of(job)
        left = self._jobs_of_earlier_runs().pop(entry.outputs, None)
        if left is not None and left.digest == entry.digest:
            self.logger.info(f"{_computes(left)}; waiting for it.")
            aux = {"slurm_logfile": self.slurm_logdir / left.slurm_log, ENTRY: left}
            self._report_job_submission_threadsafe(SubmittedJobInfo(job, left.slurm_id, aux))
            return
        if left is not None:
            self.logger.info(f"{_computes(left)} from outdated inputs; it is cancelled.")
            cancel(left.slurm_id, self.run_uuid)
            self._ledger.remove(left.slurm_id)
        self._entries[job] = entry
        super().run_job(job)
        while job in self._not_reached and not self._ending.is_set():
            self._not_reached.discard(job)
            wait_for_controller(self.logger, self._ending)
            super().run_job(job)

    def _report_job_error_threadsafe(self, job_info: SubmittedJobInfo, msg: str) -> None:
        """Report an error, except for a submission that did not reach the controller."""
        if NOT_REACHED in msg:
            self._not_reached.add(job_info.job)
        else:
            super()._report_job_error_threadsafe(job_info, msg)

    def _jobs_of_earlier_runs(self) -> dict[tuple[str, ...], JobEntry]:
        """Jobs of the ledger that Slurm still has, by their outputs; queried once."""
        with self._adoption_lock:
            if self._left is None:
                known = states(self.run_uuid)
                while known is None and not self._ending.is_set():
                    wait_for_controller(self.logger, self._ending)
                    known = states(self.run_uuid)
                live = {number for number, state in (known or {}).items() if state in LIVE}
                self._left = by_outputs(self._ledger.keep(live)) if known is not None else {}
            return self._left

    def report_job_submission(self, job_info: SubmittedJobInfo, register_job: bool = True) -> None:
        """Write the job to the ledger, so that a later run can adopt it."""
        self._last_submission = time.monotonic()
        aux = job_info.aux or {}
        if ENTRY not in aux:
            log = Path(aux["slurm_logfile"]).relative_to(self.slurm_logdir)
            entry = self._entries.pop(job_info.job, None) or JobEntry.of(job_info.job)
            aux[ENTRY] = entry.submitted(str(job_info.external_jobid), str(log))
            self._ledger.write(aux[ENTRY])
        super().report_job_submission(job_info, register_job)

    async def check_active_jobs(
        self, active_jobs: list[SubmittedJobInfo]
    ) -> AsyncIterator[SubmittedJobInfo]:
        """Yield the jobs that have not ended; all of them if Slurm does not answer."""
        self._polled = active_jobs
        self._over.clear()
        known = states(self.run_uuid) if active_jobs else {}
        if known is not None:  # otherwise the base class would query sacct, which may be down too
            async for _ in super().check_active_jobs(active_jobs):
                pass
        for info in active_jobs:
            if id(info) not in self._over and not self._is_lost(info, known):
                yield info
        wait = self.workflow.executor_settings.init_seconds_before_status_checks
        if active_jobs and not self._over:  # otherwise new jobs are about to be submitted
            quiet = POLL_INTERVAL_SHARE * (time.monotonic() - self._last_submission)
            wait = max(wait, min(quiet, MAX_POLL_INTERVAL_S))
        self.next_seconds_between_status_checks = wait

    def _is_lost(self, info: SubmittedJobInfo, known: dict[str, str] | None) -> bool:
        """Whether Slurm has lost the job or holds it after a failed launch; reports its end if so.

        A controller that crashed may hold a job that has run to its end, so the job's logs decide
        whether it succeeded.
        """
        number = str(info.external_jobid)
        state = None if known is None else known.get(number)
        if known is None or (state is not None and state != HELD):
            self._missing_since.pop(number, None)
            return False
        if state == HELD:
            why = f"Slurm could not launch job '{number}' and holds it; it is cancelled. "
            cancel(number, self.run_uuid)
        else:
            why = f"Slurm no longer knows job '{number}'. "
            since = self._missing_since.setdefault(number, time.monotonic())
            if time.monotonic() - since < LOST_AFTER_S:
                return False
        if all(ending.state == "finished" for ending in _endings(info)):
            self.logger.info(f"{why}According to its log it has finished.")
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
        """Log which stage failed and why; a failure by a user's mistake is final."""
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
        """Cancel all jobs after Ctrl-C and stop waiting for the controller."""
        self._ending.set()
        super().cancel()

    def cancel_jobs(self, active_jobs: list[SubmittedJobInfo]) -> None:
        """Cancel the active jobs and those that are being polled, which are not in that list."""
        polled = [info for info in self._polled if id(info) not in self._over]
        jobs = {info.external_jobid: info for info in [*active_jobs, *polled]}
        try:
            super().cancel_jobs(list(jobs.values()))
        except WorkflowError as error:
            self.logger.warning(
                f"{error}\nSlurm's jobs go on, and the next run waits for them; to end them: "
                f"scancel --name {self.run_uuid}"
            )

    def handle_job_error(self, job: JobExecutorInterface) -> None:
        """Use up the attempts of a job whose failure is final."""
        super().handle_job_error(job)
        if job in self._final:
            self._final.discard(job)
            self.logger.info("It is not submitted again: correct the input first.")
            job.attempt = job.restart_times + 1


def _endings(info: SubmittedJobInfo) -> list[Ending]:
    return endings(info.job, info.aux[ENTRY], Path(info.aux["slurm_logfile"]))


def _computes(left: JobEntry) -> str:
    return f"Slurm job {left.slurm_id} of an earlier run computes {', '.join(left.outputs)}"
