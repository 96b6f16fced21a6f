"""Reading of mesh files.

Counts in a file's header are compared with its content. Materials and textures are read only from
the folder of the mesh, even if the file names another path.
"""

from __future__ import annotations

import io
import json
import logging
import re
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

from intercap_core.errors import UserError
from intercap_core.inputs.files import UnreadableFile, printable, read_bytes

SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb")
# Exceptions of trimesh and numpy for damaged files, and of Pillow for damaged textures.
TEXTURE_ERRORS = (
    AttributeError, TypeError, ValueError, IndexError, KeyError, OSError, SyntaxError,
    OverflowError, struct.error, zlib.error, Image.DecompressionBombError, EOFError,
)  # fmt: skip
_ERRORS = (*TEXTURE_ERRORS, ZeroDivisionError, NotImplementedError, RecursionError,
           AssertionError, RuntimeError)  # fmt: skip


def load_mesh(path: Path) -> Any:
    """Return the triangle mesh of a file; a scene becomes one mesh.

    Raises UserError that names the file if it is no mesh or has fewer faces than its header states.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError(f"{path}: is no mesh that is read; export it as {', '.join(SUFFIXES)}")
    content = read_bytes(path)
    stated = _stated_faces(path, content) if suffix == ".ply" else 0
    if suffix == ".glb":
        _refuse_extensions(path, content)
    try:
        if suffix == ".obj":
            content = _plain_obj(content)
        with warnings.catch_warnings(), _silent_trimesh():
            warnings.simplefilter("ignore")  # NumPy's, about values that are rejected later
            mesh: Any = trimesh.load(
                io.BytesIO(content),
                file_type=suffix[1:],
                resolver=_FolderResolver(path.parent),
                process=False,
                force="mesh",
            )
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    except _ERRORS as error:
        reason = printable(str(error).partition("\n")[0][:200])
        raise UserError(
            f"{path}: not a readable mesh ({type(error).__name__}: {reason}); export it again as "
            ".ply or .obj"
        ) from None
    if vertices.ndim != 2 or len(vertices) == 0 or faces.ndim != 2 or len(faces) == 0:
        raise UserError(
            f"{path}: holds {len(vertices)} vertices and {len(faces)} faces, expected a triangle "
            "mesh; export the surface, not a point cloud"
        )
    if len(faces) < stated:
        raise UserError(
            f"{path}: states {stated} faces, of which {len(faces)} can be read; export it again"
        )
    return mesh


def file_vertices(path: Path, mesh: Any) -> np.ndarray:
    """Return the vertices (V, 3) in the order in which the file numbers them.

    The loaded ``mesh`` of the file has more vertices if corners of faces differ in texture
    coordinates, and another order if the faces have several materials.
    """
    if path.suffix.lower() == ".obj":
        lines = map(bytes.split, _plain_obj(read_bytes(path)).splitlines())
        try:
            return np.array([words[1:4] for words in lines if words[:1] == [b"v"]], np.float64)
        except ValueError:
            raise UserError(
                f"{path}: a vertex has other than three numbers; export the mesh again"
            ) from None
    raw = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    if path.suffix.lower() == ".ply" and raw is not None:  # columns by name, binary or ASCII
        return np.column_stack([np.ravel(raw[axis]) for axis in "xyz"]).astype(np.float64)
    return np.asarray(mesh.vertices, np.float64)


def read_mesh(path: Path) -> trimesh.Trimesh:
    """Return the mesh of a file with valid indices and finite vertices; raises UserError."""
    if not path.is_file():
        raise UserError(f"{path}: there is no such mesh; correct 'mesh' in objects.yaml")
    mesh = load_mesh(path)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if faces.min() < 0 or faces.max() >= len(vertices):
        stray = faces.min() if faces.min() < 0 else faces.max()
        raise UserError(
            f"{path}: a face names vertex {stray}, there are {len(vertices)}; export the mesh again"
        )
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    bad = np.flatnonzero(used & ~np.isfinite(vertices).all(1))
    if len(bad):
        raise UserError(
            f"{path}: vertex {bad[0]} is not a number (and {len(bad) - 1} more); export the mesh "
            "again"
        )
    return mesh


def get_colours(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return vertex colours (V, 4) uint8, sRGB and alpha: stored, from the texture, or grey."""
    visual: Any = mesh.visual
    try:
        if visual is not None and visual.kind == "texture":
            visual = visual.to_color()
        colours = np.asarray(getattr(visual, "vertex_colors", ()), np.uint8)
    except TEXTURE_ERRORS:
        colours = np.zeros(0, np.uint8)  # the texture is missing or no image
    if colours.shape != (len(mesh.vertices), 4):
        return np.full((len(mesh.vertices), 4), (128, 128, 128, 255), np.uint8)
    return colours


