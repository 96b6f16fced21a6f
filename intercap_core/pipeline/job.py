"""One job of the workflow: its threads, its log, and the report of its errors.

Imports no numerical library, so that the numbers of threads are set before any library reads them.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from intercap_core import disk
from intercap_core.errors import UserError
from intercap_core.geometry.solve.thread_pool import VARIABLE
from intercap_core.signals import Terminated, raise_on_signals

# Environment variables that limit the threads of the numerical libraries
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)
# Beginning of the last line of a log, and of its warnings. `intercap run` reads them.
FINISHED = "finished in"
FAILED = "failed:"
WARNED = "warning:"
UNEXPECTED = "unexpected"  # begins the reason of a failure that the input did not cause
ENDED = f"{UNEXPECTED} end"  # begins the reason of a job that a signal ended


def set_threads(threads: int) -> None:
    """Let a job use ``threads`` threads, of which the numerical libraries use one.

    Results then do not depend on the number. Call it before the libraries are imported.
    """
    os.environ[VARIABLE] = str(threads)
    for variable in THREAD_VARIABLES:
        os.environ[variable] = "1"


@contextmanager
def job(name: str, log: Path, *, threads: int = 1) -> Iterator[None]:
    """Run the block as one job that writes to ``log``.

    A fault of the input or the disk is reported in one line, in the log and on standard error. The
    log of any other error has its traceback. Both end the process with status 1; a signal ends it
    with the status that shells use.
    """
    set_threads(threads)
    # imports create many objects and no garbage: Python's default of 700 costs 0.4 s a job
    gc.set_threshold(50_000)
    log = Path(log)
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        handler = logging.FileHandler(log, mode="w", encoding="utf-8")
    except OSError as error:
        _print_error(f"{name} failed: {disk.describe_fault(error, log)}")
        raise SystemExit(1) from None
    handler.setFormatter(_LogFormatter("%(asctime)s %(message)s", datefmt="%H:%M:%S"))
    logger = logging.getLogger("intercap_core")
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    start = time.monotonic()
    logger.info("started, threads: %d", threads)
    try:
        with raise_on_signals():
            yield
        logger.info("%s %.1f s", FINISHED, time.monotonic() - start)
    except UserError as error:
        logger.error("%s %s", FAILED, error.shortened())
        _print_error(f"{name} failed: {error.shortened()}")
        raise SystemExit(1) from None
    except Terminated as end:
        logger.error("%s %s, %s", FAILED, ENDED, end)
        _print_error(f"{name} failed: {ENDED}, {end}; what was half-written is removed, run again")
        raise SystemExit(end.status) from None
    except Exception as error:
        logger.exception("unexpected error")
        text = f"{UNEXPECTED} {type(error).__name__}: {str(error).strip() or 'no message'}"
        logger.error("%s %s", FAILED, text.splitlines()[0])
        _print_error(f"{name} failed: {text}; the traceback is in {log}")
        raise SystemExit(1) from None
    finally:
        logger.removeHandler(handler)
        handler.close()


@contextmanager
def benchmark(path: Path, *, since_start: bool = False) -> Iterator[None]:
    """Measure the block and write a benchmark file with columns of Snakemake's: seconds ``s``,
    CPU seconds ``cpu_time``, peak memory ``max_rss`` in MB ("NA" except on Linux).

    Snakemake itself measures jobs. This function measures the stages of a job separately.

    Args:
        since_start: count the CPU time from the start of the process, and as much wall time.
    """
    _reset_peak()
    start, cpu_start = time.monotonic(), 0.0 if since_start else time.process_time()
    if since_start:
        start -= time.process_time()
    yield
    values = {
        "s": f"{time.monotonic() - start:.4f}",
        "max_rss": _peak_mb(),
        "cpu_time": f"{time.process_time() - cpu_start:.2f}",
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\t".join(values) + "\n" + "\t".join(values.values()) + "\n", encoding="utf-8")


def _reset_peak() -> None:
    """Reset the peak of this process's memory to its present size, where Linux can."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_mb() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return f"{int(line.split()[1]) / 1024:.2f}"
    return "NA"


class _LogFormatter(logging.Formatter):
    """Marks warnings, so that :func:`warnings_of` finds them."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        if record.levelno == logging.WARNING:
            record.message = f"{WARNED} {record.message}"
        return super().formatMessage(record)


def warnings_of(log: Path) -> list[str]:
    """The distinct warnings in a job's log, in order; [] if there is no log."""
    if not log.is_file():
        return []
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    messages = (line.partition(" ")[2] for line in lines)  # without the time of day
    warned = (text.removeprefix(WARNED).strip() for text in messages if text.startswith(WARNED))
    return list(dict.fromkeys(warned))


def last_words(log: Path) -> str:
    """The last line of a log without its time of day; "" for an empty log."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return lines[-1].partition(" ")[2] if lines else ""


def _print_error(line: str) -> None:
    """Write a line to standard error.

    Snakemake writes a message and its newline separately. The line therefore begins with a newline,
    so that it never continues a message of Snakemake.
    """
    sys.stderr.write(f"\n{line}\n")
    sys.stderr.flush()


def last_failure(folder: Path) -> str | None:
    """Reason of the newest failed job that logged into ``folder``; None if no job failed.

    A log without an end, as a killed job leaves it, counts as a failure.
    """
    logs = sorted(folder.glob("*.log"), key=lambda path: path.stat().st_mtime_ns, reverse=True)
    states = [read_state(log) for log in logs]
    failed = [words for state, words in states if state == "failed"]
    if failed:
        return failed[0]
    return "ended without a log entry" if any(state == "running" for state, _ in states) else None


def read_state(log: Path) -> tuple[str, str]:
    """State of the job that writes ``log`` ("running", "finished" or "failed"), and its duration
    or the reason."""
    last = last_words(log)
    for state, mark in (("finished", FINISHED), ("failed", FAILED)):
        if last.startswith(mark):
            return state, last.removeprefix(mark).strip()
    return "running", ""
