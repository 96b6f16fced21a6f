"""Inputs of :mod:`bench.oracle`: true cameras, depth biases and mesh, and a mesh with holes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from intercap_core import artefacts
from intercap_core.artefacts import Artefact
from intercap_core.config import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import invert
from intercap_core.geometry.rigid.contact_vertices import contact_list
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.joint.cameras import BIAS
from intercap_core.schemas import SCENE, TRUTH

REMOVED_SHARE = 0.1  # of the faces
# Half of what is removed is one patch, the rest are clumps of so many faces: their holes have more
# than the four edges that loading a mesh closes.
CLUMP_FACES = 6


def write_true_scene(scene: Path, truth: Path, output: Path, *, biases: bool, held: bool) -> Path:
    """Write ``scene`` with the true camera poses, and the true depth biases where ``biases``.

    Poses are relative to the scene's master, whose pose is unchanged. Cameras are matched by name;
    values that the scene does not know (no images, no depth) stay unknown. With ``held`` the
    covariance of the true values is 0; otherwise it stays as the scene states it. Raises UserError
    where the truth lacks a camera or states no depth bias.
    """
    with artefacts.read(scene, SCENE) as found, artefacts.read(truth, TRUTH) as true:
        poses, bias = _true_cameras(found, true, biases)
        covariance = found["camera_covariance"]
        if held:
            known = slice(None) if biases else slice(0, BIAS)
            covariance[:, known] = 0
            covariance[:, :, :, known] = 0
        new = {
            "master_from_colour": poses,
            "depth_bias": bias,
            "camera_covariance": covariance,
        }
        keys, attributes = found.keys(), {n: found.attributes[n] for n in SCENE.attributes}
        digest = str(found.attributes["settings_digest"])
        with artefacts.write(output, SCENE, settings_digest=digest, **attributes) as writer:
            for key in keys:
                writer.put(key, new[key] if key in new else found[key])
    return output


def _true_cameras(found: Artefact, true: Artefact, biases: bool) -> tuple[np.ndarray, np.ndarray]:
    """Poses (C, 4, 4) and depth biases (C,) of the scene's cameras."""
    names, true_names = found.text("camera_names"), true.text("camera_names")
    strangers = sorted(set(names) - set(true_names))
    if strangers:
        raise UserError(
            f"{true.path}: knows no camera {strangers[0]!r}, which {found.path} has; it is the "
            "truth of another recording"
        )
    order = [true_names.index(name) for name in names]
    master = names.index(str(found.attributes["master"]))
    given, bias = found["master_from_colour"], found["depth_bias"]
    poses = true["master_from_colour"][order]
    poses = given[master] @ invert(poses[master]) @ poses
    poses = np.where(np.isfinite(given), poses, given)
    if biases:
        if "depth_bias" not in true:
            raise UserError(f"{true.path}: states no depth bias; make the recording anew")
        bias = np.where(np.isfinite(bias), true["depth_bias"][order], bias)
    return poses, bias


def write_true_mesh(truth: Path, output: Path, entry: ObjectEntry) -> ObjectEntry:
    """The object with the mesh that the studio drew, written to ``output`` (.ply)."""
    with artefacts.read(truth, TRUTH) as true:
        vertices, faces = true["object_vertices"], true["object_faces"]
    return _write_mesh(vertices, faces, output, entry)


def write_open_mesh(output: Path, entry: ObjectEntry, *, seed: int = 0) -> ObjectEntry:
    """The object with a tenth of its faces missing, written to ``output`` (.ply)."""
    mesh = ObjectMesh.load(entry)
    kept = ~removed_faces(mesh.vertices, mesh.faces, seed)
    return _write_mesh(mesh.vertices, mesh.faces[kept], output, entry)


def removed_faces(vertices: np.ndarray, faces: np.ndarray, seed: int) -> np.ndarray:
    """Mask (F,) of the faces to remove: one patch and scattered clumps."""
    rng = np.random.default_rng(seed)
    mesh = trimesh.Trimesh(vertices, faces, process=False, validate=False)
    beside: list[list[int]] = [[] for _ in faces]
    for a, b in mesh.face_adjacency:
        beside[a].append(int(b))
        beside[b].append(int(a))
    share = mesh.area_faces / mesh.area_faces.sum()
    removed = np.zeros(len(faces), bool)
    total = round(REMOVED_SHARE * len(faces))
    _remove_patch(removed, beside, int(rng.choice(len(faces), p=share)), total // 2)
    while (left := total - int(removed.sum())) > 0:
        first = int(rng.choice(np.flatnonzero(~removed)))
        _remove_patch(removed, beside, first, min(CLUMP_FACES, left))
    return removed


def _remove_patch(removed: np.ndarray, beside: list[list[int]], first: int, count: int) -> None:
    """Remove up to ``count`` faces around ``first``, in the order of a breadth-first search."""
    waiting, seen = [first], {first}
    for face in waiting:
        if count <= 0:
            return
        count -= not removed[face]
        removed[face] = True
        new = [other for other in beside[face] if other not in seen]
        waiting += new
        seen.update(new)


def _write_mesh(
    vertices: np.ndarray, faces: np.ndarray, output: Path, entry: ObjectEntry
) -> ObjectEntry:
    """The object with this mesh in ``output``, likely-contact vertices at the same places."""
    output.parent.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(vertices, faces, process=False, validate=False).export(output)
    listed = None
    if entry.contact_vertices is not None:
        given = ObjectMesh.load(entry)
        _, ids = cKDTree(vertices).query(given.vertices[given.contact_vertices])
        listed = output.with_suffix(".contact.json")
        listed.write_text(json.dumps(contact_list(np.unique(ids), vertices)), encoding="utf-8")
    return entry.model_copy(update={"mesh": output, "contact_vertices": listed})
