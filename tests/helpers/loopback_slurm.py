"""A real Slurm on this machine: munge, controller and two nodes, in one folder.

All daemons listen on the loopback address; the system's configuration is neither read nor changed.
The node daemon kills jobs that exceed their memory, once a second, without cgroups or accounting.
"""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel", "scontrol")
NODES = ("one", "two")
WITH_GPU = "two"  # as Slurm believes: a device node that does nothing
READY_WITHIN_S = 60.0

CONFIGURATION = """\
ClusterName=loopback
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort={controller}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
JobAcctGatherType=jobacct_gather/linux
JobAcctGatherFrequency=task=1
JobAcctGatherParams=OverMemoryKill
AccountingStorageType=accounting_storage/none
JobCompType=jobcomp/none
GresTypes=gpu
SwitchType=switch/none
MpiDefault=none
MinJobAge=60000
ReturnToService=2
SlurmdTimeout=10
KillWait=2
SlurmdParameters=config_overrides
SchedulerParameters=sched_min_interval=0,batch_sched_delay=0,sched_interval=2
"""


def missing() -> str | None:
    """Reason why Slurm cannot be started here; None if it can."""
    absent = [name for name in PROGRAMS if _program(name) is None]
    if absent:
        return f"{', '.join(absent)} not installed (Debian: slurm-wlm, munge)"
    if os.geteuid() != 0:
        return "Slurm's daemons start jobs as root only"
    return None


class LoopbackSlurm:
    """The daemons, by name: "munged", "slurmctld", and each of ``NODES``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        ports = _free_ports(1 + len(NODES))
        for name in ("state", *(f"spool-{node}" for node in NODES)):
            (folder / name).mkdir()
        nodes = [
            f"NodeName={node} NodeHostname=localhost NodeAddr=127.0.0.1 Port={port} "
            "CPUs=1 RealMemory=16000" + (" Gres=gpu:1" if node == WITH_GPU else "")
            for node, port in zip(NODES, ports[1:], strict=True)
        ]
        partition = f"PartitionName=main Nodes={','.join(NODES)} Default=YES State=UP"
        text = CONFIGURATION.format(controller=ports[0], folder=folder)
        gpu = f"PartitionName=gpu Nodes={WITH_GPU} State=UP"
        (folder / "slurm.conf").write_text("\n".join([text, *nodes, partition, gpu, ""]))
        (folder / "gres.conf").write_text(f"NodeName={WITH_GPU} Name=gpu File=/dev/null\n")
        key = folder / "munge.key"
        key.write_bytes(secrets.token_bytes(128))
        key.chmod(0o400)

    @property
    def environment(self) -> dict[str, str]:
        """Environment in which Slurm's commands use these daemons."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith("SLURM_")}
        return {**kept, "SLURM_CONF": str(self.folder / "slurm.conf")}

    def start(self) -> None:
        """Start all daemons; returns when both nodes take jobs."""
        for name in ("munged", "slurmctld", *NODES):
            self.start_one(name)
        self.wait_for(lambda: self.idle_nodes() == set(NODES), "both nodes are idle")

    def start_one(self, name: str) -> None:
        self._running[name] = subprocess.Popen(
            self._command(name),
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=(self.folder / f"{name}.out").open("ab"),
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        if name == "munged":
            self.wait_for((self.folder / "munge.socket").exists, "munged has its socket")

    def _command(self, name: str) -> list[str]:
        if name == "munged":
            given = {"key-file": "munge.key", "socket": "munge.socket", "pid-file": "munged.pid"}
            given |= {"log-file": "munged.log", "seed-file": "munged.seed"}
            files = [f"--{option}={self.folder / file}" for option, file in given.items()]
            # --force: munged would refuse parent folders that others may write
            return [str(_program("munged")), "--foreground", "--force", *files]
        if name == "slurmctld":
            return [str(_program("slurmctld")), "-D"]
        return [str(_program("slurmd")), "-D", "-N", name]

    def kill(self, name: str) -> None:
        """End one daemon at once; jobs of a node go on without it."""
        process = self._running.pop(name)
        process.kill()
        process.wait()

    def stop(self) -> None:
        """End all jobs and daemons."""
        if "slurmctld" in self._running:
            self.command("scancel", "--user=root")
            deadline = time.monotonic() + 15.0
            while self.jobs() and time.monotonic() < deadline:
                time.sleep(0.5)
        for name in reversed(list(self._running)):
            self.stop_one(name)

    def stop_one(self, name: str) -> None:
        """End one daemon as an administrator does: it saves its state first."""
        process = self._running.pop(name)
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(15)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def command(self, *arguments: str) -> str:
        """Output of one of Slurm's commands."""
        done = subprocess.run(arguments, env=self.environment, capture_output=True, text=True)
        return done.stdout

    def jobs(self, *, ended: bool = False) -> dict[str, tuple[str, str, str]]:
        """State, what it is for ("rule_joint_wildcards_NAME") and node of each job, by number."""
        states = ["--states=all"] if ended else []
        lines = self.command("squeue", "--noheader", *states, "--format=%i|%T|%k|%N").splitlines()
        fields = (line.strip().split("|") for line in lines)
        return {number: (state, comment, node) for number, state, comment, node in fields}

    def submitted_for(self, *words: str) -> list[str]:
        """Numbers of all jobs, ended ones too, whose purpose contains every word."""
        return [
            number
            for number, (_, comment, _) in self.jobs(ended=True).items()
            if all(word in comment for word in words)
        ]

    def running(self, *words: str) -> tuple[str, str] | None:
        """Number and node of a job that runs, whose purpose contains every word."""
        for number, (state, comment, node) in self.jobs().items():
            if state == "RUNNING" and all(word in comment for word in words):
                return number, node
        return None

    def idle_nodes(self) -> set[str]:
        return set(
            self.command("sinfo", "--noheader", "--Node", "--states=idle", "--format=%N").split()
        )

    def wait_for(self, holds: Callable[[], object], what: str, within: float = READY_WITHIN_S):
        """Return the first true value of ``holds``; fails with the daemons' logs."""
        deadline = time.monotonic() + within
        while time.monotonic() < deadline:
            found = holds()
            if found:
                return found
            time.sleep(0.2)
        logs = [f"{path.name}: {path.read_text()[-800:]}" for path in self.folder.glob("*.log")]
        raise AssertionError("\n".join([f"not within {within:.0f} s: {what}", *logs]))


def _program(name: str) -> str | None:
    return shutil.which(name, path=os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin"]))


def _free_ports(count: int) -> list[int]:
    sockets = [socket.socket() for _ in range(count)]
    try:
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]
    finally:
        for one in sockets:
            one.close()
