"""`intercap bench`: seconds a frame and peak memory of one recording, by stage and end to end."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.project import Project, load_project
from intercap_core.run import snakemake_command
from intercap_core.schemas import FRAMES
from intercap_core.step import SEQUENCE_STAGES

SAMPLE_SECONDS = 0.1
MEGABYTE = 1 << 20


def measure(settings: Path, output: Path, *, cores: int = 0) -> None:
    """Measure the project's first sequence and write flat JSON, keys ``area.measure``.

    The recording is made before, if it is a virtual one. Then every stage from the recordings to
    the metrics is computed anew through the workflow: process starts count, the studio does not.
    ``end_to_end.peak_memory_mb`` is the largest sum of resident memory over all processes of the
    run; a stage's is its own process's. Raises UserError where a stage fails.
    """
    project = load_project(settings)
    sequence = next(iter(project.sequences))
    made = project.recordings_made(sequence)
    if made is not None:
        _run(settings, str(made / "capture.json"), cores)
    shutil.rmtree(project.results / sequence, ignore_errors=True)
    seconds, peak = _run(settings, str(project.artefact(sequence, "metrics")), cores)
    with artefacts.read(project.artefact(sequence, "frames"), FRAMES) as source:
        frames, cameras = source["colour_index"].shape
    figures = {
        "end_to_end.seconds_per_frame": round(seconds / frames, 4),
        "end_to_end.peak_memory_mb": round(peak / MEGABYTE, 1),
        **_stages(project, sequence, frames),
    }
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    _print(figures, f"{sequence}: {frames} frame sets of {cameras} cameras")
    print(output)


def _run(settings: Path, target: str, cores: int) -> tuple[float, int]:
    """Run the workflow up to ``target``: seconds, and peak resident bytes of all its processes."""
    import psutil

    start = time.monotonic()
    process = subprocess.Popen(
        [*snakemake_command(settings, cores=cores, arguments=[target]), "--quiet", "all"],
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
        time.sleep(SAMPLE_SECONDS)
    if process.returncode:
        raise UserError(f"the run up to {target} failed; its messages are above")
    return time.monotonic() - start, peak


def _stages(project: Project, sequence: str, frames: int) -> dict[str, float]:
    """Each stage's own figures, from the workflow's benchmark files."""
    figures = {}
    for stage in SEQUENCE_STAGES:
        path = Path("benchmarks") / project.config.dataset / sequence / f"{stage}.tsv"
        with open(path, encoding="utf-8") as file:
            row = next(csv.DictReader(file, delimiter="\t"))
        figures[f"{stage}.seconds_per_frame"] = round(float(row["s"]) / frames, 4)
        # Too short a job is never sampled
        if row["max_rss"] not in ("-", "NA"):
            figures[f"{stage}.peak_memory_mb"] = float(row["max_rss"])
    return figures


def _print(figures: dict[str, float], title: str) -> None:
    table = Table("stage", "seconds a frame", "peak memory, MB", title=title, box=None)
    for area in ("end_to_end", *SEQUENCE_STAGES):
        memory = figures.get(f"{area}.peak_memory_mb")
        table.add_row(
            area,
            f"{figures[f'{area}.seconds_per_frame']:.3f}",
            "" if memory is None else f"{memory:.0f}",
        )
    Console().print(table)
