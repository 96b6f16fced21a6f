"""The profile on a real Slurm, on a recording so small that the normal suite can afford it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.helpers.cluster_run import ClusterRun, written
from tests.helpers.flow import Flow
from tests.helpers.loopback_slurm import LoopbackSlurm
from tests.helpers.plain_capture import write_rig

SETTINGS = "config/tiny/config.yaml"
FRAMES = 3
NAME = "walk"
SHORT_WAITS = ("--intercap-slurm-init-seconds-before-status-checks", "1")


@pytest.fixture(scope="module")
def tiny(slurm: LoopbackSlurm, tmp_path_factory: pytest.TempPathFactory) -> ClusterRun:
    """Two cameras, three small images each, and no detections; the frames are computed locally."""
    flow = Flow.copy(tmp_path_factory.mktemp("tiny"), settings=SETTINGS)
    settings = flow.folder / "config" / "tiny"
    settings.mkdir()
    generator = np.random.default_rng(5)
    for folder in write_rig(settings, (64, 48), 60.0).values():
        for number in range(FRAMES):
            image = generator.integers(0, 255, (48, 64, 3), dtype=np.uint8)
            cv2.imwrite(str(folder / f"{number:06d}.png"), image)
    (settings / "config.yaml").write_text("dataset: test\nobjects: ../objects.yaml\n")
    (settings / "subjects.tsv").write_text("subject\tgender\na\tneutral\n")
    header = ("sequence", "subject", "object", "layout", "recordings", "calibration")
    rows = [header, (NAME, "a", "", "plain", "recordings", "rig.json")]
    (settings / "sequences.tsv").write_text("".join("\t".join(row) + "\n" for row in rows))
    run = ClusterRun(flow, slurm)
    done = flow.run(run.target(NAME, "frames"))
    assert done.returncode == 0, done.stderr[-3000:]
    return run


def asked_mb(slurm: LoopbackSlurm, numbers: list[str]) -> list[int]:
    """Megabytes that each job asked for."""
    lines = slurm.command("squeue", "--noheader", "--states=all", "--format=%i|%m").splitlines()
    asked = dict(line.strip().split("|") for line in lines)
    return [int(asked[number].removesuffix("M")) for number in sorted(numbers, key=int)]


def test_a_job_killed_for_its_memory_comes_back_with_more(
    tiny: ClusterRun, slurm: LoopbackSlurm
) -> None:
    frames = tiny.flow.artefact(NAME, "frames")
    local = frames.read_bytes()
    frames.unlink()
    # By a user's factor, which still grows: Snakemake and the stage import 500 MB between them. The
    # first attempt has 220 MB, which is gone before the stage begins; the fourth has 880 MB.
    scale = ("--retries", "3", "--config", "cluster={memory_scale: {frames: 0.4}}")
    said = tiny.start(tiny.target(NAME, "frames"), *SHORT_WAITS, *scale).ends_well()
    asked = asked_mb(slurm, slurm.submitted_for("rule_frames", NAME))
    assert len(asked) in (2, 3, 4)
    assert asked[1:] == [asked[0] * attempt for attempt in range(2, 1 + len(asked))]
    lines = [line for line in said.splitlines() if f"{NAME}: frames: " in line]
    assert len(lines) == len(asked) - 1
    assert all(line.endswith("exceeded memory limit") for line in lines)
    assert frames.read_bytes() == local


def test_a_user_error_is_submitted_once(tiny: ClusterRun, slurm: LoopbackSlurm) -> None:
    kept = written(tiny.flow.results)
    started = tiny.start(tiny.target(NAME, "scene"))
    assert started.process.wait(300) == 1
    assert len(slurm.submitted_for("rule_detections", NAME)) == 1, started.output
    assert f"{NAME}: detections: failed: sequence {NAME}: no detections for any" in started.output
    assert "It is not submitted again" in started.output
    assert written(tiny.flow.results) == kept


def test_each_stage_of_a_group_is_reported(tiny: ClusterRun, slurm: LoopbackSlurm) -> None:
    tiny.flow.artefact(NAME, "frames").unlink()
    before = slurm.jobs(ended=True).keys()
    grouped = ("--groups", "frames=reading", "detections=reading")
    started = tiny.start(tiny.target(NAME, "detections"), *grouped)
    assert started.process.wait(300) == 1
    (number,) = slurm.jobs(ended=True).keys() - before
    assert f"Slurm job {number}, {NAME}: frames: finished" in started.output
    assert f"Slurm job {number}, {NAME}: detections: failed: sequence {NAME}" in started.output
