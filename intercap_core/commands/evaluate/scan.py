"""Part ``scan`` of `intercap dev evaluate`: meshes by `intercap scan` compared with the true ones.

Recordings with a script whose name ends in ``_scan`` are scanned. In the other recordings of a
scanned object, it is tracked twice: with the mesh of objects.yaml and with the scanned one. If both
have the same seed, the true objects are equal.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

from intercap_core import artefacts
from intercap_core.commands.console import ListTable, standard_console
from intercap_core.commands.evaluate.part import (
    EvaluationPart,
    Figures,
    Measured,
    config_files,
    keyed,
    number,
    truth_of,
    with_spread,
)
from intercap_core.commands.scan import scan
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.evaluation import object_errors
from intercap_core.evaluation.scan_errors import (
    Mesh,
    ScanErrors,
    TrackErrors,
    align,
    distances,
    figures,
)
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.project import Project
from intercap_core.schemas import TRUTH
from intercap_core.stages import object_track

AREA, SCRIPTS = "scan", "_scan"


def is_scanned(project: Project, sequence: str) -> bool:
    """Whether the object of a recording is scanned."""
    return project.captures[sequence].interaction.endswith(SCRIPTS)


def measure(project: Project, sequence: str) -> ScanErrors:
    """Scan the object of one recording, and track it in its other recordings."""
    entry = project.object_of(sequence)
    assert entry is not None  # a script that turns an object
    path = project.results / "scans" / f"{sequence}.ply"
    path.parent.mkdir(exist_ok=True)
    try:
        found, *_ = scan(project, entry.name, [sequence], output=path, replace=True)
    except UserError as error:
        nothing = np.zeros(0)
        return ScanErrors(sequence, entry.name, nothing, nothing, problem=str(error))
    with artefacts.read(truth_of(project, sequence), TRUTH) as true:
        truth = Mesh(true["object_vertices"].astype(np.float64), true["object_faces"])
    scanned = Mesh(found.vertices, found.faces)
    aligned = scanned.moved(align(scanned, truth))
    in_true_frame = path.with_name(f"{sequence}_aligned.ply")
    trimesh.Trimesh(aligned.vertices, aligned.faces, process=False).export(in_true_frame)
    tracks = [
        _track_errors(project, other, entry, in_true_frame)
        for other, row in project.sequences.items()
        if row.object == entry.name and not is_scanned(project, other)
    ]
    return ScanErrors(
        sequence, entry.name, *distances(aligned, truth), scanned.is_watertight, tracks=tracks
    )


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
        found = object_errors.measure(paths.scene, output, truth_of(project, sequence), mesh)
        assert found.mssd is not None
        errors.append(found.mssd * mesh.diameter)
    return TrackErrors(sequence, *errors)


Scans = Measured[ScanErrors]


def by_object(errors: Sequence[ScanErrors]) -> dict[str, list[ScanErrors]]:
    """The scans of each object, by name."""
    names = sorted({e.object_ for e in errors})
    return {name: [e for e in errors if e.object_ == name] for name in names}


def flat(evaluations: Sequence[Scans]) -> Figures:
    """Keys ``scan.<measure>`` and ``scan.<object>.<measure>``."""
    errors = [error for found in evaluations for error in found.errors]
    result = keyed(f"{AREA}.", with_spread(figures, errors))
    for name, some in by_object(errors).items():
        result |= keyed(f"{AREA}.{name}.", with_spread(figures, some))
    return result


def print_scans(evaluations: Sequence[Scans]) -> None:
    """Print a table with a row per scan."""
    console = standard_console()
    table = ListTable(
        "object", "chamfer mm", "p95 mm", "watertight", "track ratio", "", title="scanned meshes"
    )
    for found in evaluations:
        for error in sorted(found.errors, key=lambda e: e.object_):
            values = figures([error])
            closed = "yes" if error.watertight else "no"
            table.add_row(
                error.object_,
                number(values.get("chamfer_mm"), 2),
                number(values.get("p95_mm"), 2),
                closed if len(error.to_truth) else "",
                number(values.get("object_ratio"), 2),
                error.problem,
            )
    console.print(table)


PART = EvaluationPart(
    name="scan",
    stage="body_fit",
    settings=config_files("scan", "config"),
    budget_minutes=10.0,
    measure=measure,
    flat=flat,
    print_tables=print_scans,
    has=is_scanned,
)
