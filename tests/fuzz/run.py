"""Run thousands of cases on all cores, or one by its id: ``python -m tests.fuzz.run``."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from intercap_core.pipeline.job import THREAD_VARIABLES
from tests.fuzz.forks import Outcome, good_files, run_case
from tests.fuzz.kinds import KINDS

CASES, SEED = 10_000, 1


def numbers_of_cases(total: int) -> dict[str, int]:
    """How many cases each kind has, by its share."""
    shares = sum(kind.share for kind in KINDS.values())
    counts = {name: max(1, int(total * kind.share / shares)) for name, kind in KINDS.items()}
    order = sorted(counts, key=lambda name: -KINDS[name].share)
    for place in range(abs(rest := total - sum(counts.values()))):
        counts[order[place % len(order)]] += 1 if rest > 0 else -1
    return counts


def outcomes(total: int, seed: int, worker: int = 0, workers: int = 1) -> Iterator[Outcome]:
    """The undamaged files of each kind and their cases, of which this worker has every n-th."""
    for name, count in numbers_of_cases(total).items():
        kind = KINDS[name]
        with good_files(kind) as good:
            kind.read(good)  # kernels are compiled and libraries loaded before the first fork
            if worker == 0:
                yield run_case(kind, -1, seed, good)
            for number in range(worker, count, workers):
                yield run_case(kind, number, seed, good)


def _worker(total: int, seed: int, place: str) -> None:
    worker, workers = map(int, place.split("/"))
    for outcome in outcomes(total, seed, worker, workers):
        print(json.dumps(outcome.__dict__), flush=True)


def _lines(total: int, seed: int, workers: int) -> Iterator[Outcome]:
    if workers == 1:
        yield from outcomes(total, seed)
        return
    commands = [
        [
            *(sys.executable, "-m", "tests.fuzz.run", "--cases", str(total)),
            *("--seed", str(seed), "--worker", f"{n}/{workers}"),
        ]
        for n in range(workers)
    ]
    running = [subprocess.Popen(c, stdout=subprocess.PIPE, text=True) for c in commands]
    lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def forward(process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            lines.put(line)
        lines.put(None)

    for process in running:
        threading.Thread(target=forward, args=(process,), daemon=True).start()
    ended = 0
    while ended < len(running):
        line = lines.get()
        if line is None:
            ended += 1
            continue
        with contextlib.suppress(ValueError):  # libraries print as well
            yield Outcome(**json.loads(line))
    if any(process.wait() for process in running):
        raise SystemExit(f"a worker ended with {[process.returncode for process in running]}")


def main() -> None:
    """Read the command line, run, and say how the cases ended."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=CASES)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--case", help="one case again, as it was printed: kind:number")
    parser.add_argument("--keep", type=Path, help="write the outcomes here as well")
    parser.add_argument("--output", type=Path, default=Path("results/bench.json"))
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if any(os.environ.get(variable) != "1" for variable in THREAD_VARIABLES):
        # threads do not outlive a fork, and libraries count them when they are loaded
        alone = os.environ | dict.fromkeys(THREAD_VARIABLES, "1")
        os.execve(sys.executable, [sys.executable, "-m", "tests.fuzz.run", *sys.argv[1:]], alone)
    if arguments.worker:
        return _worker(arguments.cases, arguments.seed, arguments.worker)
    if arguments.case:
        name, _, number = arguments.case.partition(":")
        with good_files(KINDS[name]) as good:
            KINDS[name].read(good)
            outcome = run_case(KINDS[name], int(number), arguments.seed, good)
        print(f"{outcome.case} ({outcome.damage}): {outcome.verdict}: {outcome.told}")
        raise SystemExit(outcome.verdict == "unexplained")
    started = time.monotonic()
    counts: Counter[str] = Counter()
    refused_seeds = 0
    kept = arguments.keep.open("w") if arguments.keep else None
    for outcome in _lines(arguments.cases, arguments.seed, arguments.workers):
        if kept is not None:
            print(json.dumps(outcome.__dict__), file=kept, flush=True)
        if outcome.case.endswith(":-1"):
            if outcome.verdict != "ok":
                refused_seeds += 1
                print(f"{outcome.case} is a good file: {outcome.verdict}: {outcome.told}")
            continue
        counts[outcome.verdict] += 1
        if outcome.verdict == "unexplained":
            print(f"{outcome.case} ({outcome.damage}): {outcome.told}", flush=True)
    total = sum(counts.values())
    print(
        f"{total} cases of {len(KINDS)} kinds in {time.monotonic() - started:.0f} s: "
        f"{counts['refused']} refused, {counts['ok']} accepted, {counts['unexplained']} "
        f"unexplained; {refused_seeds} good files refused. One again: "
        f"python -m tests.fuzz.run --seed {arguments.seed} --case KIND:NUMBER"
    )
    from bench.command import add_figures

    add_figures(
        arguments.output,
        "fuzz",
        {"cases": total, "unexplained": counts["unexplained"], "seeds_refused": refused_seeds},
    )
    raise SystemExit(bool(counts["unexplained"] or refused_seeds))


if __name__ == "__main__":
    main()
