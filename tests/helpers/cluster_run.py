"""A copy of the project whose jobs go to a Slurm of the test's own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tests.helpers.flow import Flow
from tests.helpers.loopback_slurm import LoopbackSlurm

PROFILE = ("--workflow-profile", "slurm")
ENDS_WITHIN_S = 900.0


@dataclass
class Started:
    """A running Snakemake, and the file of its output."""

    process: subprocess.Popen[bytes]
    transcript: Path

    @property
    def output(self) -> str:
        return self.transcript.read_text(errors="replace")

    def ends_well(self) -> str:
        """Wait until it ends successfully; returns its output."""
        status = self.process.wait(ENDS_WITHIN_S)
        assert status == 0, self.output[-6000:]
        return self.output

    def kill(self) -> None:
        """Kill Snakemake, as a power failure does; its jobs continue."""
        os.kill(self.process.pid, signal.SIGKILL)
        self.process.wait()


@dataclass
class ClusterRun:
    """The copy, and the Slurm that it submits to."""

    flow: Flow
    slurm: LoopbackSlurm

    @property
    def environment(self) -> dict[str, str]:
        return {**self.flow.environment, "SLURM_CONF": self.slurm.environment["SLURM_CONF"]}

    def start(self, *arguments: str) -> Started:
        return self._start(
            ["-m", "snakemake", "--configfile", self.flow.settings, *PROFILE, *arguments]
        )

    def start_intercap(self, *arguments: str) -> Started:
        return self._start(["-m", "intercap_core.cli", *arguments])

    def _start(self, command: Sequence[str]) -> Started:
        transcript = self.flow.folder / f"transcript-{time.monotonic_ns()}.txt"
        with transcript.open("wb") as file:
            process = subprocess.Popen(
                [sys.executable, *command],
                cwd=self.flow.folder,
                env={**self.environment, "COLUMNS": "400"},
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                # it must receive Ctrl-C, also if the tests run in a shell's background
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
            )
        return Started(process, transcript)

    def target(self, sequence: str, stage: str) -> str:
        return str(self.flow.artefact(sequence, stage).relative_to(self.flow.folder))

    def unlock(self) -> None:
        done = self.flow.run("--unlock")
        assert done.returncode == 0, done.stderr


def contents(results: Path) -> dict[str, bytes]:
    """Bytes of all files of a run's results by path, without caches of file dates."""
    return {
        path.relative_to(results).as_posix(): path.read_bytes()
        for path in sorted(results.rglob("*"))
        if path.is_file() and path.name not in (".snakemake_timestamp", ".inputs.json")
        if path.suffix != ".left"
    }


def written(results: Path) -> dict[str, int]:
    """Inode of each artefact, which changes when it is computed again."""
    return {
        path.relative_to(results).as_posix(): path.stat().st_ino for path in results.glob("*/*.h5")
    }
