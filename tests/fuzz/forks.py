"""One case in a child of this process: everything is imported already, nothing it does lasts."""

from __future__ import annotations

import contextlib
import os
import re
import resource
import select
import shutil
import signal
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random

from intercap_core.errors import UserError
from tests.fuzz.kind import ImplausibleError, Kind
from tests.fuzz.mutations import damage

SECONDS = 20.0  # of one case; the slowest good file takes two
MEMORY_BYTES = 1 << 30  # beyond what the process has: several times what any good file takes
ADDRESSES_BYTES = 8 << 30
LONGEST_MESSAGE = 1500  # characters
_CATCH_ALL = re.compile(r"unexpected (error|\w+Error)|\(\);|Traceback|object at 0x")


@dataclass(frozen=True)
class Outcome:
    """How a case ended: ok, refused, or unexplained, with what was said; ``damage`` in words."""

    case: str
    verdict: str
    told: str
    damage: str = ""
    seconds: float = 0.0


@contextlib.contextmanager
def good_files(kind: Kind) -> Iterator[Path]:
    """A folder with the kind's good files."""
    folder = Path(tempfile.mkdtemp(prefix=f"fuzz-{kind.name}-"))
    try:
        (folder / "files").mkdir()
        kind.make(folder / "files")
        yield folder / "files"
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def run_case(kind: Kind, number: int, seed: int, good: Path) -> Outcome:
    """Damage a copy of the good files as ``number`` says and read it; number -1 = undamaged."""
    case = f"{kind.name}:{number}"
    work = Path(tempfile.mkdtemp(prefix="fuzz-case-"))
    files = work / "files"
    told = ""
    started = time.monotonic()
    try:
        shutil.copytree(good, files)
        names = list(kind.named)
        if number >= 0:
            chance = Random(f"{seed}:{case}")
            target = files / chance.choice(list(kind.damaged))
            names += [target.name, f"{target.parent.name}/"]
            told = damage(target, kind.form, chance)
        else:
            names += kind.damaged
        verdict, words = _in_child(kind, files, names)
        return Outcome(case, verdict, words, told, time.monotonic() - started)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _in_child(kind: Kind, files: Path, names: list[str]) -> tuple[str, str]:
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        try:
            verdict = "\n".join(_verdict(kind, files, names))
        except BaseException as error:
            verdict = f"unexplained\n{error!r}"
        with contextlib.suppress(OSError):
            os.write(writing, verdict.encode("utf-8", "replace")[:60_000])
        os._exit(0)
    os.close(writing)
    try:
        ready, _, _ = select.select([reading], [], [], SECONDS)
        if not ready:
            os.kill(child, signal.SIGKILL)
            return "unexplained", f"took longer than {SECONDS:.0f} s"
        said = b""
        while part := os.read(reading, 65_536):
            said += part
    finally:
        os.close(reading)
        _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        return "unexplained", f"ended by signal {os.WTERMSIG(status)}"
    verdict, _, words = said.decode("utf-8", "replace").partition("\n")
    return (verdict or "unexplained"), words or "ended without a word"


def _verdict(kind: Kind, files: Path, names: list[str]) -> tuple[str, str]:
    os.chdir(files)
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    has = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (has + ADDRESSES_BYTES,) * 2)
    before = _peak()
    try:
        notes = kind.read(files) or ()
        verdict, told = ("refused", "; ".join(notes)) if notes else ("ok", "")
    except UserError as error:
        verdict, told = "refused", str(error)
    except ImplausibleError as error:
        return "unexplained", f"accepted, though {error}"
    except BaseException as error:
        return "unexplained", f"{error!r:.300} {_place(error)}"
    taken = _peak() - before
    if taken > MEMORY_BYTES:
        return "unexplained", f"{verdict}, but took {taken / 1e6:.0f} MB: {told[:200]}"
    fault = _fault(told, names) if verdict == "refused" else None
    return (verdict, told) if fault is None else ("unexplained", f"{fault}: {told[:400]}")


def _peak() -> int:
    """Bytes of memory that this process has had at most, since it was forked."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024


def _fault(told: str, names: list[str]) -> str | None:
    """What a refusal lacks."""
    if not any(name in told for name in names):
        return "names none of the files"
    if len(told) > LONGEST_MESSAGE:
        return f"has {len(told)} characters"
    if "\n" in told:
        return "has several lines"
    if any(0xD800 <= ord(letter) <= 0xDFFF for letter in told):
        return "is no text"
    found = _CATCH_ALL.search(told)
    return None if found is None else f"says {found.group()!r}"


def _place(error: BaseException) -> str:
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "intercap_core" in f.filename]
    return " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(frames[-3:]))
