"""A small capture with known answers: every artefact from frames to joint, made from one body.

Three cameras look at a standing person whose right palm touches a ball. The fits are the truth
moved by constants, so that every error against the truth can be worked out by hand.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import torch
import yaml

from intercap_core import artefacts
from intercap_core.body.artefact import file_digest
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.model import BodyModel, with_hand_mean
from intercap_core.body.parameters import BodyParameters
from intercap_core.body_fit.clouds import person_clouds, put_clouds
from intercap_core.body_fit.observations import read_observations
from intercap_core.body_fit.surface import COVERINGS
from intercap_core.config import (
    BodyFitSettings,
    BodyModels,
    JointSettings,
    MetricsSettings,
    ObjectTrackSettings,
)
from intercap_core.entries import ObjectEntry, SubjectEntry
from intercap_core.flags import OF_OBJECT, PARTS, Flags
from intercap_core.geometry.camera import masks
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import render_scene
from intercap_core.geometry.rigid.shots import Drawable, Rendering
from intercap_core.object_track.artefact import SOURCE_NONE, absent_track
from intercap_core.schemas import (
    BODY_FIT,
    CONTACT_REGIONS,
    JOINT,
    OBJECT_TRACK,
    TRUTH,
)
from intercap_core.sequence_inputs import FitSettings, SequenceModels, SequencePaths
from intercap_core.stage_list import STAGES
from intercap_core.stages import metrics
from tests.helpers.bodies import open_body
from tests.helpers.shared_folder import shared_folder
from tests.helpers.synthetic_capture import fill, write_frames, write_person, write_scene
from tests.helpers.synthetic_people import write_detections

FPS = 15.0
BODY_OFFSET_M = 0.010  # the fitted body is this much below the true one
LOST = "object lost, filled in"  # reason of the flag of the first frame
FLAG_REASON = f"object, contact: {LOST}"
OBJECT_OFFSET_M = 0.004  # the tracked ball is below the true one; half of it after joint
SUBJECT = SubjectEntry(subject="p01", gender="neutral")
BODY_MODELS = BodyModels()
FIT_SETTINGS = FitSettings(JointSettings(), BodyFitSettings(), ObjectTrackSettings())


@dataclass
class Capture:
    """Paths of the artefacts, by stage, and what they were made from."""

    paths: dict[str, Path]
    object_: ObjectEntry | None
    """None for a person alone."""
    mesh: ObjectMesh
    model: BodyModel
    rig: Rig
    vertices: np.ndarray  # (T, V, 3), true
    joints: np.ndarray  # (T, 55, 3), true
    rotation: np.ndarray
    translation: np.ndarray

    @property
    def models(self) -> SequenceModels:
        return SequenceModels(self.object_, SUBJECT, BODY_MODELS)

    def inputs(self, *stages: str) -> SequencePaths:
        return SequencePaths(**{stage: self.paths[stage] for stage in stages})

    def copied(self, folder: Path, *stages: str, name: str = "") -> Capture:
        """Return the capture with copies of some artefacts in ``folder``, to be changed.

        Args:
            name: another name of the sequence; needs a copy of every artefact.
        """
        folder.mkdir(parents=True, exist_ok=True)
        copies = {stage: Path(shutil.copy(self.paths[stage], folder)) for stage in stages}
        made = replace(self, paths=self.paths | copies)
        for stage in stages if name else ():
            with made.edit(stage) as file:
                file.attrs["sequence"] = name
        return made

    def edit(self, stage: str) -> h5py.File:
        """Open an artefact for changes that checksums do not notice."""
        return h5py.File(self.paths[stage], "r+")

    def measure(self, output: Path | None = None, *, truth: bool = False, **settings: bool) -> Path:
        """Run stage metrics; returns its artefact, by default the capture's."""
        output = output or self.paths["metrics"]
        metrics.run(
            paths=self.inputs(*STAGES["metrics"].reads),
            output=output,
            models=self.models,
            settings=MetricsSettings(**settings),
            fit_settings=FIT_SETTINGS,
            truth=self.paths["truth"] if truth else None,
        )
        return output


