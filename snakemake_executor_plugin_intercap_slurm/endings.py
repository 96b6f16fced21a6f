"""How the stages of a failed job ended, according to their logs."""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from intercap_core.pipeline.job import ENDED, UNEXPECTED, read_state

from .ledger import JobEntry, members, stamp

# Reasons in Slurm's log of a job that Slurm itself ended.
REASONS = re.compile(
    r"(exceeded \w*\s*memory limit|oom.?kill|DUE TO [A-Z ]+[A-Z]|CANCELLED)", re.IGNORECASE
)


@dataclass(frozen=True)
class Ending:
    """End of one stage of a job."""

    name: str
    """Sequence and stage."""
    state: str
    """"finished", "failed", "running" (ended without a log entry) or "waiting" (did not begin)."""
    words: str
    """Reason; for a finished stage, why its job failed afterwards, if it did."""

    @property
    def is_mistake(self) -> bool:
        """Whether the stage reported a fault of its input, which a retry would meet again."""
        return self.state == "failed" and not self.words.startswith(UNEXPECTED)

    def line(self, slurm_id: str) -> str:
        """Line for the log of the run."""
        lines = {
            "finished": f"finished; its job then ended: {self.words}" if self.words else "finished",
            "failed": f"failed: {self.words}",
            "running": f"ended without a log entry: {self.words}",
            "waiting": f"did not begin: {self.words}",
        }
        return f"Slurm job {slurm_id}, {self.name}: {lines[self.state]}"


def endings(job: Any, entry: JobEntry, slurm_log: Path) -> list[Ending]:
    """End of each stage of a failed job, in their order.

    Of the stages that share a process, none is listed after the first that did not finish.
    """
    found: list[Ending] = []
    for part in members(job):
        for log in (Path(str(path)) for path in part.log):
            found.append(_ending(": ".join([*part.wildcards, log.stem]), log, entry, slurm_log))
            if found[-1].state != "finished":
                break
    if all(ending.state == "finished" for ending in found):
        found[-1] = replace(found[-1], words=_slurms_reason(slurm_log))
    return found


def _ending(name: str, log: Path, entry: JobEntry, slurm_log: Path) -> Ending:
    now = stamp(log)  # unchanged since the submission: the stage did not begin
    if now is None or now == entry.logs.get(str(log)):
        return Ending(name, "waiting", _slurms_reason(slurm_log))
    state, words = read_state(log)
    if state == "finished":
        words = ""
    elif not words:
        words = _slurms_reason(slurm_log)
    elif words.startswith(ENDED):
        words += f"; {_slurms_reason(slurm_log)}"
    return Ending(name, state, words)


def _slurms_reason(slurm_log: Path) -> str:
    """Reason in Slurm's log for the end of a job; otherwise a list of likely reasons."""
    with contextlib.suppress(OSError):
        reasons = REASONS.findall(slurm_log.read_text(encoding="utf-8", errors="replace"))
        if reasons:
            return reasons[0]
    return "killed for its memory or time, cancelled, or its node went down"
