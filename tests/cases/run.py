"""Read input files that reproduce public bug reports: ``make cases``.

Counts the cases that are neither read with the right values nor refused in one sentence.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.command import add_figures


class Outcomes:
    """Counts the tests that ended, and those that failed; a skipped one has no folder of cases."""

    def __init__(self) -> None:
        self.total, self.failed, self.skipped = 0, 0, 0

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a test once, when its body ends."""
        self.skipped += report.skipped
        if report.when == "call" and not report.skipped:
            self.total += 1
            self.failed += report.failed


def main() -> None:
    """Run the tests of this folder and write their numbers."""
    found = Outcomes()
    code = pytest.main([str(Path(__file__).parent), "-q", "-n0"], plugins=[found])
    if found.skipped:
        print(f"{found.skipped} cases have no folder of inputs (INTERCAP_CASES) and were left out")
    figures = {"total": found.total, "silent": found.failed, "skipped": found.skipped}
    add_figures(Path("results/bench.json"), "cases", figures)
    raise SystemExit(code)


if __name__ == "__main__":
    main()
