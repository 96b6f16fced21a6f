"""Damage files of every kind and read them: ``python -m tests.fuzz.run``.

A damaged file must be refused by its name, or be accepted with plausible content. Hypothesis draws
the damage and reduces what fails to a simple case.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from intercap_core.pipeline.job import THREAD_VARIABLES
from tests.fuzz.child import good_files, read_damaged
from tests.fuzz.damage import damaged
from tests.fuzz.kinds import KINDS
from tests.fuzz.plausible import Kind

CASES, SEED = 10_000, 1


def check_kind(kind: Kind, cases: int, number: int) -> Counter[str]:
    """Run cases of a kind and count results; raises AssertionError with the simplest failure."""
    counts: Counter[str] = Counter()
    with good_files(kind) as good:
        contents = {name: (good / name).read_bytes() for name in kind.damaged}

        @seed(number)
        @settings(
            max_examples=cases, deadline=None, database=None, suppress_health_check=HealthCheck
        )
        @given(data=st.data())
        def check(data: st.DataObject) -> None:
            name = data.draw(st.sampled_from(sorted(contents)))
            content = data.draw(damaged(contents[name], kind.form))
            verdict = read_damaged(kind, good, name, content)
            counts[verdict.result] += 1
            assert verdict.result != "unexplained", f"{kind.name}: {name}: {verdict.words}"

        check()
    return counts


def _report(name: str, cases: int, number: int) -> tuple[Counter[str], str]:
    try:
        return check_kind(KINDS[name], cases, number), ""
    except Exception as error:
        notes = [note[:300] for note in getattr(error, "__notes__", ())]
        return Counter(), " ".join([f"{name}: {error!r:.1000}", *notes])


def main() -> None:
    """Read the command line, run, and print how the cases ended."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cases", type=int, default=CASES)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND")
    parser.add_argument("--output", type=Path, default=Path("results/bench.json"))
    arguments = parser.parse_args()
    if any(os.environ.get(variable) != "1" for variable in THREAD_VARIABLES):
        # threads do not outlive a fork, and libraries count them when they are loaded
        alone = os.environ | dict.fromkeys(THREAD_VARIABLES, "1")
        os.execve(sys.executable, [sys.executable, "-m", "tests.fuzz.run", *sys.argv[1:]], alone)
    started = time.monotonic()
    cases = -(-arguments.cases // len(arguments.kinds))
    counts: Counter[str] = Counter()
    failures = []
    with ProcessPoolExecutor(arguments.workers) as pool:
        tasks = [pool.submit(_report, name, cases, arguments.seed) for name in arguments.kinds]
        for task in tasks:
            of_kind, failure = task.result()
            counts += of_kind
            if failure:
                failures.append(failure)
                print(failure, flush=True)
    print(
        f"{counts.total()} cases of {len(arguments.kinds)} kinds in "
        f"{time.monotonic() - started:.0f} s: {counts['refused']} refused, {counts['ok']} "
        f"accepted; {len(failures)} kinds failed"
    )
    from bench.command import add_figures

    refused = sum("good files" in failure for failure in failures)
    add_figures(
        arguments.output,
        "fuzz",
        {
            "cases": counts.total(),
            "unexplained": len(failures) - refused,
            "seeds_refused": refused,
        },
    )
    raise SystemExit(bool(failures))


if __name__ == "__main__":
    main()
