"""Seconds and peak memory of every stage at several sequence lengths and numbers of cameras.

    python -m bench.stage_resources config/bench/config.yaml --frames 45 300 1000
    python -m bench.stage_resources config/bench/config.yaml --cameras 2 3 6 12

The first sequence of the project, which must be computed, is extended to each length. Each stage
runs in a separate process and prints one row: stage, cameras, frames, CPU seconds and peak memory.
From the two greatest lengths follow the law of each stage, linear in the frames and never
decreasing, and ``scale.long_recording_mb``: the largest peak of a recording of 10 minutes at 30
frames per second by these laws. The largest measured peak is its lower bound. For stages that work
in windows (``JobResources.window``), choose lengths with full windows, such as 1200 and 2400.
Measure twice after a change of the code: the first run compiles kernels, which adds time and up to
310 MB. The resource needs of the stages (``Stage.resources`` in ``intercap_core.stage_list``) are
derived from these figures.

With ``--cameras``, the studio makes the first recording with each number of cameras, in
``results/<dataset>/cameras_<number>``. All stages up to the last of ``--stages`` are measured on it
in order, at its own length. With ``--frames`` as well, these recordings, which must then have been
measured before, are extended to each length.

A recording is repeated forward and backward, so that motion is continuous: every dataset with a
frame axis in the stage's inputs is extended. Images are not copied; the new frames refer to the
existing images. In backward frames the sign of the cameras' time offsets is wrong, so the result
is suited to measure time and memory, not errors; it has no truth.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from intercap_core import artefacts, schemas
from intercap_core.artefacts import Artefact, Writer
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.pipeline.step import run_step, run_studio
from intercap_core.project import Project, load_project
from intercap_core.stage_list import STAGES

Returned = TypeVar("Returned")
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


def load_rig(settings: Path, cameras: int) -> Project:
    """The project; if ``cameras`` > 0, with as many virtual cameras and a folder of its own.

    Raises UserError if the recordings are real.
    """
    project = load_project(settings)
    if not cameras:
        return project
    if project.config.studio is None:
        raise UserError(f"{settings}: has no studio, so --cameras cannot be chosen; leave it out")
    dataset = f"{project.config.dataset}/cameras_{cameras}"
    studio = project.config.studio.model_copy(update={"cameras": cameras})
    config = project.config.model_copy(update={"dataset": dataset, "studio": studio})
    rig = replace(project, config=config)
    rows = {name: _moved(row, project.results, rig.results) for name, row in rig.sequences.items()}
    return replace(rig, sequences=rows)


def _moved(row: SequenceEntry, source: Path, target: Path) -> SequenceEntry:
    """The row with its paths below ``source`` replaced by those below ``target``."""
    paths = {name: path for name, path in row if isinstance(path, Path)}
    return row.model_copy(
        update={
            name: target / path.relative_to(source)
            for name, path in paths.items()
            if path.is_relative_to(source)
        }
    )


def peak_mb() -> float:
    """Peak resident memory of this process, megabytes; getrusage would include the parent's."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (peak,) = (line.split()[1] for line in lines if line.startswith("VmHWM:"))
    return int(peak) / MEGABYTE


class Row(NamedTuple):
    """Figures of one stage."""

    stage: str
    cameras: int
    frames: int
    seconds: float
    """Seconds of CPU."""
    mb: float
    """Peak resident memory, megabytes."""


