"""Seconds and peak memory of every stage at several sequence lengths.

    python -m bench.stage_resources config/bench/config.yaml --frames 45 300 1000

The first sequence of the project, which must be computed, is extended to each length. Each stage
runs in a separate process and prints one row: stage, frames, CPU seconds and peak memory. From the
two greatest lengths follow the law of each stage, linear in the frames, and
``scale.long_recording_mb``: the largest peak of a recording of 10 minutes at 30 frames per second
by these laws. The resource needs of the stages (``Stage.resources`` in
``intercap_core.stage_list``) are derived from it.

A recording is repeated forward and backward, so that motion is continuous: every dataset with a
frame axis in the stage's inputs is extended. Images are not copied; the new frames refer to the
existing images. In backward frames the sign of the cameras' time offsets is wrong, so the result
is suited to measure time and memory, not errors; it has no truth.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from intercap_core import artefacts, schemas
from intercap_core.artefacts import Artefact, Writer
from intercap_core.errors import UserError
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project, load_project
from intercap_core.stage_list import STAGES

FROM_ARTEFACTS = tuple(name for name, stage in STAGES.items() if len(stage.reads) > 1)
MEGABYTE = 1 << 10  # in kilobytes
LONG_RECORDING = 18_000  # frames: 10 minutes at 30 per second
# Ragged datasets: offsets with one entry per frame or image (of all cameras, or within a camera's
# group), and the datasets that they index.
_PER_IMAGE = {
    "mask_offsets": ("mask_rle",),
    "beside_offsets": ("beside_rle",),
    "candidate_offsets": (
        "candidate_scores", "candidate_extents", "candidate_things", "candidate_rle",
    ),
    "cloud_offsets": ("cloud_points", "cloud_normals", "cloud_edge", "cloud_view"),
    "rim_offsets": ("rim_rays", "rim_normals", "rim_view"),
}  # fmt: skip
_PER_SET = {
    "people_offsets": ("people",),
    "candidate_offsets": ("candidate_labels", "candidate_scores", "candidate_boxes", "rle"),
}
# Datasets whose elements have their own offsets
_OFFSETS_WITHIN = {"candidate_rle": "candidate_rle_offsets", "rle": "rle_offsets"}


def there_and_back(frames: int, count: int) -> np.ndarray:
    """Indices (count,) of ``frames`` frames, forward and backward, none twice in a row."""
    turn = np.r_[np.arange(frames), np.arange(frames - 2, 0, -1)]
    return np.resize(turn, count)


def lengthen(source: Path, stage: str, output: Path, count: int) -> None:
    """Write the artefact of ``stage`` with ``count`` frames.

    Raises UserError if the source has fewer than two frames.
    """
    schema = getattr(schemas, stage.upper())
    with artefacts.read(source, schema) as read:
        attributes = {name: read.attributes[name] for name in _declared(read, schema)}
        frames = _frames(read, schema)
        if frames < 2:
            raise UserError(f"{source}: has {frames} frame, expected two or more to play back")
        order = there_and_back(frames, count)
        with artefacts.write(output, schema, **attributes) as writer:
            ragged = {key: _parts(key) for key in read.keys("") if _parts(key)}
            parts = {part for found in ragged.values() for pair in found for part in pair}
            for key in read.keys(""):
                if key not in ragged and key not in parts:
                    writer.put(key, _extended(read, schema, key, order))
            for key in sorted(ragged):
                _put_ragged(read, writer, key, order, frames)


def _parts(key: str) -> list[tuple[str, ...]]:
    """Datasets that the offsets ``key`` index, each with its own offsets if it has any."""
    group, _, name = key.rpartition("/")
    names = (_PER_SET if group else _PER_IMAGE).get(name, ())
    within = [(part, *filter(None, [_OFFSETS_WITHIN.get(part)])) for part in names]
    return [tuple(f"{group}/{one}" if group else one for one in pair) for pair in within]


def _declared(read: Artefact, schema: artefacts.Schema) -> list[str]:
    names = {*schema.attributes, *schema.optional_attributes}
    return sorted(names & read.attributes.keys())


def _frames(read: Artefact, schema: artefacts.Schema) -> int:
    keys = (key for key in read.keys("") if schema.field_of(key).dims[:1] == ("T",))
    return len(read[next(keys)])


def _extended(read: Artefact, schema: artefacts.Schema, key: str, order: np.ndarray) -> np.ndarray:
    values, dims = read[key], schema.field_of(key).dims
    if "T" not in dims:
        return values
    if key == "times":
        return values[0] + np.median(np.diff(values)) * np.arange(len(order))
    if key == "image_of":
        return _nearest_sets(values, order)
    return np.take(values, order, axis=dims.index("T"))


def _nearest_sets(image_of: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Sets (N, C) whose images show each moment; of several copies, the nearest in time."""
    wanted = image_of[order]
    found = np.full_like(wanted, -1)
    for number in np.unique(wanted[wanted >= 0]):
        at = np.flatnonzero(order == number)
        i, c = np.nonzero(wanted == number)
        found[i, c] = at[np.abs(at[None] - i[:, None]).argmin(1)]
    return found


