"""The stages of one sequence, in the order in which data flows through them.

All facts about a stage are in this list. The command line, the plan of a run, the rules of the
workflow, the resources of jobs and the report read them from here. A new stage needs an entry here,
a module ``stages/<name>.py`` with a function ``run``, a schema and a section of settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Extent:
    """Size of a sequence."""

    frames: int
    """Synchronised frame sets."""
    cameras: int
    """Cameras."""

    @property
    def images(self) -> int:
        """Colour images of all cameras."""
        return self.frames * self.cameras


@dataclass(frozen=True)
class JobResources:
    """Peak memory and time of a job, linear in frames and images.

    A stage that works in windows of frames also needs memory for the images of one window.
    Measured with ``python -m bench.stage_resources`` on 45 to 1,000 frames of six 1080p cameras and
    45 frames of two, three and twelve.
    """

    mb: float
    """Peak memory independent of the recording, megabytes."""
    mb_per_frame: float = 0.0
    """Additional megabytes per frame set."""
    mb_per_image: float = 0.0
    """Additional megabytes per image."""
    window: int = 0
    """Largest number of frames of a window, with its overlap."""
    mb_per_window_image: float = 0.0
    """Additional megabytes per image of the window."""
    seconds: float = 10.0
    """Time independent of the recording, seconds."""
    seconds_per_image: float = 0.0
    """Additional seconds per image."""

    def memory_mb(self, extent: Extent) -> float:
        """Peak memory for a sequence, megabytes."""
        window = min(extent.frames, self.window) * extent.cameras
        return (
            self.mb
            + self.mb_per_frame * extent.frames
            + self.mb_per_image * extent.images
            + self.mb_per_window_image * window
        )

    def time_s(self, extent: Extent) -> float:
        """Seconds for a sequence."""
        return self.seconds + self.seconds_per_image * extent.images


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Declaration of one stage."""

    name: str
    """Name of the module, the schema, the section of settings and the artefact."""
    purpose: str
    """Sentence for the command line."""
    reads: tuple[str, ...]
    """Stages whose artefacts it opens."""
    resources: JobResources
    """Memory and time of its job."""
    output_bytes: int
    """Size of its output for 300 frame sets of six 1080p cameras, as in the demo."""
    columns: tuple[str, ...] = ()
    """Columns of the sequence's row that it reads; others are hidden from it."""
    layout_columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Further columns by the layout of the recording."""
    reuses: str = ""
    """Column that names another sequence, whose artefact of this stage it opens too; "" = none. The
    stage's ``run`` takes the path, or None if the cell is empty, by the name of the column."""
    estimates: bool = False
    """True if it estimates poses, which the metrics compare with the truth."""
    folder_marker: str = ""
    """Name of a file in the folder that it writes instead of an artefact; "" = an artefact."""

    @property
    def writes_folder(self) -> bool:
        """True if it writes a folder of other tools' files instead of an artefact."""
        return bool(self.folder_marker)


# Artefacts that the joint fit reads, and artefacts of all stages up to the metrics.
_FITS = ("frames", "scene", "detections", "person", "object_track", "body_fit")
_ALL = ("frames", "detections", "scene", "person", "object_track", "body_fit", "joint", "metrics")

STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage(
            name="frames",
            purpose="Recordings to synchronised frame sets.",
            reads=(),
            columns=(
                "layout", "recordings", "topics", "calibration", "calibration_scale",
                "calibration_up", "calibration_floor",
            ),
            resources=JobResources(160, seconds=5, seconds_per_image=0.01),
            output_bytes=750_000_000,
        ),
        Stage(
            name="detections",
            purpose="Keypoints and segmentation masks (candidates), from files or models.",
            reads=("frames",),
            columns=(
                "layout", "recordings", "calibration", "calibration_scale", "keypoints",
                "candidates",
            ),
            layout_columns={"behave": ("object",)},  # BEHAVE names its files after the object
            resources=JobResources(240, mb_per_image=0.005, seconds=5, seconds_per_image=0.01),
            output_bytes=5_000_000,
        ),
        Stage(
            name="scene",
            purpose="Refined extrinsics, ground plane and background.",
            reads=("frames", "detections"),
            reuses="rig_from",
            resources=JobResources(480, mb_per_image=0.025, seconds_per_image=0.03),
            output_bytes=2_000_000,
        ),
        Stage(
            name="person",
            purpose="The subject over views, and the triangulated keypoints.",
            reads=("frames", "detections", "scene"),
            resources=JobResources(640, mb_per_image=0.02, seconds_per_image=0.02),
            output_bytes=7_000_000,
        ),
        Stage(
            name="object_track",
            purpose="The object's pose in every frame.",
            reads=("frames", "scene", "detections", "person"),
            resources=JobResources(820, mb_per_image=0.025, seconds_per_image=0.06),
            output_bytes=200_000,
            estimates=True,
        ),
        Stage(
            name="body_fit",
            purpose="SMPL-X parameters in every frame.",
            reads=("frames", "scene", "person"),
            reuses="shape_from",
            resources=JobResources(800, mb_per_image=0.05, seconds=15, seconds_per_image=0.06),
            output_bytes=1_100_000,
            estimates=True,
        ),
        Stage(
            name="joint",
            purpose="Body and object together, over all frames, with contact.",
            reads=_FITS,
            resources=JobResources(
                690, mb_per_image=0.015, window=460, mb_per_window_image=0.5,
                seconds=20, seconds_per_image=0.06,
            ),
            output_bytes=700_000,
            estimates=True,
        ),
        Stage(
            name="metrics",
            purpose="Distances, penetration, and errors against truth where it is known.",
            reads=(*_FITS, "joint"),
            resources=JobResources(
                720, mb_per_image=0.05, window=360, mb_per_window_image=0.7,
                seconds=15, seconds_per_image=0.06,
            ),
            output_bytes=5_000_000,
        ),
        Stage(
            name="summary",
            purpose="What the sequence adds to the dataset's tables, heatmaps and charts.",
            reads=_ALL,
            columns=("intent",),
            resources=JobResources(370, mb_per_image=0.02),
            output_bytes=2_500_000,
        ),
        Stage(
            name="page",
            purpose="The sequence's page of the site.",
            reads=_ALL,
            columns=("intent",),
            resources=JobResources(
                680, mb_per_image=0.02, window=512, mb_per_window_image=0.3,
                seconds=20, seconds_per_image=0.03,
            ),
            output_bytes=15_000_000,
            folder_marker="index.html",
        ),
        Stage(
            name="export",
            purpose="Files for other tools (setting export.formats): intercap, amass, bop, coco, "
            "glb, contact, meshes, rrd (Rerun), bvh, gmr, holosoma.",
            reads=("frames", "joint", "scene", "metrics", "body_fit", "object_track"),
            resources=JobResources(600, mb_per_image=0.05, seconds=20, seconds_per_image=0.02),
            output_bytes=60_000_000,
            folder_marker="export.json",  # names the files of an export and their checksums
        ),
    )
}  # fmt: skip
SEQUENCE_STAGES = tuple(name for name, stage in STAGES.items() if not stage.writes_folder)
"""Stages that write an artefact."""
ESTIMATES = tuple(name for name, stage in STAGES.items() if stage.estimates)
"""Stages whose poses are compared with the truth."""
LEAVES = tuple(name for name in STAGES if not any(name in stage.reads for stage in STAGES.values()))
"""Stages whose output no other stage reads."""
