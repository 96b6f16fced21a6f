"""A run that was killed or terminated, or has damaged results, continues to the same bytes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from intercap_core.pipeline.lease import LeaseOwner
from tests.chaos.victim import Victim, damage, different, kill_in
from tests.helpers.cluster_run import contents
from tests.helpers.flow import ONE, OTHER, Flow

ENDS_WITHIN_S = 60.0
STAGE_S = 0.5  # duration of a replayed stage, in which signals can reach it


@pytest.fixture
def victim(flow: Flow, tmp_path: Path) -> Victim:
    """A copy of the finished project in which everything is up to date."""
    other = Victim(Flow.copy(tmp_path, replay=flow.results, pause_s=STAGE_S))
    shutil.copytree(flow.results, other.flow.results)
    other.flow.rewrite_manifests()
    return other


def test_a_killed_run_continues(victim: Victim) -> None:
    whole = contents(victim.flow.results)
    victim.flow.artefact(ONE, "metrics").unlink()
    assert kill_in(victim, {(ONE, "metrics")}, {(ONE, "metrics"): 2.0}) == (ONE, "metrics")
    status, output = victim.go_on()
    assert status == 0, output[-3000:]
    assert "was killed: going on where it stopped" in output
    assert victim.left_over() == []
    assert different(contents(victim.flow.results), whole) == []


@pytest.mark.full
def test_one_command_replaces_damage_downstream_of_unchanged_results(victim: Victim) -> None:
    """Snakemake plans only the first one: the outputs between them do not change."""
    whole = contents(victim.flow.results)
    for damaged in (
        *(victim.flow.artefact(OTHER, stage) for stage in ("joint", "summary")),
        victim.flow.results / "heatmaps.h5",
    ):
        damaged.write_bytes(damaged.read_bytes()[:-1000])
    status, output = victim.go_on()
    assert status == 0, output[-3000:]
    assert different(contents(victim.flow.results), whole) == []


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.full)]
)
def test_a_terminated_run_reports_once_and_leaves_no_parts(victim: Victim, number: int) -> None:
    victim.flow.artefact(ONE, "person").unlink()
    began = time.time() - 1.0
    run = victim.start()
    while not victim.running(began):
        assert run.poll() is None
        time.sleep(0.1)
    os.kill(run.pid, number) if number == signal.SIGTERM else os.killpg(run.pid, number)
    name = signal.Signals(number).name
    assert run.wait(ENDS_WITHIN_S) == 128 + number
    output = victim.flow.transcript.read_text()
    assert f"terminated by {name}: " in output and "Traceback" not in output
    log = (victim.logs / ONE / "person.log").read_text()
    assert log.rstrip().splitlines()[-1].partition("failed: ")[2].startswith("unexpected end")
    assert victim.left_over() == [] and not victim.flow.artefact(ONE, "person").exists()


@pytest.mark.full
def test_plain_snakemake_continues_after_a_killed_one(victim: Victim) -> None:
    """Its lock is removed; inputs and results are dated ahead of the clock."""
    whole = contents(victim.flow.results)
    ahead = time.time() + 7200
    for path in [*victim.flow.results.rglob("*"), *(victim.flow.folder / "config").rglob("*.*")]:
        os.utime(path, (ahead, ahead))
    damage(victim.flow.artefact(ONE, "metrics"))
    folder = victim.flow.folder / ".snakemake"
    (folder / "locks").mkdir(parents=True, exist_ok=True)
    (folder / "locks" / "0.output.lock").write_text("\n".join(map(str, whole)))
    metrics = victim.flow.artefact(ONE, "metrics").relative_to(victim.flow.folder)
    (folder / "locks" / "1.output.lock").write_text(f"{metrics}\n")
    with subprocess.Popen(["true"]) as ended:
        pass
    owner = replace(LeaseOwner.current(), pid=ended.pid)
    (folder / "workflow.lease").write_text(json.dumps(asdict(owner)))
    done = victim.flow.run()
    assert done.returncode == 0, done.stderr[-3000:]
    assert different(contents(victim.flow.results), whole) == []
    assert not (folder / "workflow.lease").exists()