def object_entry(name: str) -> ObjectEntry:
    """An object of the project's own table."""
    folder = Path(__file__).resolve().parents[2] / "config"
    entry = ObjectEntry(name=name, **yaml.safe_load((folder / "objects.yaml").read_text())[name])
    paths = {"mesh": folder / entry.mesh, "contact_vertices": folder / entry.contact_vertices}
    return entry.model_copy(update=paths)


def _rig(count: int = 3) -> Rig:
    bent = np.array([0.08, -0.05, 1e-3, -1e-3, 0.01, 0, 0, 0])
    colour = Intrinsics(480, 270, 230.0, 230.0, 239.5, 134.5, bent)
    depth = Intrinsics(320, 288, 200.0, 200.0, 159.5, 143.5)
    between = np.eye(4)
    between[0, 3] = -0.032
    middle = np.array([0.0, 0.0, 2.4])
    cameras = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        turn = cv2.Rodrigues(np.array([0.0, -angle, 0.0]))[0]
        pose = rigid(turn, middle - turn @ middle)
        cameras.append(Camera(f"k{index + 1}", colour, depth, between, pose))
    return Rig(tuple(cameras))


def _body(model: BodyModel, total: int) -> BodyParameters:
    params = with_hand_mean(model, model.zeros(total))
    params.betas = torch.full((1, model.num_betas), 0.3)
    params.global_orient[:, 0] = np.pi  # y up and facing +z becomes y down and facing the camera
    params.body_pose[:, 3 * 15 + 2] = -0.9  # left_shoulder and right_shoulder: arms down
    params.body_pose[:, 3 * 16 + 2] = 0.9
    params.transl[:] = torch.tensor([0.0, 0.25, 2.4])
    params.transl[:, 0] += 0.01 * torch.arange(total)
    return params


def make_capture(
    folder: Path, *, name: str = "cap", object_name: str = "football", total: int = 5
) -> Capture:
    """Write all artefacts of a capture of ``total`` frame sets into ``folder``."""
    capture, params, keypoints = _pose_capture(folder, object_name, total)
    tips = keypoints[:, [29, 33, 37, 41, 45, 50, 54, 58, 62, 66]]
    views = _draw(capture)
    _write_frames(capture, views, name)
    _write_scene(capture, name)
    _write_detections(capture, views, name)
    _write_person(capture, views, keypoints, name)
    _write_fits(capture, params, name)
    _write_truth(capture, tips, name)
    return capture


def open_capture(folder: Path, *, object_name: str, total: int) -> Capture:
    """Return a capture that :func:`make_capture` has written."""
    return _pose_capture(folder, object_name, total)[0]


def shared_capture(factory: pytest.TempPathFactory, total: int = 5) -> Capture:
    """Return a capture of ``total`` frame sets that the tests of all workers share; read only."""
    folder = shared_folder(
        factory, f"capture_{total}", lambda folder: make_capture(folder, total=total)
    )
    return open_capture(folder, object_name="football", total=total)


def _pose_capture(
    folder: Path, object_name: str, total: int
) -> tuple[Capture, BodyParameters, np.ndarray]:
    """Return the capture, the true body, and its keypoints (T, 135, 3)."""
    torch.manual_seed(0)
    model = open_body()
    entry = object_entry(object_name)
    mesh = ObjectMesh.load(entry)
    params = _body(model, total)
    params = model.parameters(params.vector())
    with torch.no_grad():
        posed = model.forward(params)
        keypoints = model.keypoints(posed).double().numpy()
    vertices, joints = posed.vertices.numpy(), posed.joints.numpy()
    palm = vertices[:, model.regions["right_hand"]]
    side = palm[:, :, 0].argmin(1)  # outermost palm vertex, image left
    touch = palm[np.arange(total), side].astype(np.float64)
    radius = float(np.abs(mesh.vertices[:, 0]).max())
    rotation = np.repeat(np.eye(3)[None], total, 0)
    translation = touch + np.array([-(radius - 0.001), 0.0, 0.0])
    rig = _rig()
    capture = Capture(
        {stage: folder / f"{stage}.h5" for stage in
         ("frames", "detections", "scene", "person", "object_track", "body_fit", "joint", "truth",
          "metrics")},
        entry, mesh, model, rig, vertices, joints, rotation, translation,
    )  # fmt: skip
    return capture, params, keypoints


