"""Compare the joint stage with the paper's recipe: CPU seconds per frame and errors.

    python -m bench.joint_speed [config/bench/config.yaml] [--output results/bench.json]

Needs the artefacts of ``intercap dev bench``. Both methods refine the whole first sequence from the
same sequential fits, keypoints, clouds, crops and cameras, with the same number of threads. The
stage is timed with reading and writing of files, without the start of its process. The recipe
starts from inputs in memory and is timed over ``--steps`` steps, and until the truth says that it
is as accurate as ours or at its best. Adds figures with keys ``joint.<measure>`` to the output.
"""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path

from bench.timing import AS_GOOD, THREADS, first_as_good  # before the numerical libraries

# isort: split
import numpy as np
import torch

from bench.clips import JointClip, JointErrors, read_state
from bench.command import from_command_line, report_figures
from bench.joint_baseline import STEPS, Energy, refine
from intercap_core.joint.state import State
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project, load_project


def run_stage(project: Project, sequence: str) -> tuple[float, State]:
    """Run the whole stage; returns its seconds and its result."""
    with tempfile.TemporaryDirectory(dir=project.results) as folder:
        output = Path(folder) / "joint.h5"
        begin = time.process_time()
        run_step("joint", project, sequence, output=output)
        return time.process_time() - begin, read_state(output)


def measure(settings: Path, output: Path, steps: int) -> None:
    """Measure, print and add the figures to ``output``; see the module's docstring."""
    torch.set_num_threads(THREADS)
    project = load_project(settings)
    sequence = next(iter(project.sequences))
    clip = JointClip.load(project, sequence)
    run_stage(project, sequence)  # imports and warms up
    energy = Energy(clip)
    refine(energy, len(clip), 1)

    seconds, state = run_stage(project, sequence)
    recipe = refine(energy, len(clip), steps)
    found = [clip.errors(one) for one in recipe.states]
    start, end, reached = clip.errors(clip.start), found[-1], clip.errors(state)
    # state 0 is the common start
    means = np.array([one.mean for one in found[1:]])
    at, is_as_good = first_as_good(means, reached.mean, near_best=1.0)
    at += 1
    figures = {
        **_known(output, "joint.peak_memory_mb"),
        "seconds_per_frame": seconds / len(clip),
        "baseline_seconds_per_frame": recipe.seconds[-1] / len(clip),
        "baseline_until_seconds_per_frame": recipe.seconds[at] / len(clip),
        "baseline_steps": recipe.steps[-1],
        "baseline_until_steps": recipe.steps[at],
        "baseline_reaches_our_accuracy": float(is_as_good),
        "sequential_reaches_our_accuracy": float(start.mean <= AS_GOOD * reached.mean),
        "baseline_seconds_per_step": recipe.seconds[-1] / max(recipe.steps[-1], 1),
        "speedup_recipe": recipe.seconds[-1] / seconds,
        "speedup_accuracy": recipe.seconds[at] / seconds,
        "speedup": min(recipe.seconds[-1], recipe.seconds[at]) / seconds,
        **_errors("", reached),
        **_errors("sequential_", start),
        **_errors("baseline_", end),
        **_errors("baseline_until_", found[at]),
        "frames": len(clip),
        "threads": THREADS,
    }
    report_figures(output, "joint", figures)


def _errors(prefix: str, errors: JointErrors) -> dict[str, float]:
    return {f"{prefix}pve_mm": errors.pve, f"{prefix}object_translation_mm": errors.object_}


def _known(output: Path, key: str) -> dict[str, float]:
    """The figure of ``intercap dev bench`` that is in the output, which this area would replace."""
    known = json.loads(output.read_text(encoding="utf-8")) if output.exists() else {}
    return {key.partition(".")[2]: known[key]} if key in known else {}


if __name__ == "__main__":
    from_command_line(measure, (__doc__ or "").splitlines()[0], STEPS, "steps")
