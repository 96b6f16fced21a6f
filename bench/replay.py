"""Replay a stage from stored artefacts, with another value of one constant.

    python -m bench.replay

Started by :mod:`bench.sensitivity`. Reads the JSON of a :class:`Task` and the path of an output
file from the standard input, and writes the task's :class:`Outcome`. Each task needs a process of
its own, because a changed constant must be imported before the modules that use it.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench.changed_constant import Constant, import_changed, scaled
from intercap_core.errors import UserError
from intercap_core.kernel_cache import VARIABLE, use_kernel_cache

# Of segmentation, the figures are those of the object's track without a detector's candidates
IMAGES_ONLY = {"person": {"segmentation": "images"}}


@dataclass(frozen=True)
class Task:
    """One replay."""

    settings: str
    """Path of the project's settings."""
    sequences: tuple[str, ...]
    stages: tuple[str, ...]
    """Stages to replay, in order."""
    overrides: Mapping[str, Any]
    """Settings that differ from the project's."""
    constant: Constant | None = None
    """None: the code is unchanged."""
    factor: float = 1.0
    unchanged: str = ""
    """Checksum of the arrays with the unchanged code. If they are equal, figures are omitted."""


@dataclass(frozen=True)
class Outcome:
    """Result of a replay."""

    before: str
    """Value of the constant, as text."""
    after: str
    """Its changed value."""
    checksum: str
    """Of all arrays that the last stage has written."""
    figures: dict[str, float]
    """Errors against truth; empty if the arrays are those of the unchanged code."""
    seconds: float
    """Of the stages."""
    failure: str = ""
    """Why a stage could not be replayed."""


def replay(task: Task) -> Outcome:
    """Change the constant, replay the stages and compare with the truth."""
    before = after = ""
    if task.constant is not None:
        name = task.constant.name
        try:
            values = import_changed(task.constant, lambda value: scaled(name, value, task.factor))
        except UserError as error:
            return Outcome("", "", "", {}, 0.0, str(error))
        before, after = map(_text, values)
        if before == after:
            return Outcome(before, after, task.unchanged, {}, 0.0)
    from bench.stage_figures import Written, figures_of
    from intercap_core.pipeline.step import run_step
    from intercap_core.project import load_project
    from intercap_core.stage_list import SEQUENCE_STAGES

    project = load_project(Path(task.settings), dict(task.overrides))
    seconds, state, written = 0.0, hashlib.sha256(), []
    with tempfile.TemporaryDirectory() as folder:
        for sequence in task.sequences:
            paths = {stage: project.artefact(sequence, stage) for stage in SEQUENCE_STAGES}
            for stage in task.stages:
                output = Path(folder) / f"{sequence}-{stage}.h5"
                begin = time.perf_counter()
                try:
                    run_step(stage, project, sequence, inputs=paths, output=output)
                except Exception as error:  # an impossible value may fail in any way
                    reason = f"{stage} of {sequence}: {type(error).__name__}: {error}"
                    return Outcome(before, after, "", {}, seconds, reason)
                seconds += time.perf_counter() - begin
                paths[stage] = output
            _add_arrays(state, output)
            written.append(Written(project, sequence, paths))
        checksum = state.hexdigest()
        figures = {} if checksum == task.unchanged else figures_of(task.stages[-1], written)
    return Outcome(before, after, checksum, figures, seconds)


def _add_arrays(state: Any, path: Path) -> None:
    """Update a checksum with all arrays of an HDF5 file."""
    import h5py

    def add(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            values = item[()]
            text = item.dtype.kind == "O"
            state.update(name.encode())
            state.update(repr(values.tolist()).encode() if text else values.tobytes())

    with h5py.File(path) as file:
        file.visititems(add)


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_text(entry)}" for key, entry in value.items())
    if hasattr(value, "tolist") and getattr(value, "ndim", 0):
        value = value.tolist()
    if isinstance(value, tuple | list):
        return "(" + ", ".join(map(_text, value)) + ")"
    return f"{value:.4g}"


def main() -> None:
    """Replay the task of the standard input."""
    request = json.load(sys.stdin)
    task, output = request["task"], Path(request["output"])
    constant = task.pop("constant")
    _use_kernels_without(request["stale"], output.parent)
    outcome = replay(Task(**task, constant=Constant(**constant) if constant else None))
    output.write_text(json.dumps(asdict(outcome)), encoding="utf-8")


def _use_kernels_without(stale: list[str], folder: Path) -> None:
    """Use links to the compiled kernels in ``folder``, except for those of ``stale`` modules.

    Numba compares a kernel's own file only, not the constants of other modules that it contains.
    """
    compiled = Path(os.environ[VARIABLE])
    os.environ[VARIABLE] = str(folder)
    own = use_kernel_cache()
    assert own is not None
    for path in compiled.glob("*/*.nb[ic]"):
        module = f"{path.parent.name.rpartition('_')[0]}.{path.name.partition('.')[0]}"
        if module not in stale:
            target = own / path.relative_to(compiled)
            target.parent.mkdir(exist_ok=True)
            target.symlink_to(path)


if __name__ == "__main__":
    main()
