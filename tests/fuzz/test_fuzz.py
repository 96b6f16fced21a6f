"""A few hundred damaged files of all kinds; `make fuzz` has thousands."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

from intercap_core.pipeline.job import THREAD_VARIABLES
from tests.fuzz.kinds import KINDS
from tests.fuzz.run import numbers_of_cases

CASES = 220


def test_damaged_files_are_accepted_and_plausible_or_refused_by_name(tmp_path: Path) -> None:
    output, kept = tmp_path / "bench.json", tmp_path / "outcomes.jsonl"
    done = subprocess.run(
        [
            *(sys.executable, "-m", "tests.fuzz.run", "--cases", str(CASES), "--seed", "2"),
            *("--workers", "1", "--output", str(output), "--keep", str(kept)),
        ],
        cwd=Path(__file__).resolve().parents[2],
        env=os.environ
        | dict.fromkeys(THREAD_VARIABLES, "1")
        | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(output.read_text())
    assert figures == {"fuzz.cases": CASES, "fuzz.unexplained": 0, "fuzz.seeds_refused": 0}
    found = [json.loads(line) for line in kept.read_text().splitlines()]
    damaged = [one for one in found if not one["case"].endswith(":-1")]
    assert len({one["case"] for one in damaged}) == CASES
    assert {one["case"].partition(":")[0] for one in found} == set(KINDS)
    assert Counter(one["verdict"] for one in damaged)["refused"] > CASES / 4


def test_cases_are_shared_out_exactly() -> None:
    for total in (len(KINDS), 220, 10_000):
        counts = numbers_of_cases(total)
        assert sum(counts.values()) == total and min(counts.values()) >= 1
