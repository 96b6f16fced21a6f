"""`intercap dev bench`: seconds per frame and peak memory of recordings, by stage and in total."""

from __future__ import annotations

import csv
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from bench.command import replace_figures
from bench.evaluate.tables import print_figures
from intercap_core import artefacts
from intercap_core.commands.run import snakemake_command
from intercap_core.errors import UserError
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project, load_project
from intercap_core.schemas import FRAMES
from intercap_core.stage_list import SEQUENCE_STAGES

REPEATS = 3  # measured runs, after one that imports and compiles
# The released InterCap dataset: sequences, and frames of all of them
INTERCAP = (223, 67_357)
# Stages from the frames to the metrics
MEASURED = SEQUENCE_STAGES[: SEQUENCE_STAGES.index("metrics") + 1]


def measure(settings: Path, output: Path, *, cores: int = 0) -> None:
    """Measure the project's sequences and write flat JSON with the keys ``area.measure``.

    A recording of the studio is made first, which is not measured. Then the workflow runs all
    stages up to the metrics, so that the starts of processes are included. Keeps the figures of
    other commands in the file. Raises UserError if a stage fails.

    - ``STAGE.seconds_per_frame``, ``STAGE.peak_memory_mb``: job of one stage.
    - ``verdict.seconds_per_frame``: duration of the held-out evaluation, see :func:`time_hold_out`.
    - ``end_to_end.seconds_per_frame``: duration of the whole run of the workflow.
    - ``end_to_end.peak_memory_mb``: largest sum of the resident memory of all processes.
    - ``frames.fps``, ``frames.bytes_...``: speed and size, see :func:`time_extraction`.
    - ``scale.intercap_core_hours``: all jobs for ``INTERCAP``, see :func:`core_hours`; only for two
      or more sequences.

    Keys are those of the first sequence; for further sequences they end in ``_FRAMES``.
    """
    project = load_project(settings)
    figures: dict[str, float] = {}
    seconds_of_jobs: dict[int, float] = {}  # by number of frames
    for sequence in project.sequences:
        found, frames = _measure_sequence(project, sequence, cores)
        seconds_of_jobs[frames] = frames * sum(
            found[f"{stage}.seconds_per_frame"] for stage in MEASURED
        )
        if figures:
            found = {f"{key}_{frames}": value for key, value in found.items()}
        else:
            found |= time_extraction(project, sequence, frames)
            found |= time_hold_out(settings, sequence, frames)
        figures |= found
    if len(seconds_of_jobs) > 1:
        figures["scale.intercap_core_hours"] = core_hours(seconds_of_jobs)
    areas = tuple({f"{key.partition('.')[0]}." for key in figures})
    replace_figures(output, figures, areas)
    print_figures(figures)
    print(output)


def _measure_sequence(project: Project, sequence: str, cores: int) -> tuple[dict[str, float], int]:
    """Compute a sequence; return its figures and its number of frames."""
    recordings = project.recordings_made(sequence)
    if recordings is not None:
        _run(project, recordings / "capture.json", cores)
    shutil.rmtree(project.results / sequence, ignore_errors=True)
    seconds, peak = _run(project, project.artefact(sequence, "metrics"), cores)
    with artefacts.read(project.artefact(sequence, "frames"), FRAMES) as source:
        frames = len(source["colour_index"])
    figures = {
        "end_to_end.seconds_per_frame": round(seconds / frames, 4),
        "end_to_end.peak_memory_mb": round(peak / (1 << 20), 1),
        **_stages(project, sequence, frames),
    }
    return figures, frames


def core_hours(seconds: Mapping[int, float]) -> float:
    """Hours that one core needs for the jobs of ``INTERCAP``.

    ``seconds`` are those of a sequence's jobs by its number of frames. The law is a constant for
    each sequence plus a constant for each frame (least squares).
    """
    frames = np.array(list(seconds), float)
    per_frame, per_sequence = np.polyfit(frames, list(seconds.values()), 1)
    total = per_sequence * INTERCAP[0] + per_frame * INTERCAP[1]
    return round(float(total) / 3600, 2)


