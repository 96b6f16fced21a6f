"""The ledger of submitted jobs, and the end of a job according to its logs; without Slurm."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import pytest

from snakemake_executor_plugin_intercap_slurm.endings import endings
from snakemake_executor_plugin_intercap_slurm.ledger import JobEntry, Ledger


@dataclass
class Job:
    """As much of Snakemake's job as an entry is made of."""

    folder: Path
    settings: str = "a"
    stage: str = "joint"
    wildcards: tuple[str, ...] = ("walk",)
    params: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.params = {"settings": self.settings}
        self.rule = SimpleNamespace(name=self.stage)
        self.input = [self.folder / "frames.h5"]
        self.output = [self.folder / f"{self.stage}.h5"]
        self.log = [self.folder / f"{self.stage}.log"]

    def is_group(self) -> bool:
        return False


class Group(list):
    """Several jobs as one submission."""

    def is_group(self) -> bool:
        return True

    @property
    def input(self) -> list[Path]:
        return [path for job in self for path in job.input]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "frames.h5").write_bytes(b"frames")
    return tmp_path


def test_an_entry_is_read_back_as_it_was(folder: Path) -> None:
    (folder / "joint.log").write_text("old")
    ledger = Ledger(folder / "ledger")
    entry = JobEntry.of(Job(folder)).submitted("17", "rule_joint/walk/17.log")
    ledger.write(entry)
    assert ledger.keep({"17"}) == [entry]
    assert ledger.keep({"18"}) == []
    assert ledger.keep({"17"}) == []  # removed, as Slurm had it no more


def test_a_damaged_entry_counts_as_none(folder: Path) -> None:
    ledger = Ledger(folder / "ledger")
    (folder / "ledger").mkdir()
    for number, text in enumerate(('{"outputs": ["a', "[]", '{"logs": 3}', "\udcff")):
        (folder / "ledger" / f"{number}.json").write_bytes(text.encode(errors="surrogateescape"))
    assert ledger.keep({"0", "1", "2", "3"}) == []


def test_the_digest_depends_on_settings_and_inputs(folder: Path) -> None:
    entry = JobEntry.of(Job(folder))
    assert JobEntry.of(Job(folder)) == entry
    assert JobEntry.of(Job(folder, settings="b")).digest != entry.digest
    (folder / "frames.h5").write_bytes(b"other frames")
    assert JobEntry.of(Job(folder)).digest != entry.digest


def log(folder: Path, stage: str, *lines: str) -> None:
    (folder / f"{stage}.log").write_text("".join(f"12:00:00 {line}\n" for line in lines))


def test_each_stage_of_a_group_is_reported(folder: Path) -> None:
    stages = ("page", "export", "joint", "metrics")
    group = Group(Job(folder, stage=stage) for stage in stages)
    log(folder, "metrics", "failed: of an earlier run")
    entry = JobEntry.of(group)
    log(folder, "page", "page finished", "finished in 3.0 s")
    log(folder, "export", "failed: no such mesh")
    log(folder, "joint", "joint started with 1 thread(s)")
    slurm = folder / "slurm.log"
    slurm.write_text("slurmstepd: error: *** JOB 5 ON n1 CANCELLED AT 2026 DUE TO TIME LIMIT ***\n")
    found = {ending.name: ending for ending in endings(group, entry, slurm)}
    assert [found[f"walk: {stage}"].state for stage in stages] == [
        "finished", "failed", "running", "waiting",
    ]  # fmt: skip
    assert [name for name, ending in found.items() if ending.is_mistake] == ["walk: export"]
    assert found["walk: export"].line("5") == "Slurm job 5, walk: export: failed: no such mesh"
    assert "CANCELLED" in found["walk: joint"].line("5")


def test_each_stage_of_a_shared_job_is_reported(folder: Path) -> None:
    job = Job(folder, stage="scene_to_person")
    job.log = [folder / "scene.log", folder / "person.log"]
    entry = JobEntry.of(job)
    log(folder, "scene", "finished in 3.0 s")
    log(folder, "person", "failed: no keypoints")
    ends = [(found.name, found.state) for found in endings(job, entry, folder / "missing.log")]
    assert ends == [("walk: scene", "finished"), ("walk: person", "failed")]
    (folder / "person.log").unlink()
    states = [found.state for found in endings(job, entry, folder / "missing.log")]
    assert states == ["finished", "waiting"]
    log(folder, "scene", "failed: no images")
    (ending,) = endings(job, entry, folder / "missing.log")
    assert ending.line("5") == "Slurm job 5, walk: scene: failed: no images"


def test_an_unexpected_error_is_no_user_error(folder: Path) -> None:
    entry = JobEntry.of(Job(folder))
    log(folder, "joint", "failed: unexpected OSError: stale file handle")
    (ending,) = endings(Job(folder), entry, folder / "missing.log")
    assert ending.state == "failed"
    assert not ending.is_mistake


def test_a_job_killed_after_its_stage_is_reported(folder: Path) -> None:
    entry = JobEntry.of(Job(folder))
    log(folder, "joint", "finished in 3.0 s")
    slurm = folder / "slurm.log"
    slurm.write_text("slurmstepd: error: StepId=5.batch exceeded memory limit (2 > 1)\n")
    (ending,) = endings(Job(folder), entry, slurm)
    assert ending.state == "finished"
    said = "Slurm job 5, walk: joint: finished; its job then ended: exceeded memory limit"
    assert ending.line("5") == said


def test_a_log_of_an_earlier_run_is_ignored(folder: Path) -> None:
    log(folder, "joint", "failed: no such mesh")
    entry = JobEntry.of(Job(folder))
    (ending,) = endings(Job(folder), entry, folder / "missing.log")
    assert ending.state == "waiting"
    os.utime(folder / "joint.log", (1, 1))
    (ending,) = endings(Job(folder), entry, folder / "missing.log")
    assert ending.state == "failed"
