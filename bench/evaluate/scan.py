"""Part ``scan`` of `intercap dev evaluate`: meshes by `intercap scan` compared with the true ones.

The script decides how a recording is scanned (``WAYS``). In the other recordings of an object that
a person turned, it is tracked twice: with the mesh of objects.yaml and with the scanned one. If
both have the same seed, the true objects are equal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from bench.evaluate import track_errors
from bench.evaluate.part import (
    EvaluationPart,
    Figures,
    Measured,
    config_files,
    grouped,
    keyed,
    truth_of,
    with_spread,
)
from bench.evaluate.scan_errors import (
    Mesh,
    ScanErrors,
    TrackErrors,
    align,
    distances,
    figures,
)
from intercap_core import artefacts
from intercap_core.commands.scan import scan
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.project import Project
from intercap_core.schemas import HAND_HELD_TRUTH, TRUTH
from intercap_core.stages import object_track

AREA = "scan"
# How a recording is scanned, by the end of its script's name
TURNED, STILL, IMPROVED, HAND_HELD = "turned", "still", "improved", "hand_held"
WAYS = {"_scan": TURNED, "_still": STILL, "_carry": IMPROVED}


def way_of(project: Project, sequence: str) -> str:
    """How a recording is scanned; "" = it is not."""
    capture = project.captures[sequence]
    if capture.camera == HAND_HELD:
        return HAND_HELD
    script = capture.interaction
    return next((way for end, way in WAYS.items() if script.endswith(end)), "")


def last_stage(project: Project) -> str | None:
    """Stage ``body_fit``, unless the cameras are hand-held."""
    hand_held = all(capture.camera == HAND_HELD for capture in project.captures.values())
    return None if hand_held else "body_fit"


def measure(project: Project, sequence: str) -> ScanErrors:
    """Scan the object of one recording, and track a turned object in its other recordings."""
    entry, way = project.object_of(sequence), way_of(project, sequence)
    assert entry is not None  # a script with an object
    path = project.results / "scans" / f"{sequence}.ply"
    path.parent.mkdir(exist_ok=True)
    schema = HAND_HELD_TRUTH if way == HAND_HELD else TRUTH
    with artefacts.read(truth_of(project, sequence), schema) as true:
        truth = Mesh(true["object_vertices"].astype(np.float64), true["object_faces"])
    before = float("nan")
    if way == IMPROVED:
        mesh = ObjectMesh.load(entry)
        hull = trimesh.Trimesh(mesh.vertices, mesh.faces).convex_hull
        rough = path.with_name(f"{sequence}_before.ply")
        hull.export(rough)
        entry = entry.model_copy(update={"mesh": rough, "contact_vertices": None})
        project = replace(project, objects=project.objects | {entry.name: entry})
        given = Mesh(np.asarray(hull.vertices), np.asarray(hull.faces))
        before = float(np.mean(distances(given, truth)))
    try:
        found, *_ = scan(
            project, entry.name, [sequence], output=path, improve=way == IMPROVED,
            hand_held=way == HAND_HELD, replace=True,
        )  # fmt: skip
    except UserError as error:
        nothing = np.zeros(0)
        return ScanErrors(entry.name, nothing, nothing, problem=str(error), way=way)
    scanned = Mesh(found.vertices, found.faces)
    aligned = scanned.moved(align(scanned, truth))
    in_true_frame = path.with_name(f"{sequence}_aligned.ply")
    trimesh.Trimesh(aligned.vertices, aligned.faces, process=False).export(in_true_frame)
    tracks = [
        _track_errors(project, other, entry, in_true_frame)
        for other, row in project.sequences.items()
        if way == TURNED
        and row.object == entry.name
        and way_of(project, other) not in (TURNED, STILL)
    ]
    return ScanErrors(
        entry.name, *distances(aligned, truth), scanned.is_watertight, tracks=tracks,
        way=way, before=before,
    )  # fmt: skip


def _track_errors(
    project: Project, sequence: str, entry: ObjectEntry, scanned: Path
) -> TrackErrors:
    """Errors of the track with the mesh of ``entry``, and with a scanned mesh in its frame."""
    mesh, paths = ObjectMesh.load(entry), project.paths(sequence)
    errors = []
    for name, file in (("given", entry.mesh), ("scanned", scanned)):
        output = project.results / "scans" / f"{sequence}_{name}.h5"
        object_track.run(
            frames=paths.frames,
            scene=paths.scene,
            detections=paths.detections,
            person=paths.person,
            output=output,
            object_=entry.model_copy(update={"mesh": file, "contact_vertices": None}),
            settings=project.config.object_track,
        )
        found = track_errors.measure(paths.scene, output, truth_of(project, sequence), mesh)
        assert found.mssd is not None
        errors.append(found.mssd * mesh.diameter)
    return TrackErrors(*errors)


Scans = Measured[ScanErrors]


def flat(evaluations: Sequence[Scans]) -> Figures:
    """Keys ``scan.<measure>`` and ``scan.<object>.<measure>`` of objects that a person turned, and
    ``scan.<way>.<measure>`` of the others."""
    errors = [error for found in evaluations for error in found.errors]
    result: Figures = {}
    for way in dict.fromkeys([TURNED, *(error.way for error in errors)]):
        some = [error for error in errors if error.way == way]
        prefix = f"{AREA}." if way == TURNED else f"{AREA}.{way}."
        result |= keyed(prefix, with_spread(figures, some))
    for name, some in grouped([e for e in errors if e.way == TURNED], "object_").items():
        result |= keyed(f"{AREA}.{name}.", with_spread(figures, some))
    return result


PART = EvaluationPart(
    name="scan",
    stage="frames",
    settings=config_files("scan", "config", "hand_held"),
    budget_minutes=16.5,  # measured alone, on two cores without other jobs (bench/RESULTS.md)
    measure=measure,
    flat=flat,
    columns=("before_mm", "chamfer_mm", "p95_mm", "watertight_share", "object_ratio"),
    problems=lambda error: [error.problem] if error.problem else [],
    last=last_stage,
    has=lambda project, sequence: bool(way_of(project, sequence)),
)
