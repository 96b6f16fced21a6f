"""Memory and time that a job requests from a scheduler, and the disk space of a project.

The measured needs of a stage (``Stage.resources``) are raised by a margin and by the number of the
attempt, and Snakemake's own process is added.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from intercap_core import artefacts
from intercap_core.disk import describe_fault, fault_in, free_bytes
from intercap_core.errors import UserError
from intercap_core.project import Project
from intercap_core.schemas import FRAMES
from intercap_core.stage_list import STAGES, Extent, JobResources

SNAKEMAKE_MB = 300.0  # the process that starts the stage and waits for it: 230 measured
MEMORY_MARGIN = 1.4  # recordings differ in how much moves; measured recordings differ by less
TIME_MARGIN = 5.0  # a busy node, a slow file system
LEAST_MINUTES = 10  # added to every request
CUDA_MB = 3000.0  # memory of the driver and the libraries in a process that uses a GPU
MODEL_MB, MODEL_SECONDS = 3000.0, 2.0  # memory of a detector; time of an image on 8 cores
# Images in an export (settings export.images and undistort): measured for 1080p colour and a
# separate depth camera of 640x576
IMAGES_MB, IMAGES_SECONDS = 300.0, 0.3
READ_MB_PER_SECOND = 40.0  # reading and decoding on one core: half of the measured rate

# Extent assumed before a recording has been read; only dry runs show requests made from it.
UNKNOWN = Extent(1000, 6)

JOBS = {
    "studio": JobResources(850, mb_per_image=0.9, seconds=30, seconds_per_image=0.25),
    **{name: stage.resources for name, stage in STAGES.items()},
    # measured: 0.6 ms for an image with two masks, on a local disk
    "dataset": JobResources(
        2000, mb_per_frame=0.02, mb_per_image=0.002, seconds=300, seconds_per_image=0.002
    ),
    "annotation": JobResources(200),
}
"""Resources by rule of the workflow."""


def extent_of(project: Project, sequence: str) -> Extent:
    """Size of a sequence: from its frames artefact, else from the settings of the studio, else
    ``UNKNOWN``."""
    frames = project.artefact(sequence, "frames")
    with contextlib.suppress(artefacts.Unreadable), artefacts.read(frames, FRAMES) as source:
        count, cameras = source.describe("colour_index")[0]
        return Extent(count, cameras)
    studio = project.config.studio
    if studio is not None and sequence in studio.captures:
        return Extent(studio.captures[sequence].frames, studio.cameras)
    return UNKNOWN


def total_extent(extents: Iterable[Extent]) -> Extent:
    """Frames of several sequences together, and the largest number of cameras."""
    known = list(extents)
    return Extent(sum(e.frames for e in known), max((e.cameras for e in known), default=0))


def recorded_mb(recordings: Path) -> float:
    """Megabytes of the recordings' MKV files; 0 for folders of images, which take minutes to add
    up for hundreds of sequences."""
    files = recordings.glob("*.[mM][kK][vV]") if recordings.is_dir() else ()
    return sum(path.stat().st_size for path in files) / 1e6


def memory_mb(project: Project, rule: str, extent: Extent, attempt: int = 1) -> int:
    """Megabytes that a job requests; proportional to the number of the attempt."""
    needed = JOBS[rule].memory_mb(extent) * MEMORY_MARGIN + SNAKEMAKE_MB
    if on_gpu(project, rule):
        needed += CUDA_MB
    needed += _added(project, rule)[0]
    return attempt * round(needed * _scale(project.config.cluster.memory_scale, rule))


def minutes(
    project: Project,
    rules: Sequence[str],
    extent: Extent,
    attempt: int = 1,
    *,
    read_mb: float = 0.0,
) -> int:
    """Minutes that a job requests; proportional to the number of the attempt.

    Args:
        rules: entries of ``JOBS`` that the job computes one after the other.
        read_mb: megabytes of recordings that the first one reads.
    """
    scales = {rule: _scale(project.config.cluster.time_scale, rule) for rule in rules}
    seconds = scales[rules[0]] * read_mb / READ_MB_PER_SECOND
    for rule, scale in scales.items():
        added = _added(project, rule)[1] * extent.images
        seconds += scale * (JOBS[rule].time_s(extent) + added)
    return attempt * round(LEAST_MINUTES * max(scales.values()) + seconds * TIME_MARGIN / 60)


def _added(project: Project, rule: str) -> tuple[float, float]:
    """Megabytes, and seconds per image, that settings add to a rule."""
    if rule == "detections" and has_model(project):
        return MODEL_MB, MODEL_SECONDS
    if rule == "export" and has_images(project):
        return IMAGES_MB, IMAGES_SECONDS
    return 0.0, 0.0


def has_model(project: Project) -> bool:
    """Whether a detector runs, instead of files being read."""
    settings = project.config.detections
    return bool(settings.segmentation_model or settings.keypoint_model)


def has_images(project: Project) -> bool:
    """Whether exports contain images."""
    settings = project.config.export
    return settings.images or settings.undistort or "rrd" in settings.formats


def on_gpu(project: Project, rule: str) -> bool:
    """Whether the jobs of a rule run on a GPU with the project's settings: only detectors can."""
    detectors = project.config.detections
    models = (
        (detectors.segmentation_model, detectors.segmentation_device),
        (detectors.keypoint_model, detectors.keypoint_device),
    )
    return rule == "detections" and any(model and device == "cuda" for model, device in models)


