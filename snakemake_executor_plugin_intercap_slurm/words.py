"""How the stages of a failed job ended, by their logs."""

from __future__ import annotations

import contextlib
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from intercap_core.pipeline.job import ENDED, UNEXPECTED, read_state

from .ledger import Entry, members, stamp

# What Slurm's own log of a job says of an end that the job had no word in.
REASONS = re.compile(
    r"(exceeded \w*\s*memory limit|oom.?kill|DUE TO [A-Z ]+[A-Z]|CANCELLED)", re.IGNORECASE
)


@dataclass(frozen=True)
class Ending:
    """One stage: ``state`` is "finished", "failed", "running" (it has ended without a log entry) or
    "waiting" (it has not begun). ``words`` say why; of a finished one, why its job failed after it.
    """

    name: str
    state: str
    words: str

    @property
    def is_mistake(self) -> bool:
        """Whether it was told in a sentence what is wrong with the input: that stays wrong."""
        return self.state == "failed" and not self.words.startswith(UNEXPECTED)

    def line(self, slurm_id: str) -> str:
        said = {
            "finished": f"finished; its job then ended: {self.words}" if self.words else "finished",
            "failed": f"failed: {self.words}",
            "running": f"ended without a log entry: {self.words}",
            "waiting": f"did not begin: {self.words}",
        }
        return f"Slurm job {slurm_id}, {self.name}: {said[self.state]}"


def endings(job: Any, entry: Entry, slurm_log: Path) -> list[Ending]:
    """One for each stage of a job that failed, in their order."""
    found = []
    for part in members(job):
        log = Path(str(next(iter(part.log))))
        name = ": ".join([*part.wildcards, part.rule.name])
        now = stamp(log)
        if now is None or now == entry.logs.get(str(log)):
            found.append(Ending(name, "waiting", _slurms_reason(slurm_log)))
        else:
            state, words = read_state(log)
            if state == "finished":
                words = ""
            elif not words:
                words = _slurms_reason(slurm_log)
            elif words.startswith(ENDED):
                words += f"; {_slurms_reason(slurm_log)}"
            found.append(Ending(name, state, words))
    if all(ending.state == "finished" for ending in found):
        found[-1] = replace(found[-1], words=_slurms_reason(slurm_log))
    return found


def _slurms_reason(slurm_log: Path) -> str:
    """Why Slurm ended a job, in its own words; otherwise what may have been."""
    with contextlib.suppress(OSError):
        said = REASONS.findall(slurm_log.read_text(encoding="utf-8", errors="replace"))
        if said:
            return said[0]
    return "killed for its memory or time, cancelled, or its node went down"
