"""Replay a stage from stored artefacts with another value of one constant, in a new process.

    python -m bench.replay TASK OUTPUT

runs in that process: ``TASK`` is the JSON of a run, and its outcome is written to ``OUTPUT``.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench.changed_constant import Constant, import_changed, in_kernels, scaled
from intercap_core.errors import UserError

# Stages to replay, by room. The room of the images alone has figures only through what the object's
# track makes of its candidates, and then without a detector's.
STAGES: dict[str, tuple[str, ...]] = {
    "scene": ("scene",),
    "person": ("person",),
    "segmentation": ("person", "object_track"),
    "object_track": ("object_track",),
    "body_fit": ("body_fit",),
    "joint": ("joint",),
    "contact": ("joint",),
}
OVERRIDES: dict[str, dict[str, Any]] = {"segmentation": {"person": {"segmentation": "images"}}}


@dataclass(frozen=True)
class Run:
    """One replay of a package's stages; ``constant`` None = with the unchanged code."""

    room: str
    constant: Constant | None = None
    factor: float = 1.0
    around: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """Result of a replay: the value as text, and figures or the reason of its failure."""

    value: str
    changed: str
    figures: dict[str, float]
    seconds: float
    failure: str = ""


def replay(settings: Path, sequences: Sequence[str], run: Run) -> Outcome:
    """Change the constant, replay its stages from stored artefacts, and measure.

    Must be called in a new process, see :func:`import_changed`.
    """
    value, changed = "", ""
    if run.constant is not None:
        name = run.constant.name
        old, new = import_changed(
            run.constant, lambda value: scaled(name, value, run.factor, run.around)
        )
        value, changed = _text(old), _text(new)
    from bench.stage_figures import Written, figures_of
    from intercap_core.pipeline.step import run_step
    from intercap_core.project import load_project
    from intercap_core.stage_list import SEQUENCE_STAGES
    from intercap_core.stage_list import STAGES as EVERY

    project = load_project(settings, OVERRIDES.get(run.room))
    stages = STAGES[run.room]
    seconds = 0.0
    with tempfile.TemporaryDirectory() as folder:
        written = []
        for sequence in sequences:
            known = {stage: project.artefact(sequence, stage) for stage in SEQUENCE_STAGES}
            for stage in stages:
                output = Path(folder) / f"{sequence}-{stage}.h5"
                inputs = {name: known[name] for name in EVERY[stage].reads}
                begin = time.perf_counter()
                try:
                    run_step(stage, project, sequence, inputs=inputs, output=output)
                except UserError as error:
                    return Outcome(value, changed, {}, seconds, f"{stage} of {sequence}: {error}")
                seconds += time.perf_counter() - begin
                known[stage] = output
            written.append(Written(project, sequence, known))
        return Outcome(value, changed, figures_of(stages[-1], written), seconds)


def content_key(settings: Path, sequences: Sequence[str], run: Run) -> str:
    """Digest of all inputs of a replay: code, settings, artefacts, truth and the change."""
    from intercap_core.pipeline.code_digest import code_digest
    from intercap_core.project import load_project
    from intercap_core.stage_list import STAGES as EVERY

    project = load_project(settings, OVERRIDES.get(run.room))
    state = hashlib.sha256(project.config.model_dump_json().encode())
    for module in [f"stages.{stage}" for stage in STAGES[run.room]]:
        state.update(code_digest(module).encode())
    here = Path(__file__).parent
    for name in ("stage_figures.py", "changed_constant.py"):
        state.update((here / name).read_bytes())
    reads = {name for stage in STAGES[run.room] for name in EVERY[stage].reads}
    for sequence in sequences:
        row = project.sequences[sequence]
        for name in sorted(reads - set(STAGES[run.room])):
            state.update(file_digest(project.artefact(sequence, name)))
        if row.truth is None:
            raise UserError(f"{settings}: sequence {sequence!r} has no truth to be held to")
        state.update(file_digest(row.truth))
    state.update(json.dumps([list(sequences), _plain(run)]).encode())
    return state.hexdigest()[:24]


_digests: dict[tuple[Path, int], bytes] = {}


def file_digest(path: Path) -> bytes:
    """SHA-256 of a file, cached in the process until the file changes.

    Raises UserError where the file is missing.
    """
    if not path.is_file():
        raise UserError(f"{path}: not there; take the recordings to their metrics first")
    key = (path, path.stat().st_mtime_ns)
    if key not in _digests:
        with path.open("rb") as file:
            _digests[key] = hashlib.file_digest(file, "sha256").digest()
    return _digests[key]


def _plain(run: Run) -> dict[str, Any]:
    return asdict(run)


def run_from(plain: Mapping[str, Any]) -> Run:
    constant = Constant(**plain["constant"]) if plain["constant"] else None
    return Run(plain["room"], constant, plain["factor"], plain["around"])


class Replays:
    """Run replays in separate processes and cache their outcomes in a JSON file."""

    def __init__(self, settings: Path, sequences: Sequence[str], known: Path, jobs: int) -> None:
        self._settings, self._sequences = settings, list(sequences)
        self._path, self._jobs = known, jobs
        self._known = json.loads(known.read_text(encoding="utf-8")) if known.exists() else {}
        self._lock = threading.Lock()

    def of(self, runs: Sequence[Run]) -> list[Outcome]:
        """Outcome of each run; unknown outcomes are computed."""
        keys = [content_key(self._settings, self._sequences, run) for run in runs]
        with ThreadPoolExecutor(self._jobs) as pool:
            return list(pool.map(self._one, runs, keys))

    def _one(self, run: Run, key: str) -> Outcome:
        if key not in self._known:
            outcome = self._start(run)
            with self._lock:
                self._known[key] = asdict(outcome)
                self._path.parent.mkdir(parents=True, exist_ok=True)
                text = json.dumps(self._known, indent=1) + "\n"
                self._path.write_text(text, encoding="utf-8")
            what = run.constant.label if run.constant else f"{run.room} as it is"
            print(f"{what} times {run.factor:g}: {outcome.seconds:.0f} s", file=sys.stderr)
        return Outcome(**self._known[key])

    def _start(self, run: Run) -> Outcome:
        task = {"settings": str(self._settings), "sequences": self._sequences, "run": _plain(run)}
        environment = os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
        with tempfile.TemporaryDirectory() as folder:
            # numba's cache does not see the value of a global that was compiled in
            if run.constant is not None and in_kernels(run.constant):
                environment["NUMBA_CACHE_DIR"] = folder
            output = Path(folder) / "outcome.json"
            done = subprocess.run(
                [sys.executable, "-m", "bench.replay", json.dumps(task), str(output)],
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
            if done.returncode:
                last = (done.stderr.strip().splitlines() or ["no message"])[-1]
                raise UserError(f"a replay of {run.room} ended with {done.returncode}: {last}")
            return Outcome(**json.loads(output.read_text(encoding="utf-8")))


def _text(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_text(entry)}" for key, entry in value.items())
    if hasattr(value, "tolist") and getattr(value, "ndim", 0):
        value = value.tolist()
    if isinstance(value, tuple | list):
        return "(" + ", ".join(_text(entry) for entry in value) + ")"
    return f"{value:.4g}"


def main(task: str, output: str) -> None:
    """Replay one run and write its outcome."""
    request = json.loads(task)
    outcome = replay(Path(request["settings"]), request["sequences"], run_from(request["run"]))
    Path(output).write_text(json.dumps(asdict(outcome)), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
