"""Leases: at most one process at a time writes an output, on any machine that shares the disk.

A lease is a file next to the output. Its owner updates the modification time every ``BEAT_S``
seconds (the heartbeat). A lease without a heartbeat for ``EXPIRES_S`` seconds has expired, and any
other process may take it over. A process must check :meth:`Lease.is_held` before it puts its
output in place, because it may have been suspended until its lease expired.
"""

from __future__ import annotations

import atexit
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
from dataclasses import asdict, dataclass
from pathlib import Path

from intercap_core import disk
from intercap_core.errors import UserError

log = logging.getLogger(__name__)

BEAT_S = 5.0  # between two heartbeats
EXPIRES_S = 30.0  # above the 3 to 10 s for which NFS clients cache a date that changes every 5 s
_POLL_S = 1.0  # between two attempts to acquire a lease that is held


@dataclass(frozen=True)
class LeaseOwner:
    """The process that holds a lease."""

    host: str
    """Name of the machine."""
    pid: int
    """Process number on that machine."""
    job: str
    """Slurm job number; "" outside Slurm."""
    since: str
    """Local time at which the lease was acquired."""
    token: str
    """Random text that identifies this acquisition."""

    @classmethod
    def current(cls) -> LeaseOwner:
        """This process, with a new token."""
        return cls(
            host=socket.gethostname(),
            pid=os.getpid(),
            job=os.environ.get("SLURM_JOB_ID", ""),
            since=time.strftime("%Y-%m-%d %H:%M:%S"),
            token=uuid.uuid4().hex,
        )

    def __str__(self) -> str:
        job = f", job {self.job}" if self.job else ""
        return f"process {self.pid} on {self.host}{job}, since {self.since}"


_UNKNOWN = LeaseOwner("an unknown host", 0, "", "an unknown time", "")


class Lease:
    """A lease of this process, with its heartbeat; returned by :func:`try_acquire`."""

    def __init__(self, path: Path, owner: LeaseOwner, expired: LeaseOwner | None) -> None:
        self.expired_owner = expired
        """Owner whose expired lease was taken over; None if there was none."""
        self._path, self._owner = path, owner
        self._released = threading.Event()
        self._thread = threading.Thread(target=self._beat, daemon=True)
        self._thread.start()

    def is_held(self) -> bool:
        """False if another process has taken the lease over or the file was deleted."""
        try:
            return self._owner.token in self._path.read_text(encoding="utf-8")
        except FileNotFoundError:
            return False
        except OSError:  # a file system that is temporarily unavailable
            return True

    def release(self) -> None:
        """End the heartbeat and remove the file, unless another process has taken it over."""
        self._released.set()
        self._thread.join()
        if self.is_held():
            self._path.unlink(missing_ok=True)

    def _beat(self) -> None:
        while not self._released.wait(BEAT_S):
            with contextlib.suppress(OSError):
                if self.is_held():
                    os.utime(self._path)


def lease_path(output: Path) -> Path:
    """Path of the lease of an output."""
    return output.with_name(f".{output.name}.lease")


@contextlib.contextmanager
def acquire(output: Path) -> Iterator[Lease]:
    """Hold the lease of ``output``; wait while another process holds it.

    Removes incomplete files that a killed writer of the output has left.
    """
    waiting_for = None
    while True:
        lease = try_acquire(lease_path(output))
        if isinstance(lease, Lease):
            break
        if waiting_for != lease:
            waiting_for = lease
            log.info("%s: waiting for %s, which is writing it", output, lease)
        time.sleep(_POLL_S)
    try:
        _remove_parts(output)
        yield lease
    finally:
        lease.release()


def try_acquire(path: Path) -> Lease | LeaseOwner:
    """Acquire the lease ``path``; returns its owner if another process holds it.

    Raises UserError if the folder is not writable.
    """
    owner, expired = LeaseOwner.current(), None
    text = json.dumps(asdict(owner))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with open(path, "x", encoding="utf-8") as file:
                file.write(text)
        except FileExistsError:
            holder = _read_holder(path)
            if holder is not None:
                return holder
            expired = _read_owner(path)
            part = path.with_name(f"{path.name}.{owner.token}")
            part.write_text(text, encoding="utf-8")
            os.replace(part, path)  # of two processes, the first finds the other's token in is_held
    except OSError as error:
        raise UserError(disk.describe_fault(error, path.parent)) from None
    return Lease(path, owner, expired)


def lease_holder(output: Path) -> LeaseOwner | None:
    """The process that is writing an output; None if no lease exists or it has expired."""
    return _read_holder(lease_path(output))


def _read_holder(path: Path) -> LeaseOwner | None:
    try:
        age_s = abs(file_system_time(path.parent) - path.stat().st_mtime)
    except FileNotFoundError:
        return None
    return (_read_owner(path) or _UNKNOWN) if age_s < EXPIRES_S else None


def _read_owner(path: Path) -> LeaseOwner | None:
    try:
        return LeaseOwner(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def file_system_time(folder: Path) -> float:
    """Current time by the clock that dates files: that of a file server may differ from ours."""
    probe = folder / f".clock.{uuid.uuid4().hex}"
    try:
        probe.touch()
        now = probe.stat().st_mtime
        probe.unlink()
    except OSError:
        return time.time()
    return now


def remove_dead_lock(folder: Path) -> None:
    """Remove Snakemake's lock from its ``folder`` if its owner was killed.

    The owner writes a lease into the folder and keeps it until its process ends. The lock stays if
    the lease has a heartbeat, or if another Snakemake or a job of one works in the same directory.
    A lock without a lease belongs to another program and stays.
    """
    path = folder / "workflow.lease"
    existed = path.exists()
    owner = _read_owner(path)
    if owner is not None and owner.host == socket.gethostname() and not _is_alive(owner.pid):
        path.unlink(missing_ok=True)  # without waiting until it expires
    try:
        lease = try_acquire(path)
    except UserError:  # a read-only folder
        return
    if not isinstance(lease, Lease):
        return
    atexit.register(lease.release)
    if existed and find_snakemake(folder.resolve().parent) is None:
        for lock in (folder / "locks").glob("*.lock"):
            lock.unlink(missing_ok=True)


def find_snakemake(folder: Path) -> int | None:
    """Process id of another Snakemake that works in ``folder``; None if there is none."""
    import psutil

    own = {os.getpid(), *(parent.pid for parent in psutil.Process().parents())}
    for process in psutil.process_iter(["pid", "cmdline", "cwd"]):
        words = process.info["cmdline"] or []
        named = "snakemake" in {Path(word).name for word in words[:3]}
        if named and process.info["cwd"] == str(folder) and process.info["pid"] not in own:
            return int(process.info["pid"])
    return None


def _is_alive(pid: int) -> bool:
    """Whether a process of this machine is alive; zombies are not."""
    import psutil

    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def _remove_parts(output: Path) -> None:
    """Remove incomplete outputs of killed writers, and restore a folder whose replacement failed.

    Only the owner of the lease may call this.
    """
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