def _put_ragged(read: Artefact, writer: Writer, key: str, order: np.ndarray, frames: int) -> None:
    """Write offsets with one entry per frame or image (T, C), and the datasets that they index."""
    offsets = read[key]
    views = (len(offsets) - 1) // frames
    image = (order[:, None] * views + np.arange(views)).ravel()
    lengths = np.diff(offsets)[image]
    writer.put(key, np.concatenate([[0], np.cumsum(lengths)]))
    rows = _runs(offsets[image], lengths)
    for part, *within in _parts(key):
        if not within:
            writer.put(part, read[part][rows])
        else:
            starts = read[within[0]]
            sizes = np.diff(starts)[rows]
            writer.put(within[0], np.concatenate([[0], np.cumsum(sizes)]))
            writer.put(part, read[part][_runs(starts[rows], sizes)])


def _runs(starts: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Concatenated indices start, start + 1, ... of every run."""
    ends = np.cumsum(lengths)
    return np.repeat(starts - (ends - lengths), lengths) + np.arange(lengths.sum())


def peak_memory_mb(settings: Path, project: Project, sequence: str, count: int) -> float:
    """Peak resident memory of the joint stage on ``count`` frames, in a separate process.

    Raises UserError if the stage fails.
    """
    with tempfile.TemporaryDirectory(dir=project.results) as folder:
        for stage in STAGES["joint"].reads:
            source = project.artefact(sequence, stage)
            lengthen(source, stage, Path(folder) / f"{stage}.h5", count)
        row = run_apart(settings, "joint", Path(folder), count)
    if row is None:
        raise UserError(
            f"{sequence}: the joint stage failed on {count} frames; see the lines above"
        )
    return row.mb


def peak_mb() -> float:
    """Peak resident memory of this process, megabytes; getrusage would include the parent's."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (peak,) = (line.split()[1] for line in lines if line.startswith("VmHWM:"))
    return int(peak) / MEGABYTE


class Row(NamedTuple):
    """Figures of one stage."""

    stage: str
    frames: int
    seconds: float
    """Seconds of CPU."""
    mb: float
    """Peak resident memory, megabytes."""


def run_apart(settings: Path, stage: str, folder: Path, frames: int) -> Row | None:
    """Row of a stage that runs in a separate process on the artefacts in ``folder``."""
    done = subprocess.run(
        [sys.executable, "-m", "bench.stage_resources", str(settings), "--stage", stage,
         "--folder", str(folder), "--frames", str(frames)],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    if done.returncode:
        return None
    seconds, mb = done.stdout.splitlines()[-1].split()
    return Row(stage, frames, float(seconds), float(mb))


def measure(settings: Path, frames: int, stages: Sequence[str]) -> list[Row]:
    """Print and return the rows of ``stages``, which read artefacts, on ``frames`` frames."""
    project = load_project(settings)
    sequence = next(iter(project.sequences))
    rows = []
    with tempfile.TemporaryDirectory(dir=project.results) as folder:
        made = {name for stage in stages for name in STAGES[stage].reads}
        for stage in (name for name in STAGES if name in made):
            source = project.artefact(sequence, stage)
            lengthen(source, stage, Path(folder) / f"{stage}.h5", frames)
        for stage in stages:
            row = run_apart(settings, stage, Path(folder), frames)
            if row is None:
                print(f"{stage} failed", flush=True)
                continue
            print(f"{stage}\t{frames}\t{row.seconds:.1f} s\t{row.mb:.0f} MB", flush=True)
            rows.append(row)
    return rows


def print_laws(rows: Sequence[Row]) -> None:
    """Print the law of each stage by its two greatest lengths, and what follows for a long one."""
    largest: dict[str, float] = {}
    for stage in dict.fromkeys(row.stage for row in rows):
        own = sorted((row for row in rows if row.stage == stage), key=lambda row: row.frames)[-2:]
        if len(own) < 2:
            continue
        low, high = own
        count = high.frames - low.frames
        per_frame, each = (high.mb - low.mb) / count, (high.seconds - low.seconds) / count
        print(
            f"{stage}: {high.mb - per_frame * high.frames:.0f} MB + {per_frame:.3f} MB a frame, "
            f"{high.seconds - each * high.frames:.0f} s + {each:.3f} s a frame"
        )
        largest[stage] = high.mb + per_frame * (LONG_RECORDING - high.frames)
    if largest:
        stage = max(largest, key=largest.__getitem__)
        print(
            f"scale.long_recording_mb {largest[stage]:.0f} ({stage}; {LONG_RECORDING} frames, "
            f"extrapolated from {max(row.frames for row in rows)})"
        )


def run(settings: Path, stage: str, folder: Path, frames: int) -> None:
    """Run one stage on a folder's artefacts and print CPU seconds and peak megabytes."""
    project = load_project(settings)
    inputs = {name: folder / f"{name}.h5" for name in STAGES[stage].reads}
    output = folder / f"{stage}.new"
    run_step(stage, project, next(iter(project.sequences)), inputs=inputs, output=output)
    print(f"{time.process_time():.2f} {peak_mb():.1f}", flush=True)


def _main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("settings", type=Path, nargs="?", default=Path("config/bench/config.yaml"))
    parser.add_argument("--frames", type=int, nargs="+", default=[45, 300])
    parser.add_argument("--stages", nargs="+", choices=FROM_ARTEFACTS, default=FROM_ARTEFACTS)
    parser.add_argument("--stage", help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.stage:
        run(given.settings, given.stage, given.folder, given.frames[0])
        return
    print_laws([row for n in given.frames for row in measure(given.settings, n, given.stages)])


if __name__ == "__main__":
    _main()