def run_apart(function: Callable[..., Returned], *arguments: object) -> Returned:
    """Call ``function`` in a new process, which starts like a job of the workflow."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def run_stages(
    settings: Path, stages: Sequence[str], folder: Path | None, cameras: int
) -> list[Row]:
    """Run each stage in a new process; print and return the rows of those that do not fail.

    Arguments as of :func:`run`.
    """
    rows = []
    for stage in stages:
        try:
            row = run_apart(run, settings, stage, folder, cameras)
        except Exception as error:  # the other stages are measured nevertheless
            print(f"{stage} failed: {error}", flush=True)
            continue
        rows.append(row)
        print(
            f"{stage}\t{row.cameras} cameras\t{row.frames} frames\t{row.seconds:.1f} s\t"
            f"{row.mb:.0f} MB", flush=True,
        )  # fmt: skip
    return rows


def measure(settings: Path, frames: int, stages: Sequence[str], cameras: int = 0) -> list[Row]:
    """Print and return the rows of ``stages``, which read artefacts, on ``frames`` frames.

    ``cameras`` is as in :func:`load_rig`.
    """
    project = load_rig(settings, cameras)
    sequence = next(iter(project.sequences))
    with tempfile.TemporaryDirectory(dir=project.results) as folder:
        made = {name for stage in stages for name in STAGES[stage].reads}
        for stage in (name for name in STAGES if name in made):
            source = project.artefact(sequence, stage)
            lengthen(source, stage, Path(folder) / f"{stage}.h5", frames)
        return run_stages(settings, stages, Path(folder), cameras)


def measure_rig(settings: Path, cameras: int, stages: Sequence[str]) -> list[Row]:
    """Make the recording with ``cameras`` cameras; print and return the rows of its stages.

    All stages up to the last of ``stages`` are measured.
    """
    project = load_rig(settings, cameras)
    run_studio(project, next(iter(project.sequences)))
    order = list(STAGES)
    order = order[: 1 + max(order.index(stage) for stage in stages)]
    return run_stages(settings, order, None, cameras)


class Law(NamedTuple):
    """Cost of a stage, linear in the frames."""

    at_zero: float
    per_frame: float

    @classmethod
    def fit(cls, frames: Sequence[int], costs: Sequence[float]) -> Law:
        """The line through the two greatest lengths; the largest cost if that line decreases."""
        (before, low), (last, high) = sorted(zip(frames, costs, strict=True))[-2:]
        slope = (high - low) / (last - before)
        return cls(high - slope * last, slope) if slope > 0 else cls(max(costs), 0.0)

    def at(self, frames: int) -> float:
        """Cost of ``frames`` frames."""
        return self.at_zero + self.per_frame * frames


def print_laws(rows: Sequence[Row]) -> None:
    """Print the law of each stage and rig, and what follows for a long recording."""
    long: dict[str, tuple[float, float, int]] = {}  # extrapolated MB, measured MB, at frames
    for stage, cameras in dict.fromkeys((row.stage, row.cameras) for row in rows):
        own = [row for row in rows if (row.stage, row.cameras) == (stage, cameras)]
        frames = [row.frames for row in own]
        if len(own) < 2:
            continue
        memory = Law.fit(frames, [row.mb for row in own])
        time_ = Law.fit(frames, [row.seconds for row in own])
        name = f"{stage}, {cameras} cameras"
        print(
            f"{name}: {memory.at_zero:.0f} MB + {memory.per_frame:.3f} MB a frame, "
            f"{time_.at_zero:.0f} s + {time_.per_frame:.3f} s a frame"
        )
        most = max(own, key=lambda row: row.mb)
        long[name] = max(memory.at(LONG_RECORDING), most.mb), most.mb, most.frames
    if long:
        name = max(long, key=lambda name: long[name][0])
        extrapolated, measured, frames_ = long[name]
        print(
            f"scale.long_recording_mb {extrapolated:.0f} ({name}; {LONG_RECORDING} frames, "
            f"extrapolated; measured and lower bound: {measured:.0f} at {frames_} frames)"
        )


def run(settings: Path, stage: str, folder: Path | None, cameras: int) -> Row:
    """Run one stage in this process and return its figures.

    Args:
        folder: artefacts that the stage reads; None = those of the project.
        cameras: as in :func:`load_rig`.
    """
    project = load_rig(settings, cameras)
    sequence = next(iter(project.sequences))
    if folder is None:
        run_step(stage, project, sequence)
        frames = project.artefact(sequence, "frames")
    else:
        row = project.sequences[sequence].model_copy(update={"truth": None})
        project = replace(project, sequences={sequence: row})
        inputs = {name: folder / f"{name}.h5" for name in STAGES[stage].reads}
        run_step(stage, project, sequence, inputs=inputs, output=folder / f"{stage}.new")
        frames = inputs["frames"]
    seconds, mb = time.process_time(), peak_mb()
    with artefacts.read(frames, schemas.FRAMES) as read:
        count, present = read["colour_index"].shape
    return Row(stage, present, count, seconds, mb)


def _main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("settings", type=Path, nargs="?", default=Path("config/bench/config.yaml"))
    parser.add_argument("--frames", type=int, nargs="+", default=[])
    parser.add_argument("--cameras", type=int, nargs="+", default=[])
    parser.add_argument("--stages", nargs="+", choices=FROM_ARTEFACTS, default=FROM_ARTEFACTS)
    given = parser.parse_args()
    settings, stages = given.settings, given.stages
    if given.cameras and not given.frames:
        for cameras in given.cameras:
            measure_rig(settings, cameras, stages)
    else:
        rigs = itertools.product(given.cameras or [0], given.frames or [45, 300])
        print_laws([row for c, n in rigs for row in measure(settings, n, stages, c)])


if __name__ == "__main__":
    _main()
