"""The joint result as files that other people's tools load."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from intercap_core import artefacts
from intercap_core.camera.rig import Rig
from intercap_core.config import BodyModels, ExportSettings, ObjectEntry, SubjectEntry
from intercap_core.export import amass, bop, glb, intercap
from intercap_core.export.motion import Motion, read_motion
from intercap_core.export.readme import readme
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.schemas import SCENE

MANIFEST = "export.json"
Z_UP = "z-up: gravity-aligned, ground at z = 0, metres"


def run(
    *,
    joint: Path,
    scene: Path,
    object_: ObjectEntry,
    subject: SubjectEntry,
    body_models: BodyModels,
    settings: ExportSettings,
    output: Path,
) -> None:
    """Write the chosen formats into the folder ``output``, replacing what is there.

    The manifest ``export.json`` is written last: a folder without it is not finished. Raises
    UserError where an artefact or the object's mesh is missing or broken.
    """
    mesh = ObjectMesh.load(object_)
    with artefacts.read(scene, SCENE) as setting:
        rig = Rig.from_artefact(setting)
        zup_from_master = setting["zup_from_master"]
        fps = float(setting.attributes["fps"])
    motion = read_motion(joint, fps, body_models, subject.gender)
    z_up = settings.frame == "z-up"
    viewed = motion.moved(zup_from_master, Z_UP) if z_up else motion
    if output.exists():
        shutil.rmtree(output)
    output.mkdir(parents=True)
    formats = sorted(set(settings.formats))
    for name in formats:
        if name == "intercap":
            (output / "intercap").mkdir()
            intercap.write(output / "intercap" / "res.pkl", motion)
        elif name == "amass":
            amass.write(output / "amass", viewed)
        elif name == "bop":
            bop.write(output / "bop", motion, rig, mesh, bop.object_id(object_.mesh))
        else:
            (output / "glb").mkdir()
            glb.write(output / "glb" / f"{motion.sequence}.glb", viewed, mesh, z_up=z_up)
    (output / "README.txt").write_text(readme(motion, viewed, mesh, formats), encoding="utf-8")
    _write_manifest(output, motion, viewed, formats)


def _write_manifest(output: Path, motion: Motion, viewed: Motion, formats: Sequence[str]) -> None:
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
        "files": {
            path.relative_to(output).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in files
        },
    }  # fmt: skip
    text = json.dumps(content, indent=1, sort_keys=True) + "\n"
    part = output / f".{MANIFEST}.part"
    part.write_text(text, encoding="utf-8")
    part.replace(output / MANIFEST)
