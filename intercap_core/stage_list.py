"""The stages of one sequence, in the order data flows: the one list of them.

The command line, the step that runs a stage, the rules and the report derive theirs from it. A
stage's ``run`` lives in ``intercap_core/stages/<name>.py``, what it calls in the room of that name.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Stage:
    """``reads`` names the stages whose artefacts it opens. ``on_device``: runs where the setting
    ``device`` says. ``estimates``: it estimates poses, which the metrics hold to the truth.
    ``writes_folder``: of other tools' files instead of an artefact.
    """

    name: str
    purpose: str
    reads: tuple[str, ...]
    on_device: bool = False
    estimates: bool = False
    writes_folder: bool = False


STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage("frames", "Recordings to synchronised frame sets.", ()),
        Stage(
            "detections",
            "Keypoints and segmentation candidates, from files or models.",
            ("frames",),
        ),
        Stage(
            "scene",
            "Refined extrinsics, ground plane and background.",
            ("frames", "detections"),
        ),
        Stage(
            "person",
            "The subject over views, and the triangulated keypoints.",
            ("frames", "detections", "scene"),
        ),
        Stage(
            "object_track",
            "The object's pose in every frame.",
            ("frames", "scene", "detections", "person"),
            estimates=True,
        ),
        Stage(
            "body_fit",
            "SMPL-X parameters in every frame.",
            ("frames", "scene", "person"),
            on_device=True,
            estimates=True,
        ),
        Stage(
            "joint",
            "Body and object together, over all frames, with contact.",
            ("frames", "scene", "detections", "person", "object_track", "body_fit"),
            on_device=True,
            estimates=True,
        ),
        Stage(
            "metrics",
            "Distances, penetration, and errors against truth where it is known.",
            ("frames", "scene", "detections", "person", "object_track", "body_fit", "joint"),
        ),
        Stage(
            "summary",
            "What the sequence adds to the dataset's tables, heatmaps and charts.",
            (
                "frames",
                "detections",
                "scene",
                "person",
                "object_track",
                "body_fit",
                "joint",
                "metrics",
            ),
        ),
        Stage(
            "page",
            "The sequence's page of the site.",
            (
                "frames",
                "detections",
                "scene",
                "person",
                "object_track",
                "body_fit",
                "joint",
                "metrics",
            ),
            writes_folder=True,
        ),
        Stage(
            "export",
            "Files for other tools: InterCap, AMASS, BOP, COCO, glb, meshes.",
            ("frames", "joint", "scene", "metrics", "body_fit", "object_track"),
            writes_folder=True,
        ),
    )
}
SEQUENCE_STAGES = tuple(name for name, stage in STAGES.items() if not stage.writes_folder)
ESTIMATES = tuple(name for name, stage in STAGES.items() if stage.estimates)
