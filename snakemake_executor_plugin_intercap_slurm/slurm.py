"""Queries to Slurm: states of jobs, cancelling, whether the controller answers."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Sequence
from typing import Any

PING_INTERVAL_S = 5.0
CANCEL_TIMEOUT_S = 120.0
COMMAND_TIMEOUT_S = 60.0
HELD = "HELD"  # our name for a job that Slurm holds because it could not launch it
LAUNCH_FAILED = {"launch failed requeued held", "jobholdmaxrequeue"}  # squeue's reasons for it
# States of a job that has not ended.
LIVE = {
    HELD,
    *("PENDING", "CONFIGURING", "RUNNING", "SUSPENDED", "STOPPED", "SIGNALING", "RESIZING"),
    *("COMPLETING", "STAGE_OUT", "REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED", "RESV_DEL_HOLD"),
    "SPECIAL_EXIT",
}


def states(name: str) -> dict[str, str] | None:
    """States of the jobs named ``name``, by job number; None if the controller does not answer.

    Includes ended jobs as long as the controller keeps them (``MinJobAge``).
    """
    done = _run(["squeue", "--noheader", "--states=all", "--name", name, "--format=%i|%T|%r"])
    if done is None or done.returncode:
        return None
    fields = (line.strip().split("|", 2) for line in done.stdout.splitlines() if "|" in line)
    return {number: HELD if _is_held(state, reason) else state for number, state, reason in fields}


def _is_held(state: str, reason: str) -> bool:
    return state == "PENDING" and reason.lower().replace("_", " ") in LAUNCH_FAILED


def cancel(number: str, name: str) -> None:
    """Cancel a job and wait until it has ended and writes no more files."""
    _run(["scancel", number])
    end = time.monotonic() + CANCEL_TIMEOUT_S
    while time.monotonic() < end:
        known = states(name)
        if known is not None and known.get(number) not in LIVE:
            return
        time.sleep(1.0)


def wait_for_controller(logger: Any, ending: threading.Event) -> None:
    """Return when the controller answers or ``ending`` is set."""
    warned = False
    while not ending.is_set():
        done = _run(["scontrol", "ping"])
        if done is not None and " UP" in done.stdout:
            return
        if not warned:
            logger.warning("Slurm's controller does not answer; jobs are submitted when it does.")
            warned = True
        ending.wait(PING_INTERVAL_S)


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str] | None:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=COMMAND_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return None
