"""Body and object of each frame as mesh files with the names of the InterCap release."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.export.about import About
from intercap_core.output.export.format import Content, ExportFormat
from intercap_core.output.export.motion import Coordinates, Motion

Kind = Literal["ply", "obj"]


def write(
    folder: Path,
    motion: Motion,
    bodies: Iterable[np.ndarray],
    mesh: ObjectMesh | None,
    about: About,
    *,
    kind: Kind,
    every: int,
) -> None:
    """Write the meshes of every ``every``-th frame into ``Mesh``, and ``about.json``.

    The body is <frame>_second.<kind>; the object, in frames with a pose, is
    <frame>_second_obj.<kind>. Vertices keep their order and number. In a ply file, the property
    ``contact`` of a vertex is 1 if it touches the other mesh.

    Args:
        bodies: vertices (V, 3) for each written frame, in the motion's frame, metres.
        mesh: mesh of the object; None without an object.
    """
    files = folder / "Mesh"
    files.mkdir(parents=True)
    coordinates = Coordinates.of(motion)
    faces = motion.model.faces.numpy()
    touching = about.touching
    frames = range(0, len(motion), every)
    for t, vertices in zip(frames, bodies, strict=True):
        lines = [f"sequence {about.sequence}, frame {t}", *coordinates.header_lines()]
        path = files / f"{t:05d}_second.{kind}"
        body = trimesh.Trimesh(vertices, faces, process=False)
        _save(path, body, touching.body.at(t) if touching else None, lines, kind)
        if mesh is None or not np.isfinite(motion.translation[t]).all():
            continue
        placed = mesh.vertices @ motion.rotation[t].T + motion.translation[t]
        object_ = trimesh.Trimesh(placed, mesh.faces, vertex_colors=mesh.colours, process=False)
        path = files / f"{t:05d}_second_obj.{kind}"
        _save(path, object_, touching.object_.at(t) if touching else None, lines, kind)
    (folder / "about.json").write_text(about.to_json_text(coordinates), encoding="utf-8")


def _save(
    path: Path, mesh: trimesh.Trimesh, touching: np.ndarray | None, lines: Sequence[str], kind: Kind
) -> None:
    if kind == "ply":
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


def _write(folder: Path, content: Content) -> Coordinates:
    settings = content.settings
    placed = (
        apply(content.viewed_from_master, body)
        for body in content.scenes.bodies[:: settings.mesh_every]
    )
    write(
        folder / "meshes", content.viewed, placed, content.mesh, content.about,
        kind=settings.mesh_format, every=settings.mesh_every,
    )  # fmt: skip
    return Coordinates.of(content.viewed)


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
        path="*/export/meshes",
        content="body and object of each frame as mesh files",
        includes="*/export/meshes/Mesh/*",
        media_type="application/octet-stream",
        readme=_README,
        write=_write,
        draws_bodies=True,
    ),
)
