"""A copy of the project whose runs are killed, starved of disk, or meet damaged results."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
import zipfile
from dataclasses import dataclass
from pathlib import Path

import h5py
import psutil

from intercap_core.pipeline.job import read_state
from tests.helpers.cluster_run import contents
from tests.helpers.flow import Flow

CORES = 2
LOOKS_EVERY_S = 0.05
Job = tuple[str, str]  # sequence, "" of what is made of all, and stage


@dataclass(frozen=True)
class Victim:
    """The copy, with what a user does about what happens to it: `intercap run`, again."""

    flow: Flow

    @property
    def logs(self) -> Path:
        return self.flow.folder / "logs" / "test"

    def start(self, environment: dict[str, str] | None = None) -> subprocess.Popen[bytes]:
        """`intercap run`, as the head of a process group."""
        command = [sys.executable, "-m", "intercap_core.cli", "run", self.flow.settings]
        with self.flow.transcript.open("wb") as said:
            return subprocess.Popen(
                [*command, "--cores", str(CORES)],
                cwd=self.flow.folder,
                env={**self.flow.environment, "COLUMNS": "400", **(environment or {})},
                stdin=subprocess.DEVNULL, stdout=said, stderr=subprocess.STDOUT,
                start_new_session=True,
                # tests that a shell runs in the background ignore Ctrl-C, and all that they start
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
            )  # fmt: skip

    def go_on(self) -> tuple[int, str]:
        """One command, to its end: exit status, and what it said."""
        status = self.start().wait()
        return status, self.flow.transcript.read_text(errors="replace")

    def kill(self, run: subprocess.Popen[bytes]) -> None:
        """`kill -9` of the whole group; raises AssertionError where a process of it is left."""
        os.killpg(run.pid, signal.SIGKILL)
        run.wait()
        ends = time.monotonic() + 5.0
        while left := [one for one in psutil.process_iter() if self._is_ours(one)]:
            assert time.monotonic() < ends, f"not in the group, and left: {left}"
            time.sleep(LOOKS_EVERY_S)

    def _is_ours(self, process: psutil.Process) -> bool:
        try:
            return process.status() != psutil.STATUS_ZOMBIE and process.cwd() == str(
                self.flow.folder
            )
        except psutil.Error:
            return False

    def running(self, since: float) -> list[Job]:
        """Jobs that have begun ``since`` a time and have not ended."""
        found = []
        for log in self.logs.glob("**/*.log"):
            try:
                begun = log.stat().st_mtime >= since and read_state(log)[0] == "running"
            except OSError:
                continue
            if begun and log.stem != "snakemake":
                found.append((log.parent.name if log.parent != self.logs else "", log.stem))
        return sorted(found)

    def seconds(self) -> dict[Job, float]:
        """How long each job took, by its log."""
        found = {}
        for log in self.logs.glob("**/*.log"):
            state, words = read_state(log)
            if state == "finished":
                name = log.parent.name if log.parent != self.logs else ""
                found[name, log.stem] = float(words.split()[0])
        return found

    def left_over(self) -> list[Path]:
        """Half-written files and folders, and those that were put aside."""
        return [
            path for path in self.flow.results.rglob(".*") if path.name.endswith((".part", ".old"))
        ]


def kill_in(victim: Victim, left: set[Job], usual: dict[Job, float]) -> Job | None:
    """Kill a run at a random moment of the first job of ``left`` that it comes to; returns which,
    None where the run ended first."""
    since = time.time() - 1.0
    run = victim.start()
    while run.poll() is None:
        begun = [job for job in victim.running(since) if job in left]
        if begun:
            ends = time.monotonic() + random.uniform(0.0, usual.get(begun[0], 1.0))
            while run.poll() is None and time.monotonic() < ends:
                time.sleep(LOOKS_EVERY_S)
            victim.kill(run)
            return begun[0]
        time.sleep(LOOKS_EVERY_S)
    return None


def kill_after(victim: Victim, seconds: float) -> None:
    """Kill a run that many seconds after its start, whatever it is at."""
    run = victim.start()
    time.sleep(seconds)
    victim.kill(run)


def replace(path: Path) -> str:
    """Remove a file, or put a link or a pipe in its place; returns which, in words."""
    path.unlink()
    kind = random.choice(["removed", "a link to nothing", "a link to itself", "a pipe"])
    if kind == "a link to nothing":
        path.symlink_to("nowhere")
    elif kind == "a link to itself":
        path.symlink_to(path.name)
    elif kind == "a pipe":
        os.mkfifo(path)
    return kind


def bomb(path: Path) -> str:
    """Put a small file in place of an output that unpacks to gigabytes; returns a description."""
    if path.suffix == ".h5":
        with h5py.File(path, "r+") as file:
            key = next(key for key in file if isinstance(file[key], h5py.Dataset))
            kind, rank = file[key].dtype, max(file[key].ndim, 1)
            del file[key]
            file.create_dataset(key, (1 << 40, *[1] * (rank - 1)), kind, chunks=True)
        return f"2^40 rows in {key}"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("values.npy", bytes(1 << 28))
    return "an archive of zeros"


def damage(path: Path) -> str:
    """Cut a file off, flip one of its bits, empty it, or write noise over it; returns which."""
    whole = path.read_bytes()
    where = random.randrange(len(whole))
    kind = random.choice(["cut", "flipped", "emptied", "overwritten"])
    if kind == "cut":
        path.write_bytes(whole[:where])
    elif kind == "flipped":
        byte = whole[where] ^ (1 << random.randrange(8))
        path.write_bytes(whole[:where] + bytes([byte]) + whole[where + 1 :])
    elif kind == "emptied":
        path.write_bytes(b"")
    else:
        noise = random.randbytes(min(4096, len(whole) - where))
        path.write_bytes(whole[:where] + noise + whole[where + len(noise) :])
    return f"{kind} at byte {where}"


def different(found: dict[str, bytes], wanted: dict[str, bytes]) -> list[str]:
    """Files of the results that have other bytes, or that only one of the two has."""
    names = sorted({*found, *wanted})
    return [name for name in names if found.get(name) != wanted.get(name)]


def identical(victim: Victim, other: Victim) -> dict[str, bool]:
    """Whether each file of the results is the other's, byte for byte; one that only one has is
    not."""
    found, wanted = contents(victim.flow.results), contents(other.flow.results)
    other_bytes = different(found, wanted)
    return {name: name not in other_bytes for name in {*found, *wanted}}
