"""Seconds and peak memory of every stage at several sequence lengths.

    python -m bench.stage_resources config/bench/config.yaml --frames 45 300

The first sequence of the project, which must be computed, is extended to each length
(``bench.joint_long``). Each stage runs in a separate process and prints one row. The resource
needs of the stages (``Stage.resources`` in ``intercap_core.stage_list``) are derived from it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from bench.joint_long import lengthen, peak_mb
from intercap_core.pipeline.step import run_step
from intercap_core.project import load_project
from intercap_core.stage_list import STAGES

FROM_ARTEFACTS = tuple(name for name, stage in STAGES.items() if len(stage.reads) > 1)


def measure(settings: Path, frames: int) -> None:
    """Print seconds and megabytes of each stage that reads artefacts, on ``frames`` frames."""
    project = load_project(settings)
    sequence = next(iter(project.sequences))
    with tempfile.TemporaryDirectory(dir=project.results) as folder:
        made = {name for stage in FROM_ARTEFACTS for name in STAGES[stage].reads}
        for stage in (name for name in STAGES if name in made):
            source = project.artefact(sequence, stage)
            lengthen(source, stage, Path(folder) / f"{stage}.h5", frames)
        for stage in FROM_ARTEFACTS:
            command = [sys.executable, "-m", "bench.stage_resources", str(settings)]
            subprocess.run(
                [*command, "--stage", stage, "--folder", folder, "--frames", str(frames)]
            )


def run(settings: Path, stage: str, folder: Path, frames: int) -> None:
    """Run one stage on a folder's artefacts and print its row."""
    project = load_project(settings)
    start = time.monotonic()
    inputs = {name: folder / f"{name}.h5" for name in STAGES[stage].reads}
    output = folder / f"{stage}.new"
    run_step(stage, project, next(iter(project.sequences)), inputs=inputs, output=output)
    print(f"{stage}\t{frames}\t{time.monotonic() - start:.1f} s\t{peak_mb():.0f} MB", flush=True)


def _main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("settings", type=Path, nargs="?", default=Path("config/bench/config.yaml"))
    parser.add_argument("--frames", type=int, nargs="+", default=[45, 300])
    parser.add_argument("--stage", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.stage:
        run(given.settings, given.stage, given.folder, given.frames[0])
        return
    for frames in given.frames:
        measure(given.settings, frames)


if __name__ == "__main__":
    _main()
