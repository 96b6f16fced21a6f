"""An animated glTF 2.0 file: the body as a skinned mesh with 55 joints, and the object as a node.

glTF is y up, so a root node turns the motion's frame. Skinning uses the four largest weights of
each vertex, the limit of most viewers, and the first frame's shape and expression. Pose correctives
of a licensed body file are omitted, because glTF skins have none.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import JOINT_NAMES, PARENTS
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.surfaces import vertex_normals
from intercap_core.object_track.appearance import linear
from intercap_core.output.export.format import Content, ExportFormat
from intercap_core.output.export.motion import Coordinates, Motion, rest_pose

_ARRAY, _ELEMENTS = 34962, 34963  # buffer targets, glTF 2.0 specification
# Type of an accessor by its number of columns, and component type by numpy's type
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENTS = {"<f4": 5126, "<u2": 5123, "<u4": 5125, "|u1": 5121}
# glTF's frame (x right, y up, z towards the viewer) from the motion's frame
_YUP_FROM_ZUP = Rotation.from_euler("x", -90, degrees=True)
_YUP_FROM_CAMERA = Rotation.from_euler("x", 180, degrees=True)


class _Document:
    """The JSON part and the binary buffer of one file, with one animation."""

    def __init__(self, name: str, times: np.ndarray) -> None:
        """``name``: of the animation; ``times``: (T,) of its frames, seconds."""
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "intercap-core"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            "nodes": [],
            "meshes": [],
            "materials": [],
            "accessors": [],
            "bufferViews": [],
        }
        self._chunks: list[bytes] = []
        self._length = 0
        self._animation: dict[str, Any] = {"name": name, "samplers": [], "channels": []}
        self._times = self.accessor(times.astype("<f4"), bounds=True)

    def accessor(
        self, values: np.ndarray, *, target: int | None = None, bounds: bool = False
    ) -> int:
        """Append an array (N,) or (N, k); return the index of its accessor.

        ``target`` is the kind of buffer, None for animation data; ``bounds`` adds min and max.
        """
        values = np.ascontiguousarray(values)
        data = values.tobytes()
        view: dict[str, Any] = {
            "buffer": 0, "byteOffset": self._length, "byteLength": len(data)
        }  # fmt: skip
        if target is not None:
            view["target"] = target
        padded = data + b"\0" * (-len(data) % 4)
        self._chunks.append(padded)
        self._length += len(padded)
        entry: dict[str, Any] = {
            "bufferView": self.add("bufferViews", view),
            "componentType": _COMPONENTS[values.dtype.str],
            "count": len(values),
            "type": _SHAPES[1 if values.ndim == 1 else values.shape[1]],
        }
        if bounds:
            table = values.reshape(len(values), -1)
            entry["min"], entry["max"] = table.min(0).tolist(), table.max(0).tolist()
        return self.add("accessors", entry)

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Append an entry to a list of the JSON part; return its index."""
        self.json.setdefault(kind, []).append(entry)
        return len(self.json[kind]) - 1

    def animate(self, node: int, path: str, values: np.ndarray) -> None:
        """Animate a property of a node: one row of ``values`` per frame, linear interpolation."""
        samplers, output = self._animation["samplers"], self.accessor(values.astype("<f4"))
        samplers.append({"input": self._times, "output": output, "interpolation": "LINEAR"})
        channel = {"sampler": len(samplers) - 1, "target": {"node": node, "path": path}}
        self._animation["channels"].append(channel)

    def bytes(self) -> bytes:
        """Serialize the whole file."""
        self.add("animations", self._animation)
        self.json["buffers"] = [{"byteLength": self._length}]
        text = json.dumps(self.json, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        binary = b"".join(self._chunks)
        total = 12 + 8 + len(text) + 8 + len(binary)  # file header, and one for each chunk
        head = struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON")
        return head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def _write(folder: Path, content: Content) -> Coordinates:
    """Write body and object, and the facts about them in the asset's extras."""
    motion = content.viewed
    document = _Document(motion.sequence, np.arange(len(motion)) / motion.fps)
    root, how = (
        (_YUP_FROM_ZUP, "") if content.is_z_up else (_YUP_FROM_CAMERA, " as the camera was held")
    )
    frame = f"y up{how}, turned by the node world from: {motion.frame}"
    coordinates = Coordinates(frame, root.apply(motion.up))
    document.json["asset"]["extras"] = content.about.to_json(coordinates)
    skeleton, body = _body(document, motion)
    children = [skeleton]
    if content.mesh is not None:
        children.append(_object(document, motion, content.mesh))
    world = {"name": "world", "rotation": root.as_quat().tolist(), "children": children}
    # glTF ignores the transform of a skinned mesh, so its node is at the top.
    document.json["scenes"][0]["nodes"] = [document.add("nodes", world), body]
    (folder / f"{motion.sequence}.glb").write_bytes(document.bytes())
    return coordinates


def _body(document: _Document, motion: Motion) -> tuple[int, int]:
    """Add the skinned mesh, its skeleton and motion; return the indices of pelvis and mesh node."""
    vertices, joints = rest_pose(motion.model, motion.parameters)
    faces = motion.model.faces.numpy()
    weights = motion.model.skinning_weights.numpy()
    strongest = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    kept = np.take_along_axis(weights, strongest, 1)
    kept = kept / kept.sum(1, keepdims=True)
    strongest = np.where(kept > 0, strongest, 0)  # required by glTF for zero weights
    geometry = _geometry(document, vertices, faces)
    geometry["attributes"]["JOINTS_0"] = document.accessor(strongest.astype("|u1"), target=_ARRAY)
    geometry["attributes"]["WEIGHTS_0"] = document.accessor(kept.astype("<f4"), target=_ARRAY)
    geometry["material"] = _material(document, "skin", (0.72, 0.60, 0.52, 1.0))
    shape = document.add("meshes", {"name": "body", "primitives": [geometry]})

    first = len(document.json["nodes"])
    for index, name in enumerate(JOINT_NAMES):
        parent = PARENTS[index]
        offset = joints[index] - (joints[parent] if parent >= 0 else 0)
        node: dict[str, Any] = {"name": name, "translation": offset.tolist()}
        below = [first + child for child, up in enumerate(PARENTS) if up == index]
        if below:
            node["children"] = below
        document.add("nodes", node)
    inverse = np.repeat(np.eye(4)[None], len(joints), 0)
    inverse[:, :3, 3] = -joints
    bind = document.accessor(np.swapaxes(inverse, 1, 2).reshape(-1, 16).astype("<f4"))
    nodes = list(range(first, first + len(joints)))
    skin = document.add("skins", {"joints": nodes, "skeleton": first, "inverseBindMatrices": bind})
    poses = motion.parameters.full_pose().numpy()
    for index in range(len(joints)):
        quaternion = _continuous(Rotation.from_rotvec(poses[:, index]).as_quat())
        document.animate(first + index, "rotation", quaternion)
    pelvis = motion.parameters.transl.numpy() + joints[0]
    document.animate(first, "translation", pelvis)
    return first, document.add("nodes", {"name": "body", "mesh": shape, "skin": skin})


def _object(document: _Document, motion: Motion, mesh: ObjectMesh) -> int:
    """Add the object's mesh and motion; return the index of its node."""
    geometry = _geometry(document, mesh.vertices, mesh.faces)
    colours = np.empty((len(mesh.colours), 4), "<f4")
    colours[:, :3], colours[:, 3] = linear(mesh.colours), 1.0  # as glTF's vertex colours are
    geometry["attributes"]["COLOR_0"] = document.accessor(colours, target=_ARRAY)
    geometry["material"] = _material(document, mesh.name, (1.0, 1.0, 1.0, 1.0))
    shape = document.add("meshes", {"name": mesh.name, "primitives": [geometry]})
    node = document.add("nodes", {"name": mesh.name, "mesh": shape})
    quaternion = _continuous(Rotation.from_matrix(motion.rotation).as_quat())
    document.animate(node, "rotation", quaternion)
    document.animate(node, "translation", motion.translation)
    return node


def _geometry(document: _Document, vertices: np.ndarray, faces: np.ndarray) -> dict[str, Any]:
    normals = vertex_normals(vertices, faces)
    return {
        "attributes": {
            "POSITION": document.accessor(vertices.astype("<f4"), target=_ARRAY, bounds=True),
            "NORMAL": document.accessor(normals.astype("<f4"), target=_ARRAY),
        },
        "indices": document.accessor(faces.ravel().astype("<u4"), target=_ELEMENTS),
    }


def _material(document: _Document, name: str, colour: tuple[float, ...]) -> int:
    surface = {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": 0.8}
    return document.add("materials", {"name": name, "pbrMetallicRoughness": surface})


def _continuous(quaternions: np.ndarray) -> np.ndarray:
    """Choose signs of quaternions (T, 4) so that players interpolate along the shorter arc."""
    flips = np.sign(np.einsum("ti,ti->t", quaternions[1:], quaternions[:-1]))
    signs = np.cumprod(np.concatenate([[1.0], np.where(flips < 0, -1.0, 1.0)]))
    return quaternions * signs[:, None]


_README = """
glb/*.glb           skinned body (55 joints){{ " and object" if mesh }}, animated; metres, y up
    as glTF requires
  under the node "world": {{ viewed.frame }}; {{ up }}
  four weights per vertex, first frame's expression, no pose correctives
  asset.extras: the body file, and the facts about each frame, below; vertices keep their numbers
"""
FORMATS = (
    ExportFormat(
        name="glb",
        content="animated body and object",
        includes="*/export/glb/*.glb",
        media_type="model/gltf-binary",
        readme=_README,
        write=_write,
    ),
)
