"""The small dataset as Slurm jobs while parts of the cluster fail.

Each run continues after one command, writes the bytes of a local run, and recomputes nothing that
was complete. `make test-slurm` runs these; the property `fault` names the fault in its figures.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from intercap_core.config import Config
from intercap_core.stage_list import STAGES
from tests.helpers.cluster_run import PROFILE, ClusterRun, contents, written
from tests.helpers.flow import ONE, OTHER, Flow
from tests.helpers.loopback_slurm import NODES, LoopbackSlurm

pytestmark = pytest.mark.usefixtures("everything")

# With two sequences on two nodes these stages, which share a job, never wait for a node.
CHAIN = ("frames", "detections", "scene", "person")
Record = Callable[[str, object], None]


@pytest.fixture(scope="module")
def local(everything: None, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """All files of a run on this machine alone."""
    flow = Flow.copy(tmp_path_factory.mktemp("local"))
    done = flow.run()
    assert done.returncode == 0, done.stderr[-3000:]
    return contents(flow.results)


@pytest.fixture(scope="module")
def run(everything: None, slurm: LoopbackSlurm, tmp_path_factory: pytest.TempPathFactory):
    """A finished run as Slurm jobs, which the tests restore."""
    run = ClusterRun(Flow.copy(tmp_path_factory.mktemp("cluster")), slurm)
    with overheads(run) as seconds:
        run.start().ends_well()
    (run.flow.folder / "overheads.txt").write_text("\n".join(map(str, seconds)))
    return run


@contextlib.contextmanager
def overheads(run: ClusterRun) -> Iterator[list[float]]:
    """Seconds of each job of the chain without those of its stages.

    Measured from the job's entry in the ledger to the moment when Snakemake knows of its end.
    """
    entries = run.flow.folder / ".snakemake" / "slurm_jobs"
    appeared: dict[str, tuple[float, str]] = {}
    seconds: list[float] = []
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(0.1):
            there = {path.stem: path for path in entries.glob("*.json")}
            for number, path in there.items():
                with contextlib.suppress(OSError):
                    appeared.setdefault(number, (time.monotonic(), path.read_text()))
            for number in appeared.keys() - there.keys():
                start, text = appeared.pop(number)
                logs = re.findall(r'"(logs/[^"]*/(\w+)\.log)"', text)
                if logs and logs[0][1] in CHAIN:
                    texts = [(run.flow.folder / path).read_text() for path, _ in logs]
                    own = [re.findall(r"finished in ([\d.]+) s", log)[-1] for log in texts]
                    seconds.append(time.monotonic() - start - sum(map(float, own)))

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield seconds
    finally:
        ended.set()
        watcher.join()


@contextlib.contextmanager
def recomputed(run: ClusterRun, local: dict[str, bytes], *stages: str) -> Iterator[list[str]]:
    """Targets of a run; within the block these artefacts of one sequence are missing.

    After the block they have the bytes of a local run, and no other artefact was written.
    """
    paths = [run.flow.artefact(ONE, stage) for stage in stages]
    names = {path.relative_to(run.flow.results).as_posix() for path in paths}
    for path in paths:
        path.unlink()
    kept = written(run.flow.results)
    yield [run.target(ONE, stage) for stage in stages]
    assert {name: (run.flow.results / name).read_bytes() for name in names} == {
        name: local[name] for name in names
    }
    now = written(run.flow.results)
    assert {name: now[name] for name in kept} == kept


def numbers(run: ClusterRun, *words: str) -> set[str]:
    return set(run.slurm.submitted_for(*words))


def job_runs(run: ClusterRun, stage: str) -> tuple[str, str]:
    """Number and node of the stage's job as soon as the stage has started."""
    log = run.flow.folder / "logs" / "test" / ONE / f"{stage}.log"
    start = time.time()
    found = run.slurm.wait_for(
        lambda: run.slurm.running(f"rule_{stage}_", ONE), f"{stage} runs", within=300
    )
    run.slurm.wait_for(
        lambda: log.exists() and log.stat().st_mtime >= start - 1.0,
        f"{stage} has begun",
        within=300,
    )
    return found


