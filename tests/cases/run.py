"""Read input files that reproduce public bug reports: ``make cases``.

Counts the cases that are neither read with the right values nor refused in one sentence.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.command import add_figures


class Outcomes:
    """Names of the tests by outcome; a skipped one has no folder of cases."""

    def __init__(self) -> None:
        self.passed: set[str] = set()
        self.failed: set[str] = set()
        self.skipped: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Record one phase of a test; a test fails if its set-up, body or clean-up does."""
        if report.when == "call" or not report.passed:
            getattr(self, report.outcome).add(report.nodeid)


def main() -> None:
    """Run the tests of this folder and write their numbers."""
    found = Outcomes()
    code = pytest.main([str(Path(__file__).parent), "-q", "-n0"], plugins=[found])
    if found.skipped:
        print(
            f"{len(found.skipped)} cases were left out: their inputs (INTERCAP_CASES) are missing"
        )
    figures = {
        "total": len(found.passed | found.failed),
        "silent": len(found.failed),
        "skipped": len(found.skipped),
    }
    add_figures(Path("results/bench.json"), "cases", figures)
    raise SystemExit(code)


if __name__ == "__main__":
    main()
