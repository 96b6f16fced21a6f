"""`make chaos`: faults that happen on a cluster, and recovery by one command.

A small dataset is computed without disturbance. Copies of it are killed at a random moment of every
stage of every sequence and while Snakemake plans, run out of disk space, have damaged results, and
run with a wrong clock. After each fault ``intercap run`` is started again; in the end every file
must be identical to that of the undisturbed run. The same holds after all files were dated ahead of
the clock or behind it, and after files of exports, pages, tables and site were damaged, removed, or
replaced by links, pipes and files that unpack to gigabytes. Adds ``chaos.*`` to results/bench.json.
Full disks need a user who may mount a tmpfs, wrong clocks need libfaketime (Debian: faketime);
without them the round is skipped and a line says so.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from bench.command import add_figures
from intercap_core.stage_list import SEQUENCE_STAGES
from tests.chaos.victim import Job, Victim, bomb, damage, identical, kill_after, kill_in, replace
from tests.helpers.flow import Flow

OUTPUT = Path("results/bench.json")
KILLS_BEFORE_JOBS = 4
FIRST_ROOM_MB, MORE_ROOM_MB = 3, 6  # beside the recordings; a sequence takes some 20
FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketimeMT.so.1")
DAY_S = 86_400
SAID = "the disk is full or a quota is used up"


class Fault(Exception):
    """What should not have happened."""


def killed(undisturbed: Victim, victim: Victim) -> tuple[int, int]:
    """Kills of the whole group; returns how many, and after how many the output was identical.

    The output of a job that ended while a kill of another one was prepared is removed, once.
    """
    usual = undisturbed.seconds()
    left, removed, killed_in = set(usual), set[Job](), list[Job]()
    for _ in range(KILLS_BEFORE_JOBS):
        kill_after(victim, random.uniform(0.2, 4.0))
    while left:
        job = kill_in(victim, left, usual)
        if job is None:
            if left <= removed:
                raise Fault(f"these jobs never began: {sorted(left)}\n{_end_of(victim)}")
            again = min(left - removed)
            removed.add(again)
            path = victim.flow.results / _output_of(again)
            shutil.rmtree(path) if path.is_dir() else path.unlink()
            continue
        left.remove(job)
        killed_in.append(job)
        print(f"killed in {job[1]} of {job[0] or 'all'}", flush=True)
    _resume(victim)
    same = identical(victim, undisturbed)
    well = [job for job in killed_in if all(same[name] for name in same if _is_of(name, job))]
    rest = KILLS_BEFORE_JOBS if all(same.values()) else 0
    _print_differences(same)
    return len(killed_in) + KILLS_BEFORE_JOBS, len(well) + rest


def full_disk(undisturbed: Victim, victim: Victim) -> tuple[int, int]:
    """Results on a disk that is too small, and grows by little; returns how often a run ended for
    it and said so, and after how many of these the end was identical."""
    results = victim.flow.folder / "results"
    results.mkdir()
    recordings = undisturbed.flow.results / "recordings"
    taken = sum(file.stat().st_size for file in recordings.rglob("*") if file.is_file()) / 1e6
    size, ended = taken * 1.05 + FIRST_ROOM_MB, 0
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size:.0f}m", "tmpfs", results], check=True
    )
    try:
        shutil.copytree(recordings, victim.flow.results / "recordings")
        while True:
            status, said = victim.go_on()
            if victim.left_over():
                raise Fault(f"half-written on a full disk: {victim.left_over()}")
            if status == 0:
                break
            if SAID not in said or "Traceback" in said:
                raise Fault(f"the full disk is not what was said:\n{said[-3000:]}")
            ended += 1
            size += MORE_ROOM_MB
            print(f"a disk of {size - MORE_ROOM_MB:.0f} MB was full, and it was said", flush=True)
            subprocess.run(["mount", "-o", f"remount,size={size:.0f}m", results], check=True)
        same = identical(victim, undisturbed)
        _print_differences(same)
        return ended, ended if all(same.values()) else 0
    finally:
        subprocess.run(["umount", results], check=False)


def damaged(undisturbed: Victim, victim: Victim) -> tuple[int, int]:
    """Each artefact, one at a time and then all at once; returns how many were damaged, and how
    many were made again as they were."""
    shutil.copytree(undisturbed.flow.results, victim.flow.results)
    wanted = identical(victim, undisturbed)
    if not all(wanted.values()):
        raise Fault("a copy is not a copy")
    paths = [
        path
        for stage in SEQUENCE_STAGES
        for path in sorted(victim.flow.results.glob(f"*/{stage}.h5"))
    ]
    paths += [victim.flow.results / name for name in ("heatmaps.h5", "summary.json")]
    random.shuffle(paths)
    done = good = 0
    for some in ([paths[0]], [paths[1]], paths[2:]):
        for path in some:
            name = path.relative_to(victim.flow.results)
            print(f"{name}: {damage(path)}", flush=True)
        _resume(victim)
        same = identical(victim, undisturbed)
        _print_differences(same)
        done += len(some)
        good += sum(same[path.relative_to(victim.flow.results).as_posix()] for path in some)
    return done, good


def clock_jumps(undisturbed: Victim, victim: Victim) -> tuple[int, int]:
    """A run whose clock is days ahead is killed, one goes on whose clock is days behind and is
    killed, and one goes on by the true clock; returns jumps, and how many ended identical."""
    half = sum(undisturbed.seconds().values()) / 4
    for days in (3, -5):
        run = victim.start({
            "LD_PRELOAD": str(FAKETIME), "FAKETIME": f"{days * DAY_S:+d}s",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
        })  # fmt: skip
        time.sleep(half)
        victim.kill(run)
        print(f"killed by a clock {days:+d} days off", flush=True)
    _resume(victim)
    same = identical(victim, undisturbed)
    _print_differences(same)
    return 2, 2 if all(same.values()) else 0


def dates(undisturbed: Victim, victim: Victim) -> tuple[int, int]:
    """All files of the user and of the results dated ahead of the clock, then behind it.

    A damaged artefact makes jobs run. Returns the number of runs, and how many were identical.
    """
    shutil.copytree(undisturbed.flow.results, victim.flow.results)
    good = 0
    for days in (2, -9):
        damage(random.choice(sorted(victim.flow.results.glob("*/metrics.h5"))))
        date = time.time() + days * DAY_S
        for folder in (victim.flow.results, victim.flow.folder / "config"):
            for path in folder.rglob("*"):
                os.utime(path, (date, date))
        print(f"all files dated {days:+d} days", flush=True)
        _resume(victim)
        same = identical(victim, undisturbed)
        _print_differences(same)
        good += all(same.values())
    return 2, good


def deliverables(undisturbed: Victim, victim: Victim) -> tuple[int, int]:
    """Damage, replace or inflate files of exports, pages, tables, card, site, and artefacts.

    Returns the number of files, and how many of them ``intercap run`` restored.
    """
    shutil.copytree(undisturbed.flow.results, victim.flow.results)
    results = victim.flow.results
    patterns = ("*/export/**/*", "site/sequences/**/*", "site/*", "tables/*", "*.*", "*/*.h5")
    chosen = {}
    for pattern in patterns:
        files = [
            path
            for path in sorted(results.glob(pattern))
            if path.is_file() and not path.name.startswith(".") and path.stat().st_size
        ]
        for path, change in zip(
            random.sample(files, min(3, len(files))), (damage, replace, damage), strict=False
        ):
            chosen[path] = change
    for pattern in ("*/export/**/*.npz", "*/joint.h5"):
        path = random.choice(sorted(results.glob(pattern)))
        chosen[path] = bomb
    for path, change in chosen.items():
        print(f"{path.relative_to(results)}: {change(path)}", flush=True)
    _resume(victim)
    same = identical(victim, undisturbed)
    _print_differences(same)
    return len(chosen), sum(same[path.relative_to(results).as_posix()] for path in chosen)


def _resume(victim: Victim) -> None:
    status, said = victim.go_on()
    if status:
        raise Fault(f"the run did not go on:\n{said[-4000:]}")
    if victim.left_over():
        raise Fault(f"left half-written: {victim.left_over()}")


def _is_of(name: str, job: Job) -> bool:
    """Whether a file of the results is what a job makes."""
    if not job[0]:
        return name.count("/") == 0 or name.startswith("tables/") or name == "site/index.html"
    return name.startswith(_output_of(job))


def _output_of(job: Job) -> str:
    """Relative path of a job's output; of the dataset's job, that of one of them."""
    sequence, stage = job
    places = {
        "studio": f"recordings/{sequence}/", "page": f"site/sequences/{sequence}/",
        "export": f"{sequence}/export/",
    }  # fmt: skip
    return places.get(stage, f"{sequence}/{stage}.h5") if sequence else "summary.json"


def _print_differences(same: dict[str, bool]) -> None:
    other = sorted(name for name in same if not same[name])
    print(f"{len(same)} files, {len(other)} of them not identical {other[:8] or ''}", flush=True)


def _end_of(victim: Victim) -> str:
    return victim.flow.transcript.read_text(errors="replace")[-3000:]


Round = Callable[[Victim, Victim], tuple[int, int]]
ROUNDS: dict[str, tuple[Round, str]] = {
    "kills": (killed, ""),
    "full_disks": (full_disk, "" if os.geteuid() == 0 else "no tmpfs can be mounted: not root"),
    "damaged": (damaged, ""),
    "dates": (dates, ""),
    "deliverables": (deliverables, ""),
    "clock_jumps": (clock_jumps, "" if FAKETIME.is_file() else f"no {FAKETIME}: install faketime"),
}


def main() -> int:
    """Run the rounds; returns 1 where an end was not identical, or a round could not be run."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=None, help="of the random moments")
    parser.add_argument("--rounds", nargs="*", default=list(ROUNDS), choices=list(ROUNDS))
    arguments = parser.parse_args()
    seed = arguments.seed if arguments.seed is not None else random.randrange(10**6)
    random.seed(seed)
    print(f"seed {seed}", flush=True)
    figures: dict[str, float] = {}
    tried = survived = 0
    with tempfile.TemporaryDirectory() as folder:
        undisturbed = _copy(Path(folder), "undisturbed")
        _resume(undisturbed)
        for name in arguments.rounds:
            run, missing = ROUNDS[name]
            if missing:
                print(f"{name}: {missing}")
                continue
            print(f"{name}:", flush=True)
            try:
                count, well = run(undisturbed, _copy(Path(folder), name))
            except (Fault, AssertionError) as fault:
                print(f"{name}: {fault}")
                count, well = 1, 0
            figures[name] = count
            tried, survived = tried + count, survived + well
    figures |= {"identical": survived / max(tried, 1)}
    for name, value in figures.items():
        print(f"chaos.{name}: {value:g}")
    add_figures(OUTPUT, "chaos", figures)
    return 0 if survived == tried and tried else 1


def _copy(folder: Path, name: str) -> Victim:
    (folder / name).mkdir()
    return Victim(Flow.copy(folder / name))


if __name__ == "__main__":
    raise SystemExit(main())