def test_the_same_bytes_as_on_one_machine(
    run: ClusterRun, local: dict[str, bytes], record_property: Record
) -> None:
    found = contents(run.flow.results)
    assert found.keys() == local.keys()
    assert {name for name in local if found[name] != local[name]} == set()
    jobs = run.slurm.jobs(ended=True)
    assert {state for state, _, _ in jobs.values()} == {"COMPLETED"}
    joined = sum(len(group) - 1 for group in Config(dataset="test").one_process)
    assert len(jobs) == 2 * (1 + len(STAGES) - joined) + 1  # the studio; the dataset
    seconds = [float(line) for line in (run.flow.folder / "overheads.txt").read_text().split()]
    assert len(seconds) == 2
    record_property("overhead_s", sum(seconds) / len(seconds))


def test_nothing_is_left_to_do(run: ClusterRun) -> None:
    before = run.slurm.jobs(ended=True).keys()
    assert "Nothing to be done" in run.start().ends_well()
    assert run.slurm.jobs(ended=True).keys() == before


def test_cancelled(run: ClusterRun, local: dict[str, bytes], record_property: Record) -> None:
    record_property("fault", "a job cancelled")
    before = numbers(run, "rule_joint_", ONE)
    with recomputed(run, local, "joint") as targets:
        started = run.start(*targets)
        number, _ = job_runs(run, "joint")
        run.slurm.command("scancel", number)
        said = started.ends_well()
    (reason,) = [
        line for line in said.splitlines() if f"Slurm job {number}, {ONE}: joint: " in line
    ]
    assert reason.endswith("CANCELLED")
    assert len(numbers(run, "rule_joint_", ONE) - before) == 2


def test_node_down_and_back(
    run: ClusterRun, local: dict[str, bytes], record_property: Record
) -> None:
    record_property("fault", "a node down and back")
    with recomputed(run, local, "joint") as targets:
        started = run.start(*targets)
        number, node = job_runs(run, "joint")
        run.slurm.kill(node)
        computing = processes_of(run, number)
        send(signal.SIGKILL, [*processes_of(run, number, keepers=True), *computing])
        run.slurm.wait_for(lambda: node not in run.slurm.idle_nodes(), "the node is down")
        run.slurm.start_one(node)
        started.ends_well()
    run.slurm.wait_for(lambda: run.slurm.idle_nodes() == set(NODES), "the node is back")


def processes_of(run: ClusterRun, number: str, *, keepers: bool = False) -> list[int]:
    """Processes that compute a job, or with ``keepers`` Slurm's own processes of the job."""
    own = f"slurmstepd: [{number}.".encode()
    here = f"SLURM_CONF={run.environment['SLURM_CONF']}".encode()
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            environment = set((folder / "environ").read_bytes().split(b"\0"))
            command = (folder / "cmdline").read_bytes()
            of_job = f"SLURM_JOB_ID={number}".encode() in environment
            wanted = command.startswith(own) if keepers else of_job and b"slurmstepd" not in command
            if here in environment and wanted:
                found.append(int(folder.name))
    return found


def send(number: signal.Signals, processes: list[int]) -> None:
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, number)


def test_controller_restarted(
    run: ClusterRun, local: dict[str, bytes], record_property: Record
) -> None:
    record_property("fault", "the controller down for half a minute while a job ends")
    before = numbers(run, ONE)
    with recomputed(run, local, "joint", "metrics") as targets:
        started = run.start(*targets)
        number, _ = job_runs(run, "joint")
        run.slurm.stop_one("slurmctld")
        time.sleep(30.0)
        run.slurm.start_one("slurmctld")
        started.ends_well()
    assert run.slurm.jobs(ended=True)[number][0] == "COMPLETED"
    assert len(numbers(run, ONE) - before) == 2


