"""What Slurm's commands say, and what is read from it; without a Slurm."""

from __future__ import annotations

import subprocess

import pytest

from snakemake_executor_plugin_intercap_slurm import slurm


def answer(monkeypatch: pytest.MonkeyPatch, text: str, status: int = 0) -> None:
    done = subprocess.CompletedProcess([], status, text, "")
    monkeypatch.setattr(slurm, "_run", lambda command: done)


def test_a_job_is_held_by_slurm_or_by_somebody(monkeypatch: pytest.MonkeyPatch) -> None:
    answer(
        monkeypatch,
        "1|RUNNING|None\n2|PENDING|launch failed requeued held\n3|PENDING|JobHeldUser\n\n"
        "4|PENDING|launch_failed_requeued_held\n5|PENDING|JobHoldMaxRequeue\n6|COMPLETED|None\n",
    )
    assert slurm.states("name") == {
        "1": "RUNNING", "2": slurm.HELD, "3": "PENDING", "4": slurm.HELD, "5": slurm.HELD,
        "6": "COMPLETED",
    }  # fmt: skip
    assert slurm.HELD in slurm.LIVE


def test_no_answer_is_not_an_empty_queue(monkeypatch: pytest.MonkeyPatch) -> None:
    answer(monkeypatch, "")
    assert slurm.states("name") == {}
    answer(monkeypatch, "", status=1)
    assert slurm.states("name") is None
    monkeypatch.setattr(slurm, "_run", lambda command: None)  # not in time
    assert slurm.states("name") is None
