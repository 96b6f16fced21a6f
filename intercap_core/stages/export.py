"""The joint result as files that other people's tools load."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from intercap_core import artefacts
from intercap_core.camera.rig import Rig
from intercap_core.config import BodyModels, ExportSettings, ObjectEntry, SubjectEntry
from intercap_core.errors import UserError
from intercap_core.export import amass, bop, contact, glb, intercap
from intercap_core.export.motion import Motion, read_motion
from intercap_core.export.readme import needs_object, readme
from intercap_core.export.upright import z_up_frame
from intercap_core.metrics.figures import SequenceMetrics
from intercap_core.metrics.verdict_figures import StatedError, stated_errors
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.schemas import JOINT, SCENE

log = logging.getLogger(__name__)

MANIFEST = "export.json"


def run(
    *,
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
    _check_replaceable(output)
    mesh = None if object_ is None else ObjectMesh.load(object_)
    with artefacts.read(scene, SCENE) as setting:
        given = Rig.from_artefact(setting)
        zup_from_master, upright = setting["zup_from_master"], z_up_frame(setting)
        image_of, times = setting["image_of"], setting["times"]
        fps = float(setting.attributes["fps"])
    with artefacts.read(joint, JOINT) as fit:
        rig = given.moved(fit["master_from_colour"])
        exposures = bop.Exposures(image_of, times, fit["time_offset"])
    motion = read_motion(joint, fps, body_models, subject.gender)
    if not motion.has_object:
        mesh = None
    z_up = settings.frame == "z-up"
    viewed = motion.moved(zup_from_master, upright) if z_up else motion
    named = sorted(set(settings.formats))
    formats = [name for name in named if mesh is not None or not needs_object(name)]
    for name in set(named) - set(formats):
        log.info("sequence %s: there is no object, so %s is not exported", motion.sequence, name)
    with _replaced(output) as folder:
        for name in formats:
            if name == "intercap":
                (folder / "intercap").mkdir()
                intercap.write(folder / "intercap" / "res.pkl", motion)
            elif name == "amass":
                amass.write(folder / "amass", viewed)
            elif name == "bop" and object_ is not None and mesh is not None:
                number = bop.object_id(object_.mesh)
                bop.write(folder / "bop", motion, rig, mesh, number, exposures)
            elif name == "contact":
                contact.write(folder / "contact", contact.StatedContact.read(joint))
            else:
                (folder / "glb").mkdir()
                glb.write(folder / "glb" / f"{motion.sequence}.glb", viewed, mesh, z_up=z_up)
        stated = stated_errors(SequenceMetrics.read(metrics))
        text = readme(motion, viewed, mesh, named, stated)
        (folder / "README.txt").write_text(text, encoding="utf-8")
        _write_manifest(folder, motion, viewed, formats, stated)


def _check_replaceable(output: Path) -> None:
    if output.is_dir():
        if any(output.iterdir()) and not (output / MANIFEST).is_file():
            raise UserError(
                f"{output}: the folder is neither empty nor an earlier export (it has no "
                f"{MANIFEST}); name a new or empty folder, or clear this one yourself"
            )
    elif output.exists() or output.is_symlink():
        raise UserError(f"{output}: is a file, expected a folder to export into; name another")


@contextlib.contextmanager
def _replaced(output: Path) -> Iterator[Path]:
    """An empty folder that takes the place of ``output`` when the block ends without an error."""
    output = output.resolve()
    part = output.with_name(f".{output.name}.{os.getpid()}.part")
    old = output.with_name(f".{output.name}.{os.getpid()}.old")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    try:
        yield part
        if output.exists():
            output.rename(old)
        try:
            part.rename(output)
        except OSError:
            if old.exists():
                old.rename(output)
            raise
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _write_manifest(
    output: Path,
    motion: Motion,
    viewed: Motion,
    formats: Sequence[str],
    stated: Sequence[StatedError],
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
        "frame": {"intercap": motion.frame, "bop": motion.frame, "amass": viewed.frame,
                  "glb": "y-up, turned by the root node from: " + viewed.frame},
        "stated_error_mm": {
            error.part: {"mean": round(error.stated, 2), "factor": error.factor}
            for error in stated
            if not error.silent
        },
        "files": {
            path.relative_to(output).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in files
        },
    }  # fmt: skip
    text = json.dumps(content, indent=1, sort_keys=True) + "\n"
    part = output / f".{MANIFEST}.part"
    part.write_text(text, encoding="utf-8")
    part.replace(output / MANIFEST)