def test_controller_killed(
    run: ClusterRun, local: dict[str, bytes], record_property: Record
) -> None:
    """The restarted controller starts the job again, which its node refuses; it then holds the job
    and drains the node."""
    record_property("fault", "the controller killed before it notes that a job runs, which ends")
    before = numbers(run, ONE)
    saved = run.slurm.folder / "state" / "job_state"
    with recomputed(run, local, "joint", "metrics") as targets:
        # It saves a change at once where it has saved none for five seconds; else later.
        run.slurm.wait_for(lambda: time.time() - saved.stat().st_mtime > 10.0, "it has saved all")
        started = run.start(*targets)
        number, node = run.slurm.wait_for(
            lambda: run.slurm.running("rule_joint_", ONE), "joint runs", within=300
        )
        run.slurm.wait_for(lambda: processes_of(run, number), "the job is on its node")
        run.slurm.kill("slurmctld")
        time.sleep(30.0)
        run.slurm.start_one("slurmctld")
        said = started.ends_well()
    assert f"Slurm could not launch job '{number}' and holds it" in said
    assert run.slurm.jobs(ended=True)[number][0] == "CANCELLED"
    assert len(numbers(run, ONE) - before) == 2
    run.slurm.command("scontrol", "update", f"nodename={node}", "state=resume")
    run.slurm.wait_for(lambda: run.slurm.idle_nodes() == set(NODES), "the node is back")


