"""What a job of the workflow asks of a scheduler: memory and time, by how much there is to compute.

Peak and seconds of a stage are straight lines in frames and images (frames times cameras) through
what ``python -m bench.stage_resources`` measures: 45 and 300 frames of six 1080p cameras, 45 of
three. What is asked for is more: Snakemake's own process, a margin, and that times the attempt.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

from intercap_core import artefacts
from intercap_core.project import Project
from intercap_core.schemas import FRAMES

SNAKEMAKE_MB = 300.0  # the process that starts the stage and waits for it: 230 measured
MEMORY_MARGIN = 1.4  # recordings differ in how much moves; bench and demo differ by less
TIME_MARGIN = 5.0  # a busy node, a slow file system
LEAST_MINUTES = 10
CUDA_MB = 3000.0  # of the driver and the libraries, in a process that uses a GPU
MODEL_MB, MODEL_SECONDS = 3000.0, 2.0  # of a detector, and for an image on 8 cores
READ_MB_PER_SECOND = 40.0  # of recordings, decoded, on one core: half of what was measured


@dataclass(frozen=True)
class Extent:
    """How long a sequence is: synchronised frame sets, and cameras."""

    frames: int
    cameras: int

    @property
    def images(self) -> int:
        return self.frames * self.cameras


# Before anything is known of a recording; only a dry run shows requests that are made of it.
UNKNOWN = Extent(1000, 6)


@dataclass(frozen=True)
class Need:
    """Peak memory, megabytes, and seconds of a stage, as lines in frames and images."""

    mb: float
    mb_per_frame: float = 0.0
    mb_per_image: float = 0.0
    seconds: float = 10.0
    seconds_per_image: float = 0.0

    def megabytes(self, extent: Extent) -> float:
        return self.mb + self.mb_per_frame * extent.frames + self.mb_per_image * extent.images

    def time(self, extent: Extent) -> float:
        return self.seconds + self.seconds_per_image * extent.images


NEEDS = {
    "studio": Need(850, mb_per_image=0.9, seconds=30, seconds_per_image=0.25),
    "frames": Need(160, seconds=5, seconds_per_image=0.01),
    "detections": Need(140, mb_per_image=0.03, seconds=5, seconds_per_image=0.01),
    "scene": Need(400, mb_per_image=0.09, seconds=10, seconds_per_image=0.03),
    "person": Need(420, mb_per_image=0.05, seconds=10, seconds_per_image=0.02),
    "object_track": Need(420, mb_per_image=0.47, seconds=10, seconds_per_image=0.06),
    "body_fit": Need(560, mb_per_image=0.4, seconds=15, seconds_per_image=0.06),
    "joint": Need(800, mb_per_frame=3.7, seconds=20, seconds_per_image=0.06),
    "metrics": Need(750, mb_per_image=0.9, seconds=15, seconds_per_image=0.06),
    "summary": Need(370, mb_per_image=0.02, seconds=10),
    "page": Need(620, mb_per_image=0.3, seconds=20, seconds_per_image=0.03),
    "export": Need(600, mb_per_image=0.05, seconds=20, seconds_per_image=0.02),
    "dataset": Need(2000, seconds=300),
    "annotation": Need(200),
}


def extent_of(project: Project, sequence: str) -> Extent:
    """Frame sets and cameras of a sequence: of its frames artefact, else as the settings of the
    studio say, else those of a long recording."""
    frames = project.artefact(sequence, "frames")
    with contextlib.suppress(artefacts.Unreadable), artefacts.read(frames, FRAMES) as source:
        count, cameras = source.describe("colour_index")[0]
        return Extent(count, cameras)
    studio = project.config.studio
    if studio is not None and sequence in studio.captures:
        return Extent(studio.captures[sequence].frames, studio.cameras)
    return UNKNOWN


def recorded_mb(recordings: Path) -> float:
    """Megabytes of the recordings' files; 0 where they are folders of images, which to add up for
    hundreds of sequences would take minutes."""
    files = recordings.glob("*.mkv") if recordings.is_dir() else ()
    return sum(path.stat().st_size for path in files) / 1e6


def memory_mb(project: Project, rule: str, extent: Extent, attempt: int = 1) -> int:
    """Megabytes that a job asks for; more with every attempt."""
    needed = NEEDS[rule].megabytes(extent) * MEMORY_MARGIN + SNAKEMAKE_MB
    if on_gpu(project, rule):
        needed += CUDA_MB
    if rule == "detections" and has_model(project):
        needed += MODEL_MB
    return attempt * round(needed * _scale(project.config.cluster.memory_scale, rule))


def minutes(
    project: Project, rule: str, extent: Extent, attempt: int = 1, *, read_mb: float = 0.0
) -> int:
    """Minutes that a job asks for, which reads so many megabytes of recordings; more with every
    attempt."""
    seconds = NEEDS[rule].time(extent) + read_mb / READ_MB_PER_SECOND
    if rule == "detections" and has_model(project):
        seconds += MODEL_SECONDS * extent.images
    asked = LEAST_MINUTES + seconds * TIME_MARGIN / 60
    return attempt * round(asked * _scale(project.config.cluster.time_scale, rule))


def has_model(project: Project) -> bool:
    """Whether a detector runs, instead of files being read."""
    settings = project.config.detections
    return bool(settings.segmentation_model or settings.keypoint_model)


def on_gpu(project: Project, rule: str) -> bool:
    """Whether the settings have a rule's jobs run on a GPU."""
    config = project.config
    if rule in ("body_fit", "joint"):
        return config.device == "cuda"
    if rule == "object_track":
        return config.object_track.render_on == "cuda"
    given = config.detections
    models = (
        (given.segmentation_model, given.segmentation_device),
        (given.keypoint_model, given.keypoint_device),
    )
    return rule == "detections" and any(model and on == "cuda" for model, on in models)


def _scale(scales: dict[str, float], rule: str) -> float:
    return scales.get(rule, scales.get("all", 1.0))