def take_object_away(capture: Capture) -> Capture:
    """Make the capture one of a person alone: artefacts up to joint, and the truth."""
    lose_object(capture)
    for stage in ("object_track", "joint", "truth"):
        with capture.edit(stage) as file:
            file.attrs["object"] = ""
    with capture.edit("joint") as file:
        file["flagged"][...] = False
        file["flag_reason"][...] = b""
    with capture.edit("truth") as file:
        file["region_contact"][...] = False
        for key in (
            "object_vertices", "object_faces", "object_views", "object_visible", "rotation",
            "translation",
        ):  # fmt: skip
            del file[key]
    return replace(capture, object_=None)


def lose_object(capture: Capture, doubts: str = "") -> None:
    """Make the object's track lost in every frame, and the joint result one without the object."""
    with capture.edit("object_track") as file:
        file.attrs["seed_source"], file.attrs["doubts"] = SOURCE_NONE, doubts
        for key, values in absent_track(len(capture.vertices), len(capture.rig)).items():
            file[key][...] = values
    with capture.edit("joint") as file:
        for key in ("rotation", "translation", "contact_probability"):
            file[key][...] = np.nan
        file["flagged"][...] = np.isin(PARTS, OF_OBJECT)
        file["flag_reason"][...] = FLAG_REASON.encode()


def write_project(folder: Path, capture: Capture, name: str) -> Path:
    """Settings of a project in ``folder`` whose one sequence is the capture, up to joint."""
    results = folder / "results" / "trial" / name
    results.mkdir(parents=True)
    for stage in ("frames", "scene", "detections", "person", "object_track", "body_fit", "joint"):
        shutil.copy(capture.paths[stage], results)
    object_ = capture.object_
    assert object_ is not None
    (folder / "objects.yaml").write_text(f"{object_.name}: {{mesh: {object_.mesh}}}\n")
    (folder / "subjects.tsv").write_text("subject\tgender\np01\tneutral\n")
    (folder / "sequences.tsv").write_text(
        "sequence\tsubject\tobject\trecordings\tcalibration\ttruth\n"
        f"{name}\tp01\t{object_.name}\trec\tcal\t{capture.paths['truth']}\n"
    )
    path = folder / "config.yaml"
    path.write_text(f"dataset: trial\nresults: {folder / 'results'}\n")
    return path


def _drawables(capture: Capture, t: int, camera_from_master: np.ndarray) -> list[Drawable]:
    pose = rigid(capture.rotation[t], capture.translation[t])
    vertices = capture.vertices[t].astype(float)
    return [
        Drawable(vertices, capture.model.faces.numpy(), camera_from_master),
        Drawable(capture.mesh.vertices, capture.mesh.faces, camera_from_master @ pose),
    ]


def _draw(capture: Capture) -> list[list[tuple[Rendering, Rendering]]]:
    """Colour and depth renderings (T, C)."""
    return [
        [
            (
                render_scene(_drawables(capture, t, camera.colour_from_master), camera.colour),
                render_scene(_drawables(capture, t, camera.depth_from_master), camera.depth),
            )
            for camera in capture.rig
        ]
        for t in range(len(capture.vertices))
    ]


def _write_frames(capture: Capture, views: Any, name: str) -> None:
    rig, total = capture.rig, len(views)
    depths = [np.full((total, *_size(camera.depth)), 4000, np.uint16) for camera in rig]
    colours: list[list[bytes]] = [[] for _ in rig]
    for c, camera in enumerate(rig):
        lens = camera.colour
        shade = np.linspace(90, 160, lens.width)[None, :, None]
        empty = np.repeat(np.repeat(shade, lens.height, 0), 3, 2).astype(np.uint8)
        for t in range(total):
            colour, depth = views[t][c]
            image = empty.copy()
            image[colour.full_mask(lens, 0)] = (60, 90, 180)
            image[colour.full_mask(lens, 1)] = (200, 200, 40)
            colours[c].append(cv2.imencode(".jpg", image)[1].tobytes())
            window = depths[c][t][depth.window]
            window[depth.mask] = np.rint(1e3 * depth.depth[depth.mask])
    gravity = np.tile([0.0, 1.0, 0.0], (len(rig), 1))
    write_frames(
        capture.paths["frames"], rig, num_sets=total, depths=depths, colours=colours,
        gravity=gravity, sequence=name,
    )  # fmt: skip