def _scale(scales: dict[str, float], rule: str) -> float:
    return scales.get(rule, scales.get("all", 1.0))


@dataclass(frozen=True)
class DiskUsage:
    """Disk space of a project's results, bytes."""

    present: int
    """Size of all outputs that exist."""
    per_output: dict[str, float]
    """Mean size of the output of each stage, measured or estimated."""
    missing: float
    """Estimated size of all outputs that do not exist yet."""
    free: int
    """Free space on the disk of the results."""
    basis: str
    """Basis of the estimate in words; "" if outputs of this project were measured."""


def disk_usage(project: Project) -> DiskUsage:
    """Measure the outputs of a project and estimate the size of the missing ones."""
    sizes: dict[str, list[int]] = {stage: [] for stage in STAGES}
    missing = dict.fromkeys(STAGES, 0)
    for name in project.sequences:
        for stage in STAGES:
            path = project.artefact(name, stage)
            if path.exists():
                sizes[stage].append(_size(path))
            else:
                missing[stage] += 1
    scale, basis = _relative_size(project)
    estimated = {stage: scale * STAGES[stage].output_bytes for stage in STAGES}
    if has_images(project):
        estimated["export"] += estimated["frames"]  # about the size of the recorded images
    per_output = {
        stage: sum(known) / len(known) if known else estimated[stage]
        for stage, known in sizes.items()
    }
    return DiskUsage(
        present=sum(map(sum, sizes.values())),
        per_output=per_output,
        missing=sum(missing[stage] * per_output[stage] for stage in STAGES),
        free=free_bytes(project.results),
        basis="" if any(sizes.values()) else f" (by {basis})",
    )


@contextlib.contextmanager
def explain_disk_errors(project: Project, output: Path, stage: str = "") -> Iterator[None]:
    """Replace errors of a disk that is full, over a quota or not writable by a UserError.

    Its message says how much space an output of ``stage`` and all missing outputs need.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        fault = fault_in(error)
        if fault is None:
            raise
        words = ""
        with contextlib.suppress(OSError):  # other jobs write and remove outputs meanwhile
            usage = disk_usage(project)
            words = f"all that is missing takes about {usage.missing / 1e6:,.0f} MB"
            if stage in usage.per_output:
                size = usage.per_output[stage] / 1e6
                words = f"{stage} takes about {size:,.1f} MB here, {words}"
            words += usage.basis
        raise UserError(describe_fault(fault, output, words)) from error


def _relative_size(project: Project) -> tuple[float, str]:
    """Mean size of the sequences relative to that of ``Stage.output_bytes``, and its basis.

    The frames artefact is about as large as the recordings.
    """
    recorded = [1e6 * recorded_mb(row.recordings) for row in project.sequences.values()]
    known = [size for size in recorded if size > 0]
    if not known:
        return 1.0, "sequences of 300 frames of six cameras"
    return sum(known) / len(known) / STAGES["frames"].output_bytes, "the size of the recordings"


def _size(path: Path) -> int:
    """Bytes of a file, or of all files of a folder; several links to a file count once."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    found = [file.stat() for file in files]
    return sum({(status.st_dev, status.st_ino): status.st_size for status in found}.values())
