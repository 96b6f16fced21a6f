"""Meshes and contact lists of objects, body files, network weights, results of other programs."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import trimesh

from intercap_core.body.lemo import MotionEncoder
from intercap_core.body.loading import OPEN_BODY, load_body_file
from intercap_core.body.maps import load_maps, maps_path
from intercap_core.body.vposer import VPoser
from intercap_core.config import ObjectEntry
from intercap_core.formats.released import (
    object_poses_at_30_fps,
    person_poses_at_30_fps,
    read_object_pose,
    read_person_pose,
)
from intercap_core.geometry.rigid.contact_vertices import contact_list, read_contact_vertices
from intercap_core.geometry.rigid.mesh import ObjectMesh, colours_of
from intercap_core.geometry.rigid.mesh_files import load_mesh
from intercap_core.joint.released.intercap import read_results
from tests.fuzz.kind import ImplausibleError, Kind, finite, within
from tests.helpers.behave_results import write_30_fps
from tests.helpers.lemo_release import random_state, write_release

BOX = np.array([[x, y, z] for x in (0, 0.2) for y in (0, 0.1) for z in (0, 0.3)])


def _box() -> trimesh.Trimesh:
    mesh = trimesh.creation.box((0.2, 0.1, 0.3))
    mesh.visual.vertex_colors = np.tile([200, 30, 40, 255], (len(mesh.vertices), 1))
    return mesh


def _make_mesh(name: str, **options: object) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        _box().export(folder / name, **options)

    return make


def _make_textured(folder: Path) -> None:
    import cv2

    vertices = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in _box().vertices)
    corners = "vt 0 0\nvt 1 0\nvt 1 1\n"
    faces = "".join("f " + " ".join(f"{v + 1}/{n + 1}" for n, v in enumerate(f)) + "\n"
                    for f in _box().faces)  # fmt: skip
    (folder / "box.obj").write_text(f"mtllib box.mtl\nusemtl a\n{vertices}{corners}{faces}")
    (folder / "box.mtl").write_text("newmtl a\nKd 0.8 0.8 0.8\nmap_Kd box.png\n")
    cv2.imwrite(str(folder / "box.png"), np.arange(48, dtype=np.uint8).reshape(4, 4, 3) * 5)


def _read_mesh(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        mesh = ObjectMesh.load(ObjectEntry(name="box", mesh=folder / name))
        within(-51, 51, vertices=mesh.vertices)
        within(0, len(mesh.vertices) - 1, faces=mesh.faces)
        within(0.005, 6, extent=np.ptp(mesh.vertices, axis=0).max())
        finite(centre=mesh.centre_of_mass, normals=mesh.face_normals, radius=mesh.radius)
        if colours_of(load_mesh(folder / name)).shape[1:] != (4,):
            raise ImplausibleError("colours are no colours")

    return read


def _make_contact(folder: Path) -> None:
    content = contact_list([0, 3, 5], BOX)
    (folder / "contact.json").write_text(json.dumps(content))
    (folder / "contact.pkl").write_bytes(pickle.dumps([0, 3, 5], protocol=2))
    (folder / "ids.pkl").write_bytes(pickle.dumps(np.array([0, 3, 5]), protocol=4))
    np.savez(folder / "contact.npz", **{k: np.asarray(v) for k, v in content.items()})


def _read_contact(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        ids = read_contact_vertices(folder / name, Path("box.ply"), BOX)
        within(0, len(BOX) - 1, ids=ids)
        if ids.dtype != np.int64 or not len(ids):
            raise ImplausibleError(f"ids are {ids!r}")

    return read


def _make_body(folder: Path) -> None:
    shutil.copy(OPEN_BODY, folder / "body.npz")


def _read_body(folder: Path) -> None:
    body = load_body_file(folder / "body.npz", num_betas=10, num_expression=10)
    finite(template=body.template, weights=body.weights, joints=body.joint_regressor)
    within(0, len(body.template) - 1, faces=body.faces)
    within(0.2, 3.1, height=np.ptp(body.template[:, 1]))


def _make_maps(folder: Path) -> None:
    shutil.copy(maps_path(OPEN_BODY), folder / "body_maps.json")


def _read_maps(folder: Path) -> None:
    count = len(np.load(OPEN_BODY)["v_template"])
    maps = load_maps(folder / "body.npz", count)
    within(0, count - 1, points=list(maps.points.values()), markers=maps.markers)
    for ids in (maps.regions or {}).values():
        within(0, count - 1, ids=ids)


def _make_vposer(folder: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    state = {}
    for name, shape in (("fc1", (64, 32)), ("fc2", (64, 64)), ("out", (126, 64))):
        weight = torch.randn(shape, generator=generator) * shape[1] ** -0.5
        state[f"bodyprior_dec_{name}.weight"] = weight
        state[f"bodyprior_dec_{name}.bias"] = torch.zeros(shape[0])
    torch.save(state, folder / "vposer.pt")
    torch.save(state, folder / "old.pt", _use_new_zipfile_serialization=False)


def _read_vposer(name: str) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        prior = VPoser.load(folder / name)
        with torch.no_grad():
            within(-4, 4, pose=prior.decode(torch.randn(2, 32, generator=torch.Generator())))

    return read


def _make_lemo(folder: Path) -> None:
    weights, statistics = write_release(folder / "release").lemo_files or (None, None)
    assert weights is not None and statistics is not None
    shutil.copy(weights, folder / "encoder.pkl")
    shutil.copy(statistics, folder / "statistics.npz")
    shutil.rmtree(folder / "release")
    assert random_state()


def _read_lemo(folder: Path) -> None:
    encoder = MotionEncoder.load(folder / "encoder.pkl", folder / "statistics.npz")
    finite(spread=encoder.spread, first=encoder.blocks[0][0])


def _make_results(folder: Path) -> None:
    rng = np.random.default_rng(0)
    values = {
        **{name: rng.normal(size=(4, 3)) for name in ("global_orient", "transl", "jaw_pose",
                                                      "leye_pose", "reye_pose")},
        **{name: rng.normal(size=(4, 10)) for name in ("betas", "expression")},
        **{f"{side}_hand_pose": rng.normal(size=(4, 12)) for side in ("left", "right")},
        "body_pose": rng.normal(size=(1, 63 * 4)).astype(np.float32),
        "ob_pose": list(rng.normal(size=(4, 3))),
        "ob_trans": list(rng.normal(size=(4, 3))),
    }  # fmt: skip
    (folder / "res.pkl").write_bytes(pickle.dumps(values, protocol=2))


def _read_results(folder: Path) -> None:
    found = read_results(folder / "res.pkl")
    known = found.known
    within(-101, 101, transl=found.transl[known], orient=found.turns["global_orient"][known])
    within(-1e9, 1e9, betas=found.betas[known])


def _make_behave(folder: Path) -> None:
    rng = np.random.default_rng(1)
    poses, angles, trans = (rng.normal(size=(4, count)) for count in (156, 3, 3))
    write_30_fps(folder, ["0003.000", "0003.033", "0003.067", "0003.100"], poses, angles, trans)
    pose = {"pose": poses[0], "betas": np.zeros(10), "trans": np.zeros(3)}
    (folder / "person_fit.pkl").write_bytes(pickle.dumps(pose, protocol=2))
    fit = {"angle": angles[0], "trans": trans[0]}
    (folder / "box_fit.pkl").write_bytes(pickle.dumps(fit, protocol=2))


def _read_30_fps(folder: Path) -> None:
    poses, placed = person_poses_at_30_fps(folder), object_poses_at_30_fps(folder)
    if not poses or not placed:
        raise ImplausibleError("there are no poses, and nothing is said of that")
    for pose in poses.values():
        within(-101, 101, pose=pose)
    for angle, trans in placed.values():
        within(-101, 101, angle=angle, trans=trans)


def _read_behave_frame(folder: Path) -> None:
    within(-101, 101, pose=read_person_pose(folder / "person_fit.pkl"))
    angle, trans = read_object_pose(folder / "box_fit.pkl")
    within(-101, 101, angle=angle, trans=trans)


KINDS = (
    Kind("mesh-ply", "bytes", _make_mesh("box.ply"), ["box.ply"], _read_mesh("box.ply")),
    Kind("mesh-ply-text", "text", _make_mesh("box.ply", encoding="ascii"), ["box.ply"],
         _read_mesh("box.ply")),
    Kind("mesh-stl", "bytes", _make_mesh("box.stl"), ["box.stl"], _read_mesh("box.stl")),
    Kind("mesh-obj", "text", _make_mesh("box.obj"), ["box.obj"], _read_mesh("box.obj")),
    Kind("mesh-textured", "text", _make_textured, ["box.obj", "box.mtl", "box.png"],
         _read_mesh("box.obj"), named=("box.obj",)),
    Kind("mesh-glb", "bytes", _make_mesh("box.glb"), ["box.glb"], _read_mesh("box.glb")),
    Kind("contact-json", "json", _make_contact, ["contact.json"], _read_contact("contact.json")),
    Kind("contact-pickle", "pickle", _make_contact, ["contact.pkl"], _read_contact("contact.pkl")),
    Kind("contact-array", "pickle", _make_contact, ["ids.pkl"], _read_contact("ids.pkl")),
    Kind("contact-npz", "zip", _make_contact, ["contact.npz"], _read_contact("contact.npz")),
    Kind("body", "zip", _make_body, ["body.npz"], _read_body, share=0.3),
    Kind("body-maps", "json", _make_maps, ["body_maps.json"], _read_maps, share=0.5,
         named=("body.npz",)),
    Kind("vposer", "zip", _make_vposer, ["vposer.pt"], _read_vposer("vposer.pt")),
    Kind("vposer-old", "bytes", _make_vposer, ["old.pt"], _read_vposer("old.pt")),
    Kind("lemo", "zip", _make_lemo, ["encoder.pkl", "statistics.npz"], _read_lemo, share=0.5),
    Kind("results", "pickle", _make_results, ["res.pkl"], _read_results),
    Kind("results-30-fps", "zip", _make_behave, ["smpl_fit_all.npz", "object_fit_all.npz"],
         _read_30_fps),
    Kind("results-frames", "pickle", _make_behave, ["person_fit.pkl", "box_fit.pkl"],
         _read_behave_frame),
)  # fmt: skip