class _FolderResolver(trimesh.resolvers.Resolver):
    """Resolves the last part of a file's name in the folder of the mesh."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, key: Any) -> bytes:
        name = Path(str(key).strip().replace("\\", "/")).name
        try:
            return read_bytes(self._folder / name)
        except UnreadableFile as error:
            raise OSError(str(error)) from None

    def keys(self) -> list[str]:
        return []

    def write(self, name: str, data: Any) -> None:
        raise OSError("meshes are only read")

    def namespaced(self, namespace: str) -> _FolderResolver:
        return self


@contextmanager
def _silent_trimesh() -> Iterator[None]:
    """Disable trimesh's log, which repeats errors that are reported as UserError."""
    log = logging.getLogger("trimesh")
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before


def _refuse_extensions(path: Path, content: bytes) -> None:
    """Raise UserError if a GLB requires an extension that changes its geometry."""
    try:
        (length,) = struct.unpack("<I", content[12:16])
        required = json.loads(content[20 : 20 + length]).get("extensionsRequired", [])
        names = sorted(str(name) for name in required)
    except (struct.error, ValueError, AttributeError, TypeError, RecursionError):
        return  # trimesh names the fault
    harmless = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_")
    unread = printable(", ".join(name for name in names if not name.startswith(harmless))[:200])
    if unread:
        raise UserError(
            f"{path}: requires {unread}, which is not read; export it without compression and "
            "other extensions of glTF, or as .ply or .obj"
        )


def _plain_obj(content: bytes) -> bytes:
    """Rewrite vertices and faces of an OBJ file in the form that trimesh reads.

    Trimesh takes neither tabs, spaces before a line nor comments after its numbers, and counts
    negative indices from the end of the file. They count back from the vertices above the face.
    Raises ValueError for an index before the first vertex.
    """
    content = content.removeprefix(b"\xef\xbb\xbf")  # byte order mark
    content = content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    if re.search(rb"^[ \t]*f[ \t](?:[^\n#]*[ \t])?0(?=[/\s]|$)", content, re.MULTILINE):
        raise ValueError("a face names vertex 0, vertices of OBJ are counted from 1")
    unread = rb"^f\s[^\n#]*-\d|^[ \t]+[vf]|^[vf]\w?(?=\s)[^\n]*[\t#]"
    if not re.search(unread, content, re.MULTILINE):
        return content
    counts, lines = {b"v": 0, b"vt": 0, b"vn": 0}, []
    for line in content.splitlines():
        words = line.partition(b"#")[0].split()
        if words and words[0] in counts:
            counts[words[0]] += 1
            line = b" ".join(words)
        elif words[:1] == [b"f"]:
            corners = [corner.split(b"/") for corner in words[1:]]
            for corner in corners:
                for at, (index, count) in enumerate(zip(corner, counts.values(), strict=False)):
                    if index.startswith(b"-"):
                        if count + int(index) < 0:
                            raise ValueError(
                                f"a face names vertex {int(index)} of {count} above it"
                            )
                        corner[at] = b"%d" % (count + 1 + int(index))
            line = b"f " + b" ".join(b"/".join(corner) for corner in corners)
        lines.append(line)
    return b"\n".join(lines) + b"\n"


def _stated_faces(path: Path, content: bytes) -> int:
    """Return the number of faces in a PLY's header; raises UserError if the file is too short."""
    head, separator, body = content.partition(b"end_header")
    if not content.startswith(b"ply") or not separator:
        raise UserError(f"{path}: not a readable mesh (it has no head of a PLY); export it again")
    counts: dict[bytes, int] = {}
    properties: dict[bytes, list[bytes]] = {}
    for line in head.splitlines():
        words = line.split()
        if words[:1] == [b"element"]:
            if len(words) != 3 or not words[2].isdigit() or len(words[2]) > 12:
                raise UserError(
                    f"{path}: not a readable mesh (its head counts {words[2:]!r:.40}); export it "
                    "again"
                )
            counts[words[1]] = int(words[2])
            properties[words[1]] = []
        elif words[:1] == [b"property"] and properties:
            properties[next(reversed(properties))].append(words[1])
    if sum(counts.values()) > len(body):
        raise UserError(
            f"{path}: states {sum(counts.values())} elements in {len(body)} bytes; the file is cut "
            "or damaged, export it again"
        )
    faces = counts.get(b"face", 0)
    if b"format ascii" in head and properties.get(b"face", [])[:1] == [b"list"]:
        _check_lists(path, body, counts)
    return faces


def _check_lists(path: Path, body: bytes, counts: dict[bytes, int]) -> None:
    """Raise UserError if a face of an ASCII PLY has fewer vertices than it states."""
    lines = [line.split() for line in body.split(b"\n")[1:] if line.strip()]
    start = 0
    for name, count in counts.items():
        for words in lines[start : start + count] if name == b"face" else ():
            if not words[0].isdigit() or len(words[0]) > 9 or int(words[0]) >= len(words):
                raise UserError(
                    f"{path}: a face states {printable(words[0][:20].decode('latin1'))} vertices "
                    f"and lists {len(words) - 1}; export it again"
                )
        start += count
