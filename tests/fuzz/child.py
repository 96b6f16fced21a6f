"""Reads damaged files in a child of this process, within limits of time and memory.

Everything is imported already, and nothing that the child does lasts.
"""

from __future__ import annotations

import contextlib
import os
import re
import resource
import select
import shutil
import signal
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from intercap_core.errors import UserError
from tests.fuzz.damage import write
from tests.fuzz.plausible import ImplausibleError, Kind, Notes, check_plausible

SECONDS = 20.0  # of one case; the slowest good file takes two
MEMORY_BYTES = 1 << 30  # beyond what the process has: several times what any good file takes
ADDRESSES_BYTES = 8 << 30
LONGEST_MESSAGE = 1500  # characters
_CATCH_ALL = re.compile(r"unexpected (error|\w+Error)|\(\);|Traceback|object at 0x")


class Verdict(NamedTuple):
    """How a case ended: ``ok``, ``refused`` or ``unexplained``, and the words."""

    result: str
    words: str = ""


@contextlib.contextmanager
def good_files(kind: Kind) -> Iterator[Path]:
    """A folder with the kind's good files, which have been read once in this process.

    This compiles kernels and loads libraries before the first fork.
    """
    with tempfile.TemporaryDirectory(prefix=f"fuzz-{kind.name}-") as folder:
        files = Path(folder) / "files"
        files.mkdir()
        kind.make(files)
        notes = check_plausible(kind.read(files))
        assert not notes, f"{kind.name}: good files are refused in part: {notes}"
        yield files


def read_damaged(kind: Kind, good: Path, name: str, content: bytes | str) -> Verdict:
    """Read a copy of the good files in which the file ``name`` has other content."""
    with tempfile.TemporaryDirectory(prefix="fuzz-case-") as folder:
        files = Path(folder) / "files"
        shutil.copytree(good, files)
        write(files / name, content)
        names = [*kind.named, Path(name).name, f"{(files / name).parent.name}/"]
        return _in_child(kind, files, names)


def _in_child(kind: Kind, files: Path, names: list[str]) -> Verdict:
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            verdict = "\n".join(_verdict(kind, files, names))
        except BaseException as error:
            verdict = f"unexplained\n{error!r}"
        with contextlib.suppress(OSError):
            os.write(writing, verdict.encode("utf-8", "replace")[:60_000])
        os._exit(0)
    os.close(writing)
    try:
        if not select.select([reading], [], [], SECONDS)[0]:
            os.kill(child, signal.SIGKILL)
            return Verdict("unexplained", f"took longer than {SECONDS:.0f} s")
        answer = os.read(reading, 65_536).decode("utf-8", "replace")
    finally:
        os.close(reading)
        _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        return Verdict("unexplained", f"ended by signal {os.WTERMSIG(status)}")
    result, _, words = answer.partition("\n")
    return Verdict(result or "unexplained", words)


def _verdict(kind: Kind, files: Path, names: list[str]) -> Verdict:
    os.chdir(files)
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + ADDRESSES_BYTES,) * 2)
    before = _peak_bytes()
    notes = Notes()
    try:
        notes = check_plausible(kind.read(files))
    except UserError as error:
        notes.append(str(error))
    except ImplausibleError as error:
        return Verdict("unexplained", f"accepted, though {error}")
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        places = [f"{Path(f.filename).name}:{f.lineno}" for f in frames if "intercap_core" in f[0]]
        return Verdict("unexplained", f"{error!r:.300} {' > '.join(places[-3:])}")
    words, used = "; ".join(notes), _peak_bytes() - before
    if used > MEMORY_BYTES:
        return Verdict("unexplained", f"took {used / 1e6:.0f} MB: {words[:200]}")
    fault = _message_fault(words, names) if notes else None
    if fault is not None:
        return Verdict("unexplained", f"{fault}: {words[:400]}")
    return Verdict("refused", words) if notes else Verdict("ok")


def _peak_bytes() -> int:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024


def _message_fault(words: str, names: list[str]) -> str | None:
    if not any(name in words for name in names):
        return "the refusal names none of the files"
    if len(words) > LONGEST_MESSAGE:
        return f"the refusal has {len(words)} characters"
    if "\n" in words or any(0xD800 <= ord(letter) <= 0xDFFF for letter in words):
        return "the refusal has several lines or is no text"
    match = _CATCH_ALL.search(words)
    return None if match is None else f"the refusal says {match.group()!r}"
