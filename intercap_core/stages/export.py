"""Stage ``export``: the joint result in the file formats of other tools."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.config import ExportSettings
from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.export import (
    body_files,
    bop,
    coco,
    contact,
    glb,
    images,
    meshes,
    parameters,
)
from intercap_core.output.export.about import About, Deviations, ExportBody, Verdict
from intercap_core.output.export.contact import ContactVertices, StatedContact
from intercap_core.output.export.motion import Coordinates, Motion, read_motion, z_up_frame
from intercap_core.output.export.readme import NEED_OBJECT, readme
from intercap_core.output.export.silhouettes import Scenes, body_vertices
from intercap_core.schemas import JOINT, SCENE
from intercap_core.sequence_inputs import SequenceModels, SequencePaths
from intercap_core.stage_list import STAGES

log = logging.getLogger(__name__)

MARKER = STAGES["export"].folder_marker
_IMAGE_FORMATS = {"bop", "coco"}  # formats that annotate images
_BODY_FORMATS = {"intercap", "amass"}  # formats of parameters, which need the body model
_NO_FRAME = "none: numbers of vertices and regions, distances in metres"


def run(
    *,
    paths: SequencePaths,
    models: SequenceModels,
    settings: ExportSettings,
    output: Path,
) -> None:
    """Write the formats of the settings into the new folder ``output``.

    README.txt lists the errors from the metrics, and the formats that are omitted because no object
    was found.

    Raises UserError if an artefact or the object's mesh is missing or broken, or if the metrics
    were measured on another joint result.
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
    mesh = None
    if models.object_ is not None:
        mesh = ObjectMesh.load(models.object_)
    if not motion.has_object:
        mesh = None
    z_up = settings.frame == "z-up"
    viewed = motion.moved(zup_from_master, z_up_name) if z_up else motion
    requested = sorted(set(settings.formats))
    formats = [name for name in requested if mesh is not None or name not in NEED_OBJECT]
    for name in set(requested) - set(formats):
        log.info("sequence %s: there is no object, so %s is not exported", motion.sequence, name)
    about = _about(paths, motion, mesh)
    posed = set(formats) & (_IMAGE_FORMATS | {"meshes"})
    bodies = body_vertices(motion, output.parent) if posed else ()
    exported = images.undistorted(rig) if settings.undistort else rig
    scenes = Scenes(motion, exported, mesh, image_of, times, time_offset, bodies)
    output.mkdir(parents=True)
    if set(formats) & _IMAGE_FORMATS:
        with Frames.open(paths.frames) as frames:
            names = images.name_images(frames, scenes)
            if settings.images or settings.undistort:
                images.write(output, frames, rig, scenes, names, formats)
    for name in formats:
        if name == "intercap":
            (output / "intercap").mkdir()
            parameters.write_intercap(output / "intercap" / "res.pkl", motion, about)
        elif name == "amass":
            parameters.write_amass(output / "amass", viewed, about)
        elif name == "bop" and models.object_ is not None:
            number = bop.object_id(models.object_.mesh)
            bop.write(output / "bop", scenes, number, about, masks=settings.masks)
        elif name == "coco":
            coco.write(output / "coco" / "annotations.json", scenes, about, names)
        elif name == "contact" and about.contact is not None and about.touching is not None:
            contact.write(output / "contact", about.contact, about.touching)
        elif name == "meshes":
            viewed_from_master = zup_from_master if z_up else np.eye(4)
            placed = (apply(viewed_from_master, b) for b in bodies[:: settings.mesh_every])
            meshes.write(
                output / "meshes", viewed, placed, mesh, about,
                kind=settings.mesh_format, every=settings.mesh_every,
            )  # fmt: skip
        elif name == "glb":
            (output / "glb").mkdir()
            glb.write(output / "glb" / f"{motion.sequence}.glb", viewed, mesh, about, z_up=z_up)
    files: dict[str, dict[str, str]] = {}
    if set(formats) & _BODY_FORMATS:
        files = body_files.write(output / "body", about.body)
    if about.verdict.stated:
        summary = {"sequence": motion.sequence, **about.verdict.summary()}
        _dump(output / "verdict.json", summary)
    text = readme(motion, viewed, mesh, requested, about, files, settings)
    (output / "README.txt").write_text(text, encoding="utf-8")
    coordinates = {
        **dict.fromkeys(("amass", "meshes"), Coordinates.of(viewed)),
        "intercap": Coordinates.of(motion),
        "bop": Coordinates.of(motion, bop.UNITS),
        "coco": Coordinates.of(motion, coco.units(scenes)),
        "glb": glb.coordinates(viewed, z_up=z_up),
        "contact": Coordinates(_NO_FRAME, np.full(3, np.nan)),
    }
    _write_manifest(output, motion, formats, about, coordinates, files)


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
        None if motion.made_by else Deviations.read(paths.body_fit, paths.object_track, motion),
        motion.made_by,
        measured.has_truth,
    )


def _write_manifest(
    output: Path,
    motion: Motion,
    formats: Sequence[str],
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
        "formats": list(formats),
        "frame": {name: own.frame for name, own in coordinates.items()},
        "up": {name: own.to_json()["up"] for name, own in coordinates.items()},
        "up_axis": {name: own.up_axis for name, own in coordinates.items()},
        "units": {name: own.units for name, own in coordinates.items()},
        "body": about.body.to_json(),
        "body_files": body,
        **about.verdict.to_json(),
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
