"""Writer of BEHAVE's results into the folders of frames, as its release has them."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core.geometry.rigid.mesh import read_mesh


def write_person(frame: Path, vertices: np.ndarray, faces: np.ndarray, pose: np.ndarray) -> Path:
    """A frame's ``person_fit.ply`` and ``.pkl``, of vertices (V, 3) and a pose of 156 or 72
    numbers; shape and translation of SMPL-H are placeholders."""
    path = frame / "person" / "fit02" / "person_fit.ply"
    write_mesh(path, vertices, faces)
    content = {"pose": pose, "betas": np.full(10, 99.0), "trans": np.full(3, 99.0)}
    path.with_suffix(".pkl").write_bytes(pickle.dumps(content, protocol=2))
    return path


def write_object(
    frame: Path, name: str, template: Path, rotation: np.ndarray, translation: np.ndarray
) -> Path:
    """A frame's ``<name>_fit.pkl`` and ``.ply`` for master_from_object (3, 3) and (3,) of the
    template as it is in its file: the release turns it about the mean of its vertices."""
    mesh = read_mesh(template)
    vertices = np.asarray(mesh.vertices)
    centre = vertices.mean(axis=0)
    angle, trans = centred(rotation, translation, centre)
    path = frame / name / "fit01" / f"{name}_fit.ply"
    turned = Rotation.from_rotvec(angle).apply(vertices - centre) + trans
    write_mesh(path, turned, np.asarray(mesh.faces))
    path.with_suffix(".pkl").write_bytes(pickle.dumps({"angle": angle, "trans": trans}))
    return path


def centred(
    rotation: np.ndarray, translation: np.ndarray, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """``angle`` and ``trans`` of a template that is moved by its centre first."""
    return Rotation.from_matrix(rotation).as_rotvec(), rotation @ centre + translation


def write_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(vertices, faces, process=False).export(path)


def write_30_fps(
    folder: Path, times: Sequence[str], poses: np.ndarray, angles: np.ndarray, trans: np.ndarray
) -> None:
    """The two files of a sequence's parameters; ``times`` such as "0003.033"."""
    names = np.array([f"t{text}" for text in times])
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / "smpl_fit_all.npz",
        poses=poses,
        betas=np.full((len(poses), 10), 99.0),
        trans=np.full((len(poses), 3), 99.0),
        frame_times=names,
        gender="male",
    )
    np.savez(folder / "object_fit_all.npz", angles=angles, trans=trans, frame_times=names)
