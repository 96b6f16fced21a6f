"""What is asked of Slurm beside submitting: which jobs it has, whether it answers."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Sequence
from typing import Any

ASKED_AGAIN_AFTER_S = 5.0
CANCELLED_WITHIN_S = 120.0
ANSWERS_WITHIN_S = 60.0
HELD = "HELD"  # here: by Slurm itself, which could not launch the job, until somebody releases it
LAUNCH_FAILED = {"launch failed requeued held", "jobholdmaxrequeue"}  # reasons for that
# States of a job that has not ended.
LIVE = {
    HELD,
    *("PENDING", "CONFIGURING", "RUNNING", "SUSPENDED", "STOPPED", "SIGNALING", "RESIZING"),
    *("COMPLETING", "STAGE_OUT", "REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED", "RESV_DEL_HOLD"),
    "SPECIAL_EXIT",
}


def states(name: str) -> dict[str, str] | None:
    """State of each job called ``name`` that the controller knows, by number; ended ones too for as
    long as it keeps them (``MinJobAge``). None where it does not answer."""
    done = _run(["squeue", "--noheader", "--states=all", "--name", name, "--format=%i|%T|%r"])
    if done is None or done.returncode:
        return None
    fields = (line.strip().split("|", 2) for line in done.stdout.splitlines() if "|" in line)
    return {number: HELD if _is_held(state, reason) else state for number, state, reason in fields}


def _is_held(state: str, reason: str) -> bool:
    return state == "PENDING" and reason.lower().replace("_", " ") in LAUNCH_FAILED


def cancel(number: str, name: str) -> None:
    """Cancel a job and wait until it has ended, so that it writes nothing any more."""
    _run(["scancel", number])
    end = time.monotonic() + CANCELLED_WITHIN_S
    while time.monotonic() < end:
        known = states(name)
        if known is not None and known.get(number) not in LIVE:
            return
        time.sleep(1.0)


def wait_for_controller(logger: Any, ending: threading.Event) -> None:
    """Return when the controller answers, or when nobody waits for it any more."""
    told = False
    while not ending.is_set():
        done = _run(["scontrol", "ping"])
        if done is not None and " UP" in done.stdout:
            return
        if not told:
            logger.warning("Slurm's controller does not answer; jobs are submitted when it does.")
            told = True
        ending.wait(ASKED_AGAIN_AFTER_S)


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str] | None:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=ANSWERS_WITHIN_S)
    except subprocess.TimeoutExpired:
        return None
