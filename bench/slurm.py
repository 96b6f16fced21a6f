"""`make test-slurm`: the workflow on a real Slurm on this machine, with faults.

Runs all tests of ``tests/slurm`` and adds to results/bench.json ``slurm.faults_tried``,
``slurm.faults_survived`` and ``slurm.overhead_s_per_job``: the seconds of a job from its submission
until its end is known, without those of its stage.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

from bench.command import report_figures

OUTPUT = Path("results/bench.json")


def figures(report: Path) -> dict[str, float]:
    """Figures from pytest's report: outcomes and recorded properties of the tests."""
    tried, survived, overhead = 0, 0, {}
    for case in ElementTree.parse(report).iter("testcase"):
        recorded = {one.get("name"): one.get("value") for one in case.iter("property")}
        bad = any(case.find(word) is not None for word in ("failure", "error", "skipped"))
        if "fault" in recorded:
            tried += 1
            survived += not bad
            print(f"{'not survived' if bad else 'survived'}: {recorded['fault']}")
        if "overhead_s" in recorded and not bad:
            overhead = {"overhead_s_per_job": float(str(recorded["overhead_s"]))}
    return {"faults_tried": tried, "faults_survived": survived, **overhead}


def main() -> int:
    """Run the tests; returns their exit status, 1 without Slurm."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.xml"
        command = [sys.executable, "-m", "pytest", "-n0", "-rs", "tests/slurm"]
        status = subprocess.call(
            [*command, f"--junitxml={report}", *sys.argv[1:]],
            env={**os.environ, "INTERCAP_TEST_SLURM": "1"},
        )
        measured = figures(report)
    if not measured["faults_tried"]:
        print("no fault was tried: Slurm cannot be started here (see above)", file=sys.stderr)
        return status or 1
    report_figures(OUTPUT, "slurm", measured)
    return status


if __name__ == "__main__":
    raise SystemExit(main())
