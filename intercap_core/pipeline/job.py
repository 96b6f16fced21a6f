"""One job of the workflow: its threads, its log, and how its faults are told.

Imports nothing heavy, so that the thread counts are set before any library reads them.
"""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from intercap_core import disk
from intercap_core.errors import UserError
from intercap_core.signals import ToldToEnd, told_to_end

THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)
# Last line of a job's log; `intercap run` shows these.
FINISHED = "finished in"
FAILED = "failed:"
WARNED = "warning:"
UNEXPECTED = "unexpected"  # what a failure begins with that is no fault of the input
ENDED = f"{UNEXPECTED} end"  # from outside


def set_threads(threads: int) -> None:
    """Let the numerical libraries use ``threads`` threads; only before they are imported."""
    for variable in THREAD_VARIABLES:
        os.environ[variable] = str(threads)


@contextmanager
def job(name: str, log: Path, *, threads: int = 1) -> Iterator[None]:
    """Run the block as one job that writes to ``log``.

    A fault of the input or of the disk is told in one line, in the log and on standard error; any
    other error leaves its traceback in the log. Both end the process with status 1, as does a log
    that cannot be written. A process that is told to end says so too.
    """
    set_threads(threads)
    log = Path(log)
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        handler = logging.FileHandler(log, mode="w", encoding="utf-8")
    except OSError as error:
        _tell(f"{name} failed: {disk.told(error, log)}")
        raise SystemExit(1) from None
    handler.setFormatter(_Marked("%(asctime)s %(message)s", datefmt="%H:%M:%S"))
    logger = logging.getLogger("intercap_core")
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    start = time.monotonic()
    logger.info("%s started with %d thread(s)", name, threads)
    try:
        with told_to_end():
            yield
        logger.info("%s %.1f s", FINISHED, time.monotonic() - start)
    except UserError as error:
        logger.error("%s %s", FAILED, error)
        _tell(f"{name} failed: {error}")
        raise SystemExit(1) from None
    except ToldToEnd as end:
        logger.error("%s %s, %s", FAILED, ENDED, end)
        _tell(f"{name} failed: {ENDED}, {end}; what was half-written is removed, run again")
        raise SystemExit(end.status) from None
    except Exception as error:
        logger.exception("unexpected error")
        told = f"{UNEXPECTED} {type(error).__name__}: {str(error).strip() or 'no message'}"
        logger.error("%s %s", FAILED, told.splitlines()[0])
        _tell(f"{name} failed: {told}; the traceback is in {log}")
        raise SystemExit(1) from None
    finally:
        logger.removeHandler(handler)
        handler.close()


class _Marked(logging.Formatter):
    """Warnings say that they are: :func:`warnings_of` finds them again."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        if record.levelno == logging.WARNING:
            record.message = f"{WARNED} {record.message}"
        return super().formatMessage(record)


def warnings_of(log: Path) -> list[str]:
    """The warnings in a job's log, each once, in their order; none where there is no log."""
    if not log.is_file():
        return []
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    said = (line.partition(" ")[2] for line in lines)
    warned = (text.removeprefix(WARNED).strip() for text in said if text.startswith(WARNED))
    return list(dict.fromkeys(warned))


def last_words(log: Path) -> str:
    """The last line of a log without its time of day; empty where there is none."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return lines[-1].partition(" ")[2] if lines else ""


def _tell(line: str) -> None:
    """Write to standard error, on a line of its own.

    Snakemake and other jobs write there too, and Snakemake ends its messages by a second write:
    one write that begins with a newline is never glued to such a message.
    """
    sys.stderr.write(f"\n{line}\n")
    sys.stderr.flush()


def last_failure(folder: Path) -> str | None:
    """Why a job that logged into ``folder`` failed, the newest first; None where none did.

    A job that ended without a word, as one that was killed, has failed as well.
    """
    logs = sorted(folder.glob("*.log"), key=lambda path: path.stat().st_mtime_ns, reverse=True)
    states = [read_state(log) for log in logs]
    failed = [words for state, words in states if state == "failed"]
    if failed:
        return failed[0]
    return "ended without a word" if any(state == "running" for state, _ in states) else None


def read_state(log: Path) -> tuple[str, str]:
    """Whether the job that wrote ``log`` runs, finished or failed; and how long, or why."""
    last = last_words(log)
    for state, mark in (("finished", FINISHED), ("failed", FAILED)):
        if last.startswith(mark):
            return state, last.removeprefix(mark).strip()
    return "running", ""
