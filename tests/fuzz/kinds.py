"""All kinds of input files; this file makes those of projects, objects, bodies and results."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import trimesh

from intercap_core.body.lemo import MotionEncoder
from intercap_core.body.loading import OPEN_BODY, load_body_file
from intercap_core.body.maps import load_maps, maps_path
from intercap_core.body.vposer import VPoser
from intercap_core.body_fit.definition import Definition
from intercap_core.entries import ObjectEntry
from intercap_core.formats.released import (
    object_poses_at_30_fps,
    person_poses_at_30_fps,
    read_object_pose,
    read_person_pose,
)
from intercap_core.geometry.rigid.contact_vertices import contact_list, read_contact_vertices
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.joint.released.intercap import read_results
from intercap_core.project import load_project
from intercap_core.tables import behave
from intercap_core.tables.intercap_annotations import convert
from tests.fuzz import kinds_recordings
from tests.fuzz.plausible import Kind, Notes, within
from tests.helpers.behave_results import write_30_fps
from tests.helpers.lemo_release import write_release
from tests.test_project import HEADER

ROOT = Path(__file__).resolve().parents[2]
ANNOTATION = """contact:
- {part: right_hand, start: 3, end: 20}
object_poses:
- {frame: 0, rotation_vector: [0.1, 0.2, 0.3], translation: [0.5, -0.2, 2.1]}
- {frame: 9, rotation_vector: [0.1, 0, 0], translation: [0, 0, 2], sigma_m: 0.02, sigma_degrees: 9}
left_right: [{start: 3, end: 9, camera: k3}, {start: 12, end: 14}]
floor: [[0, 1.2, 2], [1, 1.2, 2], [0, 1.1, 3]]
subject: [{camera: k1, frame: 0, x: 612.5, y: 340}]
drop_frames: [7, 8]
starts: {k1: 0, k2: {seconds: 0.48, sigma: 0.01}}
starts_sigma: 0.05
"""
OBJECTS = """cup:
  mesh: cup.ply
  symmetry:
    continuous:
    - {axis: [0, 0, 1], offset: [0, 0, 0]}
    discrete: [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]
  labels: [cup, wine glass]