def _run(project: Project, path: Path, cores: int) -> tuple[float, int]:
    """Run the workflow up to ``path``; returns seconds and peak resident bytes."""
    import psutil

    start = time.monotonic()
    arguments = [project.target(path), "--quiet", "all"]
    process = subprocess.Popen(
        snakemake_command(project, cores=cores, arguments=arguments),
        cwd=project.root,
        stdout=sys.stderr,
    )
    tree, peak = psutil.Process(process.pid), 0
    while process.poll() is None:
        total = 0
        try:
            for member in [tree, *tree.children(recursive=True)]:
                total += member.memory_info().rss
        except psutil.NoSuchProcess:
            continue  # ended between listing and asking
        peak = max(peak, total)
        time.sleep(0.1)
    if process.returncode:
        raise UserError(f"the run up to {path} failed; its messages are above")
    return time.monotonic() - start, peak


def _stages(project: Project, sequence: str, frames: int) -> dict[str, float]:
    """Figures of each stage, from the workflow's benchmark files."""
    figures = {}
    for stage in MEASURED:
        path = project.benchmarks / sequence / f"{stage}.tsv"
        with open(path, encoding="utf-8") as file:
            row = next(csv.DictReader(file, delimiter="\t"))
        figures[f"{stage}.seconds_per_frame"] = round(float(row["s"]) / frames, 4)
        # psutil does not sample a very short job
        if row["max_rss"] not in ("-", "NA"):
            figures[f"{stage}.peak_memory_mb"] = float(row["max_rss"])
    return figures


def time_extraction(project: Project, sequence: str, frames: int) -> dict[str, float]:
    """Speed of the frames stage, and the size of its artefact.

    - ``frames.fps``: frame sets per second, median over ``REPEATS`` runs.
    - ``frames.bytes_ratio``: bytes of frames.h5 over bytes of the recording files.
    - ``frames.bytes_per_set``, ``frames.recorded_bytes_per_set``: the same per frame set.
    """
    seconds = []
    with tempfile.TemporaryDirectory(dir=project.results) as folder:
        output = Path(folder) / "frames.h5"
        for _ in range(1 + REPEATS):
            output.unlink(missing_ok=True)
            start = time.perf_counter()
            run_step("frames", project, sequence, output=output)
            seconds.append(time.perf_counter() - start)
        written = output.stat().st_size
    row = project.sequences[sequence]
    files = row.recordings.rglob("*.mkv" if row.layout == "k4a" else "*")
    recorded = sum(path.stat().st_size for path in files if path.is_file())
    return {
        "frames.fps": round(frames / statistics.median(seconds[1:]), 2),
        "frames.bytes_ratio": round(written / recorded, 4),
        "frames.bytes_per_set": round(written / frames),
        "frames.recorded_bytes_per_set": round(recorded / frames),
    }


def time_hold_out(settings: Path, sequence: str, frames: int) -> dict[str, float]:
    """``verdict.seconds_per_frame``: seconds that the held-out evaluation adds to stage metrics.

    Difference of the medians over ``REPEATS`` alternating runs with and without it in one process.
    """
    seconds: dict[bool, list[float]] = {True: [], False: []}
    projects = {
        hold_out: load_project(settings, {"metrics": {"hold_out": hold_out}})
        for hold_out in seconds
    }
    for _ in range(1 + REPEATS):
        for hold_out, project in projects.items():
            with tempfile.TemporaryDirectory(dir=project.results) as folder:
                start = time.perf_counter()
                output = Path(folder) / "metrics.h5"
                run_step("metrics", project, sequence, output=output)
                seconds[hold_out].append(time.perf_counter() - start)
    with_it, without = (statistics.median(seconds[hold_out][1:]) for hold_out in (True, False))
    return {"verdict.seconds_per_frame": round((with_it - without) / frames, 4)}