def _size(lens: Intrinsics) -> tuple[int, int]:
    return lens.height, lens.width


def _write_scene(capture: Capture, name: str) -> None:
    rig, total = capture.rig, len(capture.vertices)
    floor = float(capture.vertices[..., 1].max())
    start = rig.master_from_colour.copy()
    start[1, 0, 3] += 0.012
    zup = np.eye(4)
    zup[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    zup[2, 3] = floor
    write_scene(
        capture.paths["scene"],
        rig,
        np.arange(total) / FPS,
        [np.full(_size(camera.depth), 4000) for camera in rig],
        zup_from_master=zup,
        attributes={
            "sequence": name, "extrinsics_refined": True, "ground_rms": 0.004,
            "ground_inliers": 1000,
        },
        master_from_colour_start=start,
        pairs=np.array([[0, 1], [1, 2], [2, 0]]),
        pair_points=np.full(3, 5000),
        pair_residual_before=np.array([0.012, 0.011, 0.006]),
        pair_residual_after=np.array([0.004, 0.004, 0.003]),
        ground_point=np.array([0.0, floor, 2.4]),
    )  # fmt: skip


def _write_detections(capture: Capture, views: Any, name: str) -> None:
    rig, total = capture.rig, len(views)
    nobody = np.zeros((135, 3))
    balls = {
        (t, c): [("sports ball", masks.encode(views[t][c][0].full_mask(camera.colour, 1)))]
        for t in range(total)
        for c, camera in enumerate(rig)
    }
    people = [[[nobody]] * len(rig)] * total
    write_detections(capture.paths["detections"], rig, people, balls, sequence=name)


def _write_person(capture: Capture, views: Any, joints: np.ndarray, name: str) -> None:
    """With true keypoints, ``joints`` (T, 135, 3) and where each camera sees them."""
    rig, total = capture.rig, len(views)
    count = len(rig)
    rles = [
        masks.encode(views[t][c][0].full_mask(camera.colour, 0))
        for t in range(total)
        for c, camera in enumerate(rig)
    ]
    seen = np.ones((total, count, 135, 3))
    for c, camera in enumerate(rig):
        seen[:, c, :, :2] = camera.colour.project(apply(camera.colour_from_master, joints))
    write_person(
        capture.paths["person"], rig, rles, sequence=name, keypoints=seen, joints=joints,
        joint_views=np.full((total, 135), 3), inlier=np.ones((total, count, 135), bool),
        missing=np.arange(total) == total - 1,
    )  # fmt: skip


def _write_fits(capture: Capture, params: BodyParameters, name: str) -> None:
    rig, total = capture.rig, len(capture.vertices)
    count, regions = len(rig), len(CONTACT_REGIONS)
    body = {key: getattr(params, key).numpy().copy() for key in vars(params)}
    body["transl"][:, 1] += BODY_OFFSET_M
    body["joints"] = capture.joints + np.array([0, BODY_OFFSET_M, 0])
    body["keypoint_residual"] = np.full((total, count), 5.0)
    body["cloud_residual"] = np.full(total, 0.01)
    below, object_name = np.array([0, OBJECT_OFFSET_M, 0]), _name(capture)
    identity = {"sequence": name, "subject": SUBJECT.subject, "gender": "neutral",
                "body_model": file_digest(OPEN_BODY)}  # fmt: skip
    with artefacts.write(
        capture.paths["object_track"], OBJECT_TRACK, sequence=name, object=object_name,
        seed_frame=0, seed_source="search", doubts="",
    ) as writer:  # fmt: skip
        _put(writer, {
            "camera_names": rig.names, "rotation": capture.rotation,
            "translation": capture.translation + below, "overlap": np.full((total, count), 0.9),
            "depth_residual": np.full((total, count), 0.003),
            "silhouette_residual": np.full((total, count), 1.0), "views": np.full(total, count),
            "covariance": np.repeat(np.eye(6)[None] * 0.004**2, total, 0),
            "lost": np.arange(total) == 0, "probability": np.ones(total),
        })  # fmt: skip
        fill(writer, OBJECT_TRACK, T=total, C=count)
    with artefacts.write(capture.paths["body_fit"], BODY_FIT, **identity) as writer:
        _put(writer, body | {
            "joint_sigma": np.full((total, 55), 0.01), "part_names": ["left_hand", "right_hand"],
            "keypoint_sigma": np.full(135, 0.01), "covering_noise": np.full(len(COVERINGS), 0.01),
        })  # fmt: skip
        seen = read_observations(capture.paths["scene"], capture.paths["person"])
        clouds = person_clouds(capture.paths["frames"], capture.paths["person"], seen, 3000)
        put_clouds(writer, clouds, count)
        fill(writer, BODY_FIT, T=total, C=count, P=2, G=len(COVERINGS), K=135)
    with artefacts.write(
        capture.paths["joint"], JOINT, object=object_name, iterations=3, refused=0,
        last_step_mm=0.2, last_decrease=0.001, converged=True, cameras_corrected=True, **identity,
    ) as writer:  # fmt: skip
        _put(writer, body | {
            "betas": body["betas"][0], "rotation": capture.rotation,
            "translation": capture.translation + below / 2, "region_names": CONTACT_REGIONS,
            "contact_probability": np.full((total, regions), 0.5),
            "contact_annotated": np.full((total, regions), -1), "camera_names": list(rig.names),
            "master_from_colour": rig.master_from_colour, "energy_names": ["object", "body"],
            "energy_before": [2.0, 1.0], "energy_after": [1.0, 0.5],
        })  # fmt: skip
        Flags.of(total, [(np.arange(total) == 0, LOST, OF_OBJECT)]).write(writer)
        fill(writer, JOINT, T=total, C=count)


def _name(capture: Capture) -> str:
    return "" if capture.object_ is None else capture.object_.name


def _put(writer: artefacts.Writer, values: Mapping[str, Any]) -> None:
    for key, value in values.items():
        writer.put(key, value)


def _write_truth(capture: Capture, tips: np.ndarray, name: str) -> None:
    rig, total = capture.rig, len(capture.vertices)
    faces = capture.model.faces.numpy()
    # each vertex is the first corner of the first face that has it
    order = np.argsort(faces.ravel(), kind="stable")
    first = order[np.searchsorted(faces.ravel()[order], np.arange(capture.model.num_vertices))]
    face, corner = np.divmod(first, 3)
    contact = np.zeros((total, len(CONTACT_REGIONS)), bool)
    contact[:, CONTACT_REGIONS.index("right_hand")] = True
    with artefacts.write(
        capture.paths["truth"], TRUTH, sequence=name, interaction="hold", subject="p01",
        object=_name(capture), ground_offset=0.0, fps=FPS,
    ) as writer:  # fmt: skip
        _put(writer, {
            "times": np.arange(total) / FPS, "body_vertices": capture.vertices,
            "body_faces": faces, "correspondence_face": face,
            "correspondence_weights": np.eye(3)[corner], "joints": capture.joints,
            "fingertips": tips, "object_vertices": capture.mesh.vertices,
            "object_faces": capture.mesh.faces, "rotation": capture.rotation,
            "translation": capture.translation, "object_views": np.full(total, len(rig)),
            "region_names": CONTACT_REGIONS, "region_contact": contact, "camera_names": rig.names,
            "master_from_colour": rig.master_from_colour, "time_offset": np.zeros(len(rig)),
            "slip": np.zeros((total, len(rig)), int), "ground_normal": [0.0, -1.0, 0.0],
            "body_visible": np.ones((total, capture.model.num_vertices), bool),
            "object_visible": np.ones((total, len(capture.mesh.vertices)), bool),
        })  # fmt: skip