"""
BOX = trimesh.creation.box((0.2, 0.1, 0.3))
BOX.visual.vertex_colors = np.tile([200, 30, 40, 255], (8, 1))


def _make_project(folder: Path) -> None:
    lines = (ROOT / "config/config.yaml").read_text().splitlines()
    settings = [line for line in lines if line and not line.startswith("#")]
    columns = HEADER.rstrip("\n") + "\tkeypoints\tcalibration_up\tcalibration_floor\n"
    contents = {
        "config.yaml": "\n".join(settings) + "\n",
        "sequences.tsv": f"{columns}one\ts01\tcup\trec/one\tcal\tkeys\tz\t0.5\n"
        "two\ts02\tcup\trec/two\tcal\tkeys\t\t\n",
        "subjects.tsv": "subject\tgender\theight\ns01\tfemale\t1.68\ns02\tmale\t1.8\n",
        "objects.yaml": OBJECTS,
        "annotations/one.yaml": ANNOTATION,
        "contact.txt": "12\n80\n95\n120\n",
        "config.ini": "[init_trans]\ntrans = 0.1 0.2 2.0\n[init_rot]\nrot = 0.1 -0.4 1.2\n"
        "[init_frame_id]\nid = 3\n",
        "info.json": '{"gender": "male", "cat": "chair", "kinects": [0, 1, 2, 3]}',
    }
    (folder / "annotations").mkdir()
    for name, text in contents.items():
        (folder / name).write_text(text)
    shutil.copy(ROOT / "config/objects/09_cup.ply", folder / "cup.ply")
    Definition.unknown().write(folder / "definition.tsv", "people of a test")


def _read_project(folder: Path) -> Any:
    project = load_project(folder / "config.yaml")
    for annotation in map(project.annotation, project.sequences):
        within(-50, 50, [] if annotation.floor is None else annotation.floor)
        for pose in annotation.poses:
            within(-101, 101, pose.translation, pose.rotation_vector)
            within(1e-9, 90, pose.sigma_m, pose.sigma_degrees)
        within(-1e10, 1e10, list(annotation.stated_starts.values()))
    within(0.4, 2.7, [subject.height or 1.7 for subject in project.subjects.values()])


def _read_definition(folder: Path) -> None:
    definition = Definition.read(folder / "definition.tsv")
    within(-0.2, 0.2, definition.offsets)
    within(1e-6, 0.2, definition.sigma)


def _make_textured(folder: Path) -> None:
    vertices = "".join(f"v {x:g} {y:g} {z:g}\n" for x, y, z in BOX.vertices)
    faces = "".join(
        "f " + " ".join(f"{v + 1}/{n}" for n, v in enumerate(face, 1)) + "\n" for face in BOX.faces
    )
    corners = "vt 0 0\nvt 1 0\nvt 1 1\n"
    (folder / "box.obj").write_text(f"mtllib box.mtl\nusemtl a\n{vertices}{corners}{faces}")
    (folder / "box.mtl").write_text("newmtl a\nKd 0.8 0.8 0.8\nmap_Kd box.png\n")
    cv2.imwrite(str(folder / "box.png"), np.arange(48, dtype=np.uint8).reshape(4, 4, 3) * 5)


def _mesh(name: str, form: str, file: str, **options: Any) -> Kind:
    def read(folder: Path) -> Any:
        mesh = ObjectMesh.load(ObjectEntry(name="box", mesh=folder / file))
        within(-51, 51, mesh.vertices)
        within(0, len(mesh.vertices) - 1, mesh.faces)
        within(0.005, 6, np.ptp(mesh.vertices, axis=0).max())
        return mesh.centre_of_mass, mesh.face_normals, mesh.radius, mesh.colours

    def make(folder: Path) -> None:
        BOX.export(folder / file, **options)

    return Kind(name, form, make, [file], read)


def _make_contact(folder: Path) -> None:
    content = contact_list([0, 3, 5], BOX.vertices)
    (folder / "contact.json").write_text(json.dumps(content))
    (folder / "contact.pkl").write_bytes(pickle.dumps([0, 3, 5], protocol=2))
    (folder / "ids.pkl").write_bytes(pickle.dumps(np.array([0, 3, 5]), protocol=4))
    np.savez(folder / "contact.npz", **{k: np.asarray(v) for k, v in content.items()})


def _contact(name: str, form: str, file: str) -> Kind:
    def read(folder: Path) -> None:
        ids = read_contact_vertices(folder / file, Path("box.ply"), np.asarray(BOX.vertices))
        assert ids.dtype == np.int64 and len(ids)
        within(0, 7, ids)

    return Kind(name, form, _make_contact, [file], read)


def _make_body(folder: Path) -> None:
    shutil.copy(OPEN_BODY, folder / "body.npz")
    shutil.copy(maps_path(OPEN_BODY), folder / "body_maps.json")


def _read_body(folder: Path) -> Any:
    body = load_body_file(folder / "body.npz", num_betas=10, num_expression=10)
    within(0, len(body.template) - 1, body.faces)
    within(0.2, 3.1, np.ptp(body.template[:, 1]))
    return body.template, body.weights, body.joint_regressor


def _read_maps(folder: Path) -> None:
    maps = load_maps(folder / "body.npz", count := len(np.load(OPEN_BODY)["v_template"]))
    within(0, count - 1, list(maps.points.values()), maps.markers, *(maps.regions or {}).values())


def _make_vposer(folder: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    state = {}
    for name, shape in (("fc1", (64, 32)), ("fc2", (64, 64)), ("out", (126, 64))):
        weight = torch.randn(shape, generator=generator) * shape[1] ** -0.5
        state[f"bodyprior_dec_{name}.weight"] = weight
        state[f"bodyprior_dec_{name}.bias"] = torch.zeros(shape[0])
    torch.save(state, folder / "vposer.pt")
    torch.save(state, folder / "old.pt", _use_new_zipfile_serialization=False)


def _vposer(name: str, form: str, file: str) -> Kind:
    def read(folder: Path) -> None:
        prior = VPoser.load(folder / file)
        with torch.no_grad():
            within(-4, 4, prior.decode(torch.randn(2, 32, generator=torch.Generator())))

    return Kind(name, form, _make_vposer, [file], read)


def _make_lemo(folder: Path) -> None:
    weights, statistics = write_release(folder / "release")
    shutil.copy(weights, folder / "encoder.pkl")
    shutil.copy(statistics, folder / "statistics.npz")
    shutil.rmtree(folder / "release")


def _read_lemo(folder: Path) -> Any:
    encoder = MotionEncoder.load(folder / "encoder.pkl", folder / "statistics.npz")
    return np.asarray(encoder.spread), np.asarray(encoder.blocks[0][0])


def _make_results(folder: Path) -> None:
    rng = np.random.default_rng(0)
    three = ("global_orient", "transl", "jaw_pose", "leye_pose", "reye_pose")
    widths = dict.fromkeys(three, 3) | {"betas": 10, "expression": 10}
    widths |= {"left_hand_pose": 12, "right_hand_pose": 12}
    values = {name: rng.normal(size=(4, width)) for name, width in widths.items()}
    values["body_pose"] = rng.normal(size=(1, 63 * 4)).astype(np.float32)
    lists = {name: list(rng.normal(size=(4, 3))) for name in ("ob_pose", "ob_trans")}
    poses, angles, trans = (rng.normal(size=(4, count)) for count in (156, 3, 3))
    write_30_fps(folder, ["0003.000", "0003.033", "0003.067", "0003.100"], poses, angles, trans)
    person = {"pose": poses[0], "betas": np.zeros(10), "trans": np.zeros(3)}
    fit = {"angle": angles[0], "trans": trans[0]}
    for name, content in (("res", values | lists), ("person_fit", person), ("box_fit", fit)):
        (folder / f"{name}.pkl").write_bytes(pickle.dumps(content, protocol=2))


def _read_results(folder: Path) -> None:
    results = read_results(folder / "res.pkl")
    known = results.known
    within(-101, 101, results.transl[known], results.turns["global_orient"][known])
    within(-1e9, 1e9, results.betas[known])


def _read_30_fps(folder: Path) -> None:
    poses, placed = person_poses_at_30_fps(folder), object_poses_at_30_fps(folder)
    assert poses and placed
    within(-101, 101, *poses.values(), *(part for pose in placed.values() for part in pose))


def _read_frame(folder: Path) -> None:
    person, placed = (folder / f"{name}_fit.pkl" for name in ("person", "box"))
    within(-101, 101, read_person_pose(person), *read_object_pose(placed))


def _project(
    name: str, form: str, files: list[str], read: Callable[[Path], Any], *named: str
) -> Kind:
    return Kind(name, form, _make_project, files, read, named)


_KINDS = (
    _project("settings", "yaml", ["config.yaml"], _read_project),
    _project("sequences", "text", ["sequences.tsv"], _read_project),
    _project("subjects", "text", ["subjects.tsv"], _read_project),
    _project("objects", "yaml", ["objects.yaml"], _read_project),
    _project("annotation", "yaml", ["annotations/one.yaml"], _read_project),
    _project("keypoint-definition", "text", ["definition.tsv"], _read_definition),
    _project("intercap-annotation", "text", ["contact.txt", "config.ini"],
             lambda folder: Notes(convert(folder, np.arange(200), with_pose=True)[1]),
             "contact", "object_pose"),
    _project("behave-info", "json", ["info.json"], behave._gender),
    _mesh("mesh-ply", "bytes", "box.ply"),
    _mesh("mesh-ply-text", "text", "box.ply", encoding="ascii"),
    _mesh("mesh-stl", "bytes", "box.stl"),
    _mesh("mesh-obj", "text", "box.obj"),
    _mesh("mesh-glb", "bytes", "box.glb"),
    Kind("mesh-textured", "text", _make_textured, ["box.obj", "box.mtl", "box.png"],
         _mesh("", "", "box.obj").read, ("box.obj",)),
    _contact("contact-json", "json", "contact.json"),
    _contact("contact-pickle", "bytes", "contact.pkl"),
    _contact("contact-array", "bytes", "ids.pkl"),
    _contact("contact-npz", "zip", "contact.npz"),
    Kind("body", "zip", _make_body, ["body.npz"], _read_body),
    Kind("body-maps", "json", _make_body, ["body_maps.json"], _read_maps, ("body.npz",)),
    _vposer("vposer", "zip", "vposer.pt"),
    _vposer("vposer-old", "bytes", "old.pt"),
    Kind("lemo", "zip", _make_lemo, ["encoder.pkl", "statistics.npz"], _read_lemo),
    Kind("results", "bytes", _make_results, ["res.pkl"], _read_results),
    Kind("results-30-fps", "zip", _make_results, ["smpl_fit_all.npz", "object_fit_all.npz"],
         _read_30_fps),
    Kind("results-frames", "bytes", _make_results, ["person_fit.pkl", "box_fit.pkl"], _read_frame),
)  # fmt: skip
KINDS: dict[str, Kind] = {kind.name: kind for kind in (*kinds_recordings.KINDS, *_KINDS)}