def test_controller_down_when_jobs_are_submitted(
    run: ClusterRun,
    local: dict[str, bytes],
    record_property: Record,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Before a submission, and between the check that it answers and the submission."""
    record_property("fault", "the controller down when a job is submitted")
    before = numbers(run, ONE)
    sbatch, went = run.flow.folder / "bin" / "sbatch", run.flow.folder / "bin" / "went"
    sbatch.parent.mkdir()
    sbatch.write_text(
        f"""#!/bin/sh
test -e {went} && exec {shutil.which("sbatch")} "$@"
touch {went}
echo "sbatch: error: Batch job submission failed: Unable to contact slurm controller" \
    "(connect failure)" >&2
exit 1
"""
    )
    sbatch.chmod(0o755)
    monkeypatch.setenv("PATH", f"{sbatch.parent}:{os.environ['PATH']}")
    with recomputed(run, local, "joint") as targets:
        run.slurm.stop_one("slurmctld")
        started = run.start(*targets)
        run.slurm.wait_for(
            lambda: "Slurm's controller does not answer" in started.output, "it waits", within=300
        )
        assert not went.exists()
        run.slurm.start_one("slurmctld")
        started.ends_well()
    assert went.exists()
    assert len(numbers(run, ONE) - before) == 1


def test_interrupted(run: ClusterRun, local: dict[str, bytes], record_property: Record) -> None:
    record_property("fault", "Ctrl-C while a job runs")
    with recomputed(run, local, "joint") as targets:
        started = run.start(*targets)
        number, _ = job_runs(run, "joint")
        send(signal.SIGSTOP, processes_of(run, number))  # so that it cannot end by itself
        started.process.send_signal(signal.SIGINT)
        assert started.process.wait(120) == 1, started.output
        assert "Traceback" not in started.output
        run.slurm.wait_for(
            lambda: run.slurm.jobs(ended=True)[number][0] == "CANCELLED", "the job is cancelled"
        )
        run.start(*targets).ends_well()


def test_interrupted_while_the_controller_is_down(
    run: ClusterRun, local: dict[str, bytes], record_property: Record
) -> None:
    record_property("fault", "Ctrl-C while the controller is down")
    before = numbers(run, ONE)
    with recomputed(run, local, "joint") as targets:
        started = run.start(*targets)
        number, _ = job_runs(run, "joint")
        processes = processes_of(run, number)
        send(signal.SIGSTOP, processes)
        run.slurm.stop_one("slurmctld")
        started.process.send_signal(signal.SIGINT)
        assert started.process.wait(120) == 1, started.output
        assert "Slurm's jobs go on, and the next run waits for them" in started.output
        assert "Traceback" not in started.output
        run.slurm.start_one("slurmctld")
        again = run.start(*targets)
        found = f"Slurm job {number} of an earlier run computes"
        run.slurm.wait_for(lambda: found in again.output, "the job is found", within=300)
        send(signal.SIGCONT, processes)
        again.ends_well()
    assert len(numbers(run, ONE) - before) == 1


def test_submitter_killed(
    run: ClusterRun, local: dict[str, bytes], record_property: Record
) -> None:
    record_property("fault", "Snakemake killed and started again while its job runs on")
    before = numbers(run, ONE)
    with recomputed(run, local, "joint", "metrics") as targets:
        started = run.start(*targets)
        number, _ = job_runs(run, "joint")
        processes = processes_of(run, number)
        send(signal.SIGSTOP, processes)  # so that it cannot end before it is found
        started.kill()
        run.unlock()
        again = run.start(*targets)
        found = f"Slurm job {number} of an earlier run computes"
        run.slurm.wait_for(lambda: found in again.output, "the job is found", within=300)
        send(signal.SIGCONT, processes)
        assert "waiting for it" in again.ends_well()
    assert len(numbers(run, ONE) - before) == 2


def test_submitter_killed_and_the_input_edited(
    run: ClusterRun, local: dict[str, bytes], record_property: Record
) -> None:
    record_property("fault", "Snakemake killed, its job's settings edited before it ended")
    other = ("--config", "joint={contact_weight: 2}")
    with recomputed(run, local, "joint") as targets:
        started = run.start(*targets, *other)
        number, _ = job_runs(run, "joint")
        send(signal.SIGSTOP, processes_of(run, number))
        started.kill()
        run.unlock()
        said = run.start(*targets).ends_well()
    assert f"Slurm job {number} of an earlier run computes" in said
    assert "it is cancelled" in said
    assert run.slurm.jobs(ended=True)[number][0] == "CANCELLED"


def test_a_detector_on_a_gpu_uses_the_gpu_partition(
    run: ClusterRun, local: dict[str, bytes], tmp_path: Path
) -> None:
    """Slurm's node claims a GPU; the error that onnxruntime finds none is reported once."""
    onnxruntime = pytest.importorskip("onnxruntime")
    if "CUDAExecutionProvider" in onnxruntime.get_available_providers():
        pytest.skip("here the stage would find CUDA")
    model = tmp_path / "model.onnx"
    model.touch()
    before = numbers(run, "rule_detections_", ONE)
    with recomputed(run, local, "detections") as targets:
        on_gpu = f"detections={{keypoint_model: {model}, keypoint_device: cuda}}"
        started = run.start(*targets, "--config", on_gpu, "cluster={gpu_partition: gpu}")
        assert started.process.wait(300) == 1
        assert f"{ONE}: detections: failed: " in started.output
        assert "finds no cuda here" in started.output
        (number,) = numbers(run, "rule_detections_", ONE) - before
        assert (
            run.slurm.command("squeue", "-h", "-t", "all", "-j", number, "-o", "%P").strip()
            == "gpu"
        )
        assert "gres:gpu:1" in run.slurm.command("scontrol", "show", "job", number)
        run.start(*targets).ends_well()


def test_a_broken_annotation_fails_once_and_alone(
    run: ClusterRun, local: dict[str, bytes], record_property: Record
) -> None:
    """Results stay, in the report too; an incomplete sequence is left out."""
    record_property("fault", "one sequence's annotation broken")
    annotation, summary = run.flow.annotation(OTHER), run.flow.artefact(OTHER, "summary")
    annotation.parent.mkdir(exist_ok=True)
    annotation.write_text("floor: [[\n")
    output, new = jobs_of_failed_run(run)
    assert "the report leaves out" not in output
    assert new == [f"rule_broken_annotation_wildcards_{OTHER}"]
    assert contents(run.flow.results) == local
    summary.unlink()
    kept = written(run.flow.results)
    output, new = jobs_of_failed_run(run)
    assert f"the report leaves out {OTHER}" in output
    assert new == [f"rule_broken_annotation_wildcards_{OTHER}", "rule_dataset"]
    assert "not valid YAML" in (run.flow.results / "site" / "index.html").read_text()
    assert written(run.flow.results) == kept
    annotation.unlink()
    run.start().ends_well()
    assert contents(run.flow.results) == local


def jobs_of_failed_run(run: ClusterRun) -> tuple[str, list[str]]:
    """Output of an `intercap run` that fails because of the annotation, and its submitted jobs."""
    before = run.slurm.jobs(ended=True).keys()
    started = run.start_intercap("run", run.flow.settings, "--profile", PROFILE[1])
    assert started.process.wait(600) == 1, started.output
    assert "not valid YAML" in started.output
    jobs = run.slurm.jobs(ended=True)
    return started.output, sorted(jobs[number][1] for number in jobs.keys() - before)
