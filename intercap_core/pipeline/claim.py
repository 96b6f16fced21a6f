"""Who makes an output just now: one job at a time, found again by others, on whatever machine.

A claim is a file beside the output that its owner touches every few seconds. Who finds one waits as
long as its owner lives, and takes it over from a dead one; an owner that has lost its claim
meanwhile does not write. So a job that outlived the run that started it is waited for instead of
being started twice, and never replaces a newer result.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import socket
import threading
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from intercap_core import disk
from intercap_core.errors import UserError

log = logging.getLogger(__name__)

BEAT_S = 5.0
DEAD_S = 60.0  # without a sign, on another machine: files may arrive there late
UNSEEN = 0  # start of a process that lives, but is not shown
_LOOK_S = 1.0


@dataclass(frozen=True)
class Owner:
    """Who holds a claim: host, which of its processes can be seen from where (a machine's start,
    and a container), process and its start in clock ticks, the scheduler's job, when it began."""

    host: str
    place: str
    pid: int
    started: int
    job: str
    since: str
    token: str

    @classmethod
    def this(cls) -> Owner:
        """This process, with a token of its own."""
        pid = os.getpid()
        return cls(
            socket.gethostname(),
            _place(),
            pid,
            _start_of(pid) or UNSEEN,
            os.environ.get("SLURM_JOB_ID", ""),
            time.strftime("%Y-%m-%d %H:%M:%S"),
            uuid.uuid4().hex,
        )

    def __str__(self) -> str:
        job = f", job {self.job}" if self.job else ""
        return f"process {self.pid} on {self.host}{job}, since {self.since}"

    def is_near(self) -> bool:
        """Whether its process could be seen from here."""
        return (self.host, self.place) == (socket.gethostname(), _place())

    def lives(self, path: Path) -> bool:
        """Whether the owner of the claim ``path`` still runs: by its process where that can be
        seen, else by its signs."""
        if self.is_near():
            started = _start_of(self.pid)
            if started != UNSEEN:
                return started == self.started
        age = _age_s(path)
        return age is None or abs(age) < DEAD_S  # of whom nothing can be told, he lives


class Claim:
    """A claim that is held; made by :func:`claim` and :func:`try_claim`. ``left_by``: who held it
    until death."""

    def __init__(self, path: Path, owner: Owner, left_by: Owner | None = None) -> None:
        self._path, self._owner, self.left_by = path, owner, left_by
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True)
        self._thread.start()

    def still_held(self) -> bool:
        """False where another one has taken it over, or it is gone; one that cannot be read at the
        moment is held."""
        try:
            text = self._path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return False
        except OSError:
            return True
        return self._owner.token in text

    def release(self) -> None:
        """Give it up; nothing where it is another's by now."""
        self._ended.set()
        self._thread.join()
        if self.still_held():
            self._path.unlink(missing_ok=True)

    def _beat(self) -> None:
        while not self._ended.wait(BEAT_S):
            with contextlib.suppress(OSError):
                if self.still_held():
                    os.utime(self._path)


def path_of(output: Path) -> Path:
    """Where the claim of an output lies."""
    return output.with_name(f".{output.name}.claim")


@contextlib.contextmanager
def claim(output: Path) -> Iterator[Claim]:
    """Hold the claim of ``output``; waits as long as another one that lives holds it.

    What dead owners left half-written is removed.
    """
    told = ""
    while True:
        held = try_claim(path_of(output))
        if isinstance(held, Claim):
            break
        if told != held.token:
            told = held.token
            log.info("%s is being made by %s: waiting for it", output, held)
        time.sleep(_LOOK_S)
    try:
        _remove_parts(output)
        yield held
    finally:
        held.release()


def try_claim(path: Path) -> Claim | Owner:
    """The claim, or who holds it. Raises UserError where no file can be written there."""
    own, dead = Owner.this(), None
    with contextlib.suppress(OSError):  # told below
        path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        try:
            handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        except FileExistsError:
            held = _owner_of(path)
            if held is not None and held.lives(path):
                return held
            age = _age_s(path)
            if held is None and age is None and path.exists():
                raise UserError(
                    f"{path}: nothing can be written beside it, so whether its owner lives cannot "
                    "be told; free space or make the folder writable, then run again"
                ) from None
            if held is None and (age or 0.0) < _LOOK_S:
                time.sleep(_LOOK_S)  # it is being written
                continue
            dead = held
            _bury(path, held)
            continue
        except OSError as error:
            raise UserError(disk.told(error, path.parent)) from None
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                json.dump(own.__dict__, file)
        except OSError as error:
            path.unlink(missing_ok=True)
            raise UserError(disk.told(error, path.parent)) from None
        return Claim(path, own, dead)


def living_owner(output: Path) -> Owner | None:
    """Who makes an output just now; None where nobody does."""
    path = path_of(output)
    held = _owner_of(path)
    return held if held is not None and held.lives(path) else None


def _bury(path: Path, held: Owner | None) -> None:
    """Remove the claim of ``held``, who is dead, and no other one that came in its place."""
    dead = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
    try:
        os.rename(path, dead)
        if _owner_of(dead) != held:
            with contextlib.suppress(FileExistsError):
                os.link(dead, path)
        dead.unlink()
    except FileNotFoundError:
        pass
    except OSError as error:
        raise UserError(
            f"{path}: is left of a process that is dead, and cannot be removed ({error.strerror}); "
            "make its folder writable"
        ) from None


def _owner_of(path: Path) -> Owner | None:
    try:
        return Owner(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def _age_s(path: Path) -> float | None:
    """Seconds since a file was touched, by the clock of the file system that it lies on."""
    probe = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
    try:
        probe.touch()
        now = probe.stat().st_mtime
        probe.unlink()
        return now - path.stat().st_mtime
    except OSError:
        return None


def _place() -> str:
    found = []
    with contextlib.suppress(OSError):
        found.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="utf-8").strip())
        found.append(os.readlink("/proc/self/ns/pid"))
    return " ".join(found)


def _start_of(pid: int) -> int | None:
    """When a process of this machine started, in ticks of its clock; None where none lives,
    ``UNSEEN`` where there is no /proc, or it hides the processes of other users (``hidepid``)."""
    try:
        with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
            fields = file.read().rpartition(")")[2].split()
        return None if fields[0] in "ZX" else int(fields[19])
    except (OSError, ValueError, IndexError):
        pass
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        pass
    return UNSEEN


def _remove_parts(output: Path) -> None:
    """Leftovers of killed writers of this output: who holds the claim writes alone. A folder that
    was put aside for a new one, which never came, goes back."""
    for old in output.parent.glob(f".{output.name}.*.old"):
        if output.exists():
            shutil.rmtree(old, ignore_errors=True)
        else:
            old.rename(output)
    for path in output.parent.glob(f".{output.name}.*.part"):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
