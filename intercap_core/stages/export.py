"""The joint result as files that other people's tools load."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.camera.rig import Rig
from intercap_core.capture.frames import Frames
from intercap_core.config import BodyModels, ExportSettings, ObjectEntry, SubjectEntry
from intercap_core.export import amass, bop, coco, contact, glb, intercap
from intercap_core.export.about import About, BodyFile
from intercap_core.export.motion import Motion, read_motion
from intercap_core.export.readme import needs_object, readme
from intercap_core.export.silhouettes import Exposures, body_vertices, object_poses
from intercap_core.export.upright import z_up_frame
from intercap_core.metrics.figures import SequenceMetrics
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.schemas import JOINT, SCENE
from intercap_core.stages.folders import check_replaceable, replaced

log = logging.getLogger(__name__)

MANIFEST = "export.json"
_OF_IMAGES = {"bop", "coco"}  # formats that say what is in each image
_OF_BODIES = {"intercap", "amass"}  # formats of parameters, which say nothing without the mesh


def run(
    *,
    frames: Path,
    joint: Path,
    scene: Path,
    metrics: Path,
    object_: ObjectEntry | None,
    subject: SubjectEntry,
    body_models: BodyModels,
    settings: ExportSettings,
    output: Path,
) -> None:
    """Write the chosen formats into the folder ``output``, replacing an earlier export there.

    The folder appears whole or not at all: it is filled under a temporary name beside its own, and
    an earlier export goes only when the new one is complete. README.txt says what ``metrics``
    state of the errors, and what is left out without an object (``object_`` is None, or it was
    found in no frame). Raises UserError where an artefact or the object's mesh is missing or
    broken, and where ``output`` holds anything but an export.
    """
    output = Path(output)
    check_replaceable(output, marker=MANIFEST, what="export")
    mesh = None if object_ is None else ObjectMesh.load(object_)
    with artefacts.read(scene, SCENE) as setting:
        given = Rig.from_artefact(setting)
        zup_from_master, upright = setting["zup_from_master"], z_up_frame(setting)
        image_of, times = setting["image_of"], setting["times"]
        fps = float(setting.attributes["fps"])
    with artefacts.read(joint, JOINT) as fit:
        rig = given.moved(fit["master_from_colour"])
        exposures = Exposures(image_of, times, fit["time_offset"])
    motion = read_motion(joint, fps, body_models, subject.gender)
    if not motion.has_object:
        mesh = None
    z_up = settings.frame == "z-up"
    viewed = motion.moved(zup_from_master, upright) if z_up else motion
    named = sorted(set(settings.formats))
    formats = [name for name in named if mesh is not None or not needs_object(name)]
    for name in set(named) - set(formats):
        log.info("sequence %s: there is no object, so %s is not exported", motion.sequence, name)
    stated_contact = contact.StatedContact.read(joint)
    about = About.read(
        SequenceMetrics.read(metrics),
        BodyFile.of(motion.model, motion.gender),
        None if mesh is None else stated_contact,
    )
    bodies = body_vertices(motion) if set(formats) & _OF_IMAGES else np.zeros((0, 0, 3))
    poses = list(object_poses(motion, rig, exposures))
    with replaced(output) as folder:
        for name in formats:
            if name == "intercap":
                (folder / "intercap").mkdir()
                intercap.write(folder / "intercap" / "res.pkl", motion, about)
            elif name == "amass":
                amass.write(folder / "amass", viewed, about)
            elif name == "bop" and object_ is not None and mesh is not None:
                number = bop.object_id(object_.mesh)
                bop.write(
                    folder / "bop", motion, rig, mesh, number, exposures, about,
                    bodies if settings.masks else None, poses,
                )  # fmt: skip
            elif name == "coco":
                coco.write(
                    folder / "coco" / "annotations.json", motion, rig, mesh, exposures, about,
                    bodies, poses,
                )  # fmt: skip
            elif name == "contact":
                contact.write(folder / "contact", stated_contact)
            else:
                (folder / "glb").mkdir()
                glb.write(folder / "glb" / f"{motion.sequence}.glb", viewed, mesh, about, z_up=z_up)
        if about.body.is_open and set(formats) & _OF_BODIES:
            (folder / "body").mkdir()
            shutil.copyfile(about.body.path, folder / "body" / about.body.path.name)
        if settings.images and set(formats) & _OF_IMAGES:
            _copy_images(folder, frames, rig, exposures, formats)
        text = readme(motion, viewed, mesh, named, about)
        (folder / "README.txt").write_text(text, encoding="utf-8")
        _write_manifest(folder, motion, viewed, formats, about)


def _copy_images(
    folder: Path, frames: Path, rig: Rig, exposures: Exposures, formats: Sequence[str]
) -> None:
    """Copy the recorded colour images that show a frame to where the formats look for them."""
    with Frames.open(frames) as recorded:
        for c, camera in enumerate(rig):
            for image in sorted({int(i) for i in exposures.image_of[:, c] if i >= 0}):
                packet = recorded.colour_jpeg(image, c)
                if packet is None:
                    continue
                kind = "png" if packet.startswith(b"\x89PNG") else "jpg"
                places = {
                    "bop": folder / "bop" / "scenes" / f"{c:06d}" / "rgb",
                    "coco": folder / "coco" / camera.name,
                }
                for name in places.keys() & set(formats):
                    places[name].mkdir(exist_ok=True)
                    (places[name] / f"{image:06d}.{kind}").write_bytes(packet)


def _write_manifest(
    output: Path,
    motion: Motion,
    viewed: Motion,
    formats: Sequence[str],
    about: About,
) -> None:
    files = sorted(path for path in output.rglob("*") if path.is_file())
    content: dict[str, Any] = {
        "sequence": motion.sequence,
        "subject": motion.subject,
        "object": motion.object_,
        "gender": motion.gender,
        "frames": len(motion),
        "fps": motion.fps,
        "formats": list(formats),
        "frame": {
            **dict.fromkeys(("intercap", "bop", "coco"), motion.frame),
            "amass": viewed.frame,
            "glb": "y-up, turned by the root node from: " + viewed.frame,
        },
        "body": about.body.told(),
        "stated_error_mm": about.told("")["stated_error_mm"],
        "files": {
            path.relative_to(output).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in files
        },
    }  # fmt: skip
    text = json.dumps(content, indent=1, sort_keys=True) + "\n"
    part = output / f".{MANIFEST}.part"
    part.write_text(text, encoding="utf-8")
    part.replace(output / MANIFEST)
