"""Body and object of each frame as mesh files with the names of the InterCap release."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh

from intercap_core.geometry.camera.transforms import apply
from intercap_core.output.export.format import Content, ExportFormat
from intercap_core.output.export.motion import Coordinates


def write(folder: Path, content: Content) -> Coordinates:
    """Write the meshes of some frames into ``Mesh``, and ``about.json``.

    The body is <frame>_second.<kind>; the object, in frames with a pose, is
    <frame>_second_obj.<kind>. Vertices keep their order and number. In a ply file, the property
    ``contact`` of a vertex is 1 if it touches the other mesh.
    """
    (folder / "Mesh").mkdir()
    motion, mesh, touching = content.viewed, content.mesh, content.about.touching
    coordinates, kind = Coordinates.of(motion), content.settings.mesh_format
    faces = motion.model.faces.numpy()
    for t in range(0, len(motion), content.settings.mesh_every):
        lines = [f"sequence {motion.sequence}, frame {t}", *coordinates.header_lines()]
        path = folder / "Mesh" / f"{t:05d}_second.{kind}"
        vertices = apply(content.viewed_from_master, content.scenes.bodies[t])
        body = trimesh.Trimesh(vertices, faces, process=False)
        _save(path, body, touching.body.at(t) if touching else None, lines)
        if mesh is None or not np.isfinite(motion.translation[t]).all():
            continue
        placed = mesh.vertices @ motion.rotation[t].T + motion.translation[t]
        object_ = trimesh.Trimesh(placed, mesh.faces, vertex_colors=mesh.colours, process=False)
        path = folder / "Mesh" / f"{t:05d}_second_obj.{kind}"
        _save(path, object_, touching.object_.at(t) if touching else None, lines)
    content.about.write_json(folder / "about.json", coordinates)
    return coordinates


def _save(
    path: Path, mesh: trimesh.Trimesh, touching: np.ndarray | None, lines: Sequence[str]
) -> None:
    if path.suffix == ".ply":
        if touching is not None:
            contact = np.zeros(len(mesh.vertices), np.uint8)
            contact[touching] = 1
            mesh.vertex_attributes["contact"] = contact
        path.write_bytes(ply(mesh, lines))
    else:
        text = trimesh.exchange.obj.export_obj(
            mesh, include_normals=False, include_texture=False, digits=6,
            header="\n".join(lines).replace("\n", "\n# "),
        )  # fmt: skip
        path.write_text(text if text.endswith("\n") else text + "\n", encoding="utf-8")


def ply(mesh: trimesh.Trimesh, lines: Sequence[str]) -> bytes:
    """Serialize as a binary ply without normals, with ``lines`` as comments in its header."""
    data = trimesh.exchange.ply.export_ply(mesh, vertex_normal=False)
    first, rest = data.split(b"element vertex", 1)
    comments = "".join(f"comment {line}\n" for line in lines)
    return bytes(first + comments.encode("ascii", "replace") + b"element vertex" + rest)


_README = """
meshes/Mesh/*_second.{{ kind }}  body of a frame, named by its number
{% if mesh %}
meshes/Mesh/*_second_obj.{{ kind }}  the object
{% endif %}
  frame: {{ viewed.frame }}; {{ up }}
  vertices in the order of the body file{{ " and of the object's mesh" if mesh }}
{% if kind == "ply" and about.touching is not none %}
  contact = 1 where they touch
{% endif %}
meshes/about.json   the body file, and the facts about each frame, below
"""
FORMATS = (
    ExportFormat(
        name="meshes",
        content="body and object of each frame as mesh files",
        includes="*/export/meshes/Mesh/*",
        readme=_README,
        write=write,
        draws_bodies=True,
    ),
)
