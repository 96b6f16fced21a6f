"""Compare the object's tracker of another commit with the present one, on the same artefacts.

    python -m bench.track_of_commit COMMIT SETTINGS [SETTINGS ...]

Every recording of the settings (such as config/object/noise_2.yaml or those in
results/seed_<N>/settings) is tracked with the code of the commit, checked out temporarily next to
this one, and with the present code: the same frames, detections, person and truth, each with its
own code's metrics. Settings that the commit does not know cannot be read. Prints one row of each,
and adds figures to ``--output`` with keys ``before.<dataset>.<measure>`` and
``now.<dataset>.<measure>``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

COLUMNS = {
    "lost": "lost_share", "not noticed": "lost_unnoticed_share", "first": "first_frame_success",
    "mm": "translation_median_mm", "p95": "translation_p95_mm", "deg": "rotation_median_deg",
    "p95 deg": "rotation_p95_deg", "precision": "flag_precision", "rest mm": "rest_jitter_mm",
    "rest deg": "rest_jitter_deg", "normalised": "normalised_median",
}  # fmt: skip


def errors_of(settings: Path, sequence: str, folder: Path) -> Any:
    """Errors of one recording's track, computed in ``folder`` by the imported code."""
    from intercap_core.evaluation import object_errors
    from intercap_core.geometry.rigid.mesh import ObjectMesh
    from intercap_core.pipeline.step import run_step
    from intercap_core.project import load_project

    project = load_project(settings)
    row = project.sequences[sequence]
    track = folder / f"{project.config.dataset}-{sequence}.h5"
    stages = ("frames", "scene", "detections", "person")
    inputs = {stage: project.artefact(sequence, stage) for stage in stages}
    run_step("object_track", project, sequence, inputs=inputs, output=track)
    scene = project.artefact(sequence, "scene")
    return object_errors.measure(
        scene, track, row.truth, ObjectMesh.load(project.objects[row.object])
    )


def measure_settings(settings: list[Path], folder: Path, workers: int) -> dict[str, Any]:
    """Figures by dataset, as in ``intercap evaluate``; see :func:`errors_of`."""
    from intercap_core.evaluation.object_errors import figures
    from intercap_core.project import load_project

    found = {}
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for path in settings:
            project = load_project(path)
            jobs = [pool.submit(errors_of, path, name, folder) for name in project.sequences]
            found[project.config.dataset] = figures([job.result() for job in jobs])
    return found


def measure_commit(commit: str, settings: list[Path], workers: int) -> dict[str, Any]:
    """:func:`measure_settings` with the code of ``commit``."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        subprocess.run(["git", "worktree", "add", "--detach", str(tree), commit], check=True)
        try:
            output = Path(folder) / "figures.json"
            subprocess.run(
                [sys.executable, __file__, commit, *map(str, settings), "--made-in", folder,
                 "--output", str(output), "--workers", str(workers)],
                check=True, env=os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"},
            )  # fmt: skip
            return dict(json.loads(output.read_text(encoding="utf-8")))
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", str(tree)], check=True)


def main() -> None:
    """Read the command line, measure both and print them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("commit")
    parser.add_argument("settings", type=Path, nargs="+")
    parser.add_argument("--output", type=Path, default=Path("results/track_of_commit.json"))
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--made-in", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    settings = [path.resolve() for path in arguments.settings]
    if arguments.made_in is not None:  # within the other commit's code
        found = measure_settings(settings, arguments.made_in, arguments.workers)
        arguments.output.write_text(json.dumps(found), encoding="utf-8")
        return
    both = {"before": measure_commit(arguments.commit, settings, arguments.workers)}
    with tempfile.TemporaryDirectory() as folder:
        both["now"] = measure_settings(settings, Path(folder), arguments.workers)
    _print(arguments.commit, both)
    from bench.command import add_figures

    for area, datasets in both.items():
        flat = {f"{name}.{key}": v for name, own in datasets.items() for key, v in own.items()}
        add_figures(arguments.output, area, flat)
    print(arguments.output)


def _print(commit: str, both: dict[str, dict[str, Any]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("recordings", "track", *COLUMNS, box=None, title=f"before: {commit}")
    for name in both["now"]:
        for area, datasets in both.items():
            values = [datasets[name].get(key) for key in COLUMNS.values()]
            table.add_row(name, area, *("" if v is None else f"{v:.3f}" for v in values))
    console = Console()
    console.width = max(console.width, 140)
    console.print(table)


if __name__ == "__main__":
    main()
