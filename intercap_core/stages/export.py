"""Stage ``export``: the joint result in the file formats of other tools."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from intercap_core import artefacts
from intercap_core.config import ExportSettings
from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.export import body_files, images
from intercap_core.output.export.about import About, ExportBody, Physics, Verdict, read_deviations
from intercap_core.output.export.contact import ContactVertices, StatedContact
from intercap_core.output.export.format import Content
from intercap_core.output.export.motion import Coordinates, Motion, read_motion, z_up_frame
from intercap_core.output.export.readme import readme
from intercap_core.output.export.registry import formats
from intercap_core.output.export.silhouettes import Scenes, body_vertices
from intercap_core.schemas import JOINT, SCENE
from intercap_core.sequence_inputs import SequenceModels, SequencePaths
from intercap_core.stage_list import STAGES

log = logging.getLogger(__name__)

MARKER = STAGES["export"].folder_marker


def run(
    *, paths: SequencePaths, models: SequenceModels, settings: ExportSettings, output: Path
) -> None:
    """Write the formats of the settings into the new folder ``output``.

    README.txt lists the errors from the metrics, and the formats that are omitted because no object
    was found.

    Raises UserError if an artefact, the object's mesh or a format's library is missing or broken,
    or if the metrics were measured on another joint result.
    """
    with artefacts.read(paths.scene, SCENE) as scene:
        rig = Rig.from_artefact(scene)
        zup_from_master, z_up_name = scene["zup_from_master"], z_up_frame(scene)
        image_of, times = scene["image_of"], scene["times"]
        fps = float(scene.attributes["fps"])
    with artefacts.read(paths.joint, JOINT) as fit:
        rig = rig.moved(fit["master_from_colour"])
        time_offset = fit["time_offset"]
    motion = read_motion(paths.joint, fps, models.body_models, models.gender, zup_from_master)
    object_ = models.object_ if motion.has_object else None
    mesh = ObjectMesh.load(object_) if object_ is not None else None
    requested = [formats()[name] for name in sorted(set(settings.formats))]
    for format_ in requested:
        format_.require_library()
    written = [format_ for format_ in requested if mesh is not None or not format_.needs_object]
    for format_ in requested:
        if format_ not in written:
            log.info(
                "sequence %s: there is no object, so %s is not exported",
                motion.sequence, format_.name,
            )  # fmt: skip
    draws_bodies = any(format_.draws_bodies for format_ in written)
    bodies = body_vertices(motion, output.parent) if draws_bodies else ()
    exported = images.undistorted(rig) if settings.undistort else rig
    content = Content(
        motion=motion,
        zup_from_master=zup_from_master,
        z_up=motion.moved(zup_from_master, z_up_name),
        settings=settings,
        about=_about(paths, motion, mesh),
        scenes=Scenes(motion, exported, mesh, image_of, times, time_offset, bodies),
        recorded=rig,
        object_=object_,
    )
    output.mkdir(parents=True)
    coordinates = {}
    with contextlib.ExitStack() as stack:
        if any(format_.reads_images for format_ in written):
            frames = stack.enter_context(Frames.open(paths.frames))
            names = images.name_images(frames, content.scenes)
            content = replace(content, frames=frames, image_names=names)
            if settings.images or settings.undistort:
                images.write(output, content, [format_.name for format_ in written])
        for format_ in written:
            folder = output / format_.name
            folder.mkdir(exist_ok=True)
            coordinates[format_.name] = format_.write(folder, content)
    about = content.about
    files: dict[str, dict[str, str]] = {}
    if any(format_.holds_parameters for format_ in written):
        files = body_files.write(output / "body", about.body)
    if about.verdict.stated:
        summary = {"sequence": motion.sequence, **about.verdict.summary()}
        _dump(output / "verdict.json", summary)
    text = readme(content, requested, files)
    (output / "README.txt").write_text(text, encoding="utf-8")
    _write_manifest(output, motion, about, coordinates, files)


def _about(paths: SequencePaths, motion: Motion, mesh: ObjectMesh | None) -> About:
    """Read the errors, flags and contact that the exported files document.

    Imported results have no standard deviations.
    """
    measured = SequenceMetrics.read(paths.metrics)
    if len(measured) != len(motion):
        raise UserError(
            f"{paths.metrics}: holds {len(measured)} frames, but the joint result of sequence "
            f"{motion.sequence!r} has {len(motion)}: it was measured on another result; re-run "
            "stage 'metrics'"
        )
    return About(
        motion.sequence,
        ExportBody.of(motion.model, motion.gender),
        measured.flags,
        None if mesh is None else StatedContact.read(paths.joint),
        Verdict.of(measured),
        None if mesh is None else ContactVertices.read(paths.metrics, motion, mesh),
        {} if motion.made_by else read_deviations(paths.body_fit, paths.object_track, motion),
        None if mesh is None else Physics.of(measured),
        motion.made_by,
        measured.has_truth,
    )


def _write_manifest(
    output: Path,
    motion: Motion,
    about: About,
    coordinates: Mapping[str, Coordinates],
    body: Mapping[str, Mapping[str, str]],
) -> None:
    """Write the manifest (MARKER) with the checksums of all other files of the export."""
    files = sorted(path for path in output.rglob("*") if path.is_file())
    content: dict[str, Any] = {
        "sequence": motion.sequence,
        "subject": motion.subject,
        "object": motion.object_,
        "gender": motion.gender,
        "frames": len(motion),
        "fps": motion.fps,
        "formats": list(coordinates),
        "frame": {name: own.frame for name, own in coordinates.items()},
        "up": {name: own.to_json()["up"] for name, own in coordinates.items()},
        "up_axis": {name: own.up_axis for name, own in coordinates.items()},
        "units": {name: own.units for name, own in coordinates.items()},
        "body": about.body.to_json(),
        "body_files": body,
        **about.verdict.to_json(),
        **({} if about.physics is None else about.physics.to_json()),
        "files": {
            path.relative_to(output).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in files
        },
    }
    part = output / f".{MARKER}.part"
    _dump(part, content)
    part.replace(output / MARKER)


def _dump(path: Path, content: Mapping[str, Any]) -> None:
    text = json.dumps(content, indent=1, sort_keys=True) + "\n"
    path.write_text(text, encoding="utf-8")
