"""Data of the viewer, from a sequence's artefacts, in the z-up frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.artefacts import Artefact
from intercap_core.body.artefact import load_model, read_parameters
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.config import BodyModels
from intercap_core.errors import UserError
from intercap_core.evaluation.contact import vertex_contact
from intercap_core.evaluation.segmented import SegmentedClouds, read_clouds
from intercap_core.evaluation.truth import Truth
from intercap_core.flags import Flags
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.time_series import sample_evenly
from intercap_core.output.export.motion import z_up_frame
from intercap_core.output.viewer.skinning import skinned
from intercap_core.schemas import BODY_FIT, JOINT, METRICS, OBJECT_TRACK, SCENE
from intercap_core.sequence_inputs import SequenceModels, SequencePaths

MESH_FACES = 20000  # an object with more faces is simplified
IMAGE_WIDTH = 640  # pixels of the cameras' images, if the recorded ones are not smaller
VERSIONS = {"joint": "joint fit", "sequential": "per-stage fits", "truth": "truth"}


@dataclass
class Content:
    """The viewer's data of T frames."""

    header: dict[str, Any] = field(default_factory=dict)
    """Values that are serialized as JSON."""
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Fit:
    """Body and object of one result over T frames, master frame."""

    model: BodyModel
    parameters: BodyParameters
    rotation: np.ndarray
    """(T, 3, 3) master_from_object; NaN = no pose."""
    translation: np.ndarray
    """(T, 3) master_from_object, metres; NaN = no pose."""


def gather(paths: SequencePaths, models: SequenceModels, *, truth: Path | None = None) -> Content:
    """Collect the data of a sequence.

    The artefacts of frames, scene and body_fit must exist; those of other stages are optional.
    Raises UserError if an artefact is missing or broken.
    """
    object_, body_models, gender = models.object_, models.body_models, models.gender
    existing = {stage: path for stage, path in paths.by_stage().items() if path.is_file()}
    content = Content()
    with artefacts.read(paths.scene, SCENE) as scene:
        zup, rig, image_of = scene["zup_from_master"], Rig.from_artefact(scene), scene["image_of"]
        bias = scene["depth_bias"]
        upright = z_up_frame(scene)
        floor = bool(scene.attributes["ground_found"])
    bodies: dict[str, Fit] = {}
    flags = Flags.of(0, ())
    imported = False
    if "joint" in existing:
        with artefacts.read(existing["joint"], JOINT) as joint:
            model = load_model(body_models, gender, joint)
            bodies["joint"] = Fit(
                model, read_parameters(joint), joint["rotation"], joint["translation"]
            )
            rig, bias = rig.moved(joint["master_from_colour"]), joint["depth_bias"]
            flags = Flags.read(joint)
            imported = "made_by" in joint.attributes
            _add_stated_contact(content, joint, model)
    bodies["sequential"] = _sequential(paths.body_fit, existing, body_models, gender)
    names = {**VERSIONS, "joint": "imported result"} if imported else VERSIONS
    shown = next(iter(bodies.values()))
    total = shown.parameters.batch
    if "metrics" in existing:
        flags = _add_measured(content, existing["metrics"], shown.model.num_vertices)
    mesh = None
    known = np.isfinite(shown.translation).all(1)
    if object_ is not None and any(np.isfinite(b.translation).any() for b in bodies.values()):
        mesh = ObjectMesh.load(object_)
        vertices, faces, colours = _simplified(mesh)
        content.arrays["object/vertices"] = vertices.astype(np.float32)
        content.arrays["object/faces"] = faces.astype(np.uint32)
        content.arrays["object/colours"] = colours
    content.arrays["faces"] = shown.model.faces.numpy().astype(np.uint32)
    for name, body in bodies.items():
        _add_body(content, name, body, zup)
        if mesh is not None:
            _add_poses(content, name, body.rotation, body.translation, zup)
    with Frames.open(paths.frames) as recorded:
        images = recorded.showing(image_of)
        moments = sample_evenly(np.ones(total, bool), 40)  # the frames that have clouds and images
        content.header |= {
            "name": images.sequence,
            "fps": images.fps,
            "frames": total,
            "frame": upright,
            "floor": floor,
            "moments": moments.tolist(),
            "versions": {name: names[name] for name in bodies},
            "object": "" if mesh is None else mesh.name,
            "flags": [
                [t, text, bool(flags.flagged[t, 0])]  # frame, words, body is flagged
                for t, text in enumerate(flags.texts())
                if text
            ],
        }
        _add_cameras(content, rig, zup)
        _add_images(content, images, rig, moments)
        if {"detections", "person", "object_track"} <= existing.keys():
            objects = None if mesh is None or not known.any() else mesh
            clouds = read_clouds(
                images, rig, bias, image_of,
                detections=paths.detections, person=paths.person, object_track=paths.object_track,
            )  # fmt: skip
            _add_clouds(content, clouds, shown, objects, moments, zup)
        if truth is not None and truth.is_file():
            count = shown.model.num_vertices
            _add_truth(content, Truth.load(truth, images.time_s, images.fps, count), zup)
    return content


def _sequential(
    body_fit: Path, existing: Mapping[str, Path], body_models: BodyModels, gender: str
) -> Fit:
    """Read the sequential fits; the object has no pose without an object track."""
    with artefacts.read(body_fit, BODY_FIT) as fit:
        model, parameters = load_model(body_models, gender, fit), read_parameters(fit)
    rotation = np.full((parameters.batch, 3, 3), np.nan)
    translation = np.full((parameters.batch, 3), np.nan)
    if "object_track" in existing:
        with artefacts.read(existing["object_track"], OBJECT_TRACK) as track:
            rotation, translation = track["rotation"], track["translation"]
    return Fit(model, parameters, rotation, translation)


def _add_stated_contact(content: Content, joint: Artefact, model: BodyModel) -> None:
    """Add the probability by region (T, R) in 255ths, and each vertex's region, 255 = none."""
    probability = np.nan_to_num(joint["contact_probability"])
    names = joint.text("region_names")
    region = np.full(model.num_vertices, 255, np.uint8)
    for number, name in enumerate(names):
        region[model.regions[name]] = number
    content.header["regions"] = [name.replace("_", " ") for name in names]
    content.arrays["contact/probability"] = np.rint(255 * probability).astype(np.uint8)
    content.arrays["contact/region"] = region


def _add_measured(content: Content, metrics: Path, num_vertices: int) -> Flags:
    """Add touching vertices as bits (T, ceil(V / 8)); return the flags."""
    with artefacts.read(metrics, METRICS) as measured:
        if "body_contact_distance" in measured:
            (_, measured_vertices), *_ = measured.describe("body_contact_distance")
            if measured_vertices != num_vertices:
                raise UserError(
                    f"{metrics}: sequence {measured.attributes['sequence']!r} was measured on a "
                    f"body of {measured_vertices} vertices, but its fitted body has "
                    f"{num_vertices}; re-run stage 'metrics'"
                )
            bits = [
                np.packbits(vertex_contact(distance), axis=1, bitorder="little")
                for distance in measured.blocks("body_contact_distance")
            ]
            content.arrays["contact/touching"] = np.concatenate(bits)
        return Flags.read(measured)


def _simplified(mesh: ObjectMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, faces and colours (Vo, 3) uint8 with at most MESH_FACES faces."""
    if len(mesh.faces) <= MESH_FACES:
        return mesh.vertices, mesh.faces, mesh.colours.astype(np.uint8)
    import open3d as o3d

    full = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces)
    )
    full.vertex_colors = o3d.utility.Vector3dVector(mesh.colours / 255.0)
    small = full.simplify_quadric_decimation(MESH_FACES)
    colours = np.rint(255 * np.clip(np.asarray(small.vertex_colors), 0, 1)).astype(np.uint8)
    return np.asarray(small.vertices), np.asarray(small.triangles), colours


def _add_body(content: Content, name: str, body: Fit, zup: np.ndarray) -> None:
    """Add a skinned body, with its transforms in the z-up frame, quantised for the viewer."""
    skin = skinned(body.model, body.parameters)
    transforms = np.einsum("ab,tjbc->tjac", zup[:3, :3], skin.transforms)
    transforms[..., 3] += zup[:3, 3]
    largest = np.abs(skin.modes).max((1, 2), initial=1e-9)
    content.arrays |= {
        f"{name}/rest": skin.rest.astype(np.float32),
        f"{name}/joints": skin.joints.astype(np.uint8),
        f"{name}/weights": np.rint(65535 * skin.weights).astype(np.uint16),
        f"{name}/transforms": transforms.astype(np.float32),
        f"{name}/modes": np.rint(skin.modes / largest[:, None, None] * 32767).astype(np.int16),
        f"{name}/amounts": (skin.amounts * (largest / 32767)).astype(np.float32),
    }
    content.header.setdefault("error_mm", {})[name] = round(1e3 * skin.error_m, 3)


def _add_poses(
    content: Content, name: str, rotation: np.ndarray, translation: np.ndarray, zup: np.ndarray
) -> None:
    """Add zup_from_object (T, 3, 4), NaN without a pose."""
    poses = zup @ rigid(rotation, translation)
    content.arrays[f"{name}/object"] = poses[:, :3].astype(np.float32)


def _add_cameras(content: Content, rig: Rig, zup: np.ndarray) -> None:
    """Add pose, focal lengths, centre and size of each camera with a known pose."""
    content.header["cameras"] = [
        {
            "name": camera.name,
            "pose": (zup @ camera.master_from_colour)[:3].round(6).tolist(),
            "focal": [camera.colour.fx, camera.colour.fy],
            "centre": [camera.colour.cx, camera.colour.cy],
            "size": [camera.colour.width, camera.colour.height],
        }
        for camera in rig
        if np.isfinite(camera.master_from_colour).all()
    ]


def _add_images(content: Content, images: Frames, rig: Rig, moments: np.ndarray) -> None:
    """Add concatenated undistorted images (WebP) of the frames ``moments``, and their offsets.

    They are ordered by frame, then by camera.
    """
    packets = []
    shown = [c for c, camera in enumerate(rig) if np.isfinite(camera.master_from_colour).all()]
    for t in moments:
        for c in shown:
            camera, packet = rig[c], b""
            lens = camera.colour.scaled(min(1.0, IMAGE_WIDTH / camera.colour.width))
            factors: tuple[Literal[1, 2, 4], ...] = (4, 2, 1)  # by which the decoder can reduce
            factor = next(f for f in factors if camera.colour.width >= f * lens.width)
            try:
                image = images.colour(int(t), c, factor)
            except UserError:  # the stages report images that do not decode
                image = None
            if image is not None:
                small = cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
                small = cv2.undistort(small, lens.matrix, lens.distortion)
                options = [cv2.IMWRITE_WEBP_QUALITY, 60]
                packet = cv2.imencode(".webp", small, options)[1].tobytes()
            packets.append(packet)
    starts = np.cumsum([0, *map(len, packets)]).astype(np.uint32)
    content.arrays["images/data"] = np.frombuffer(b"".join(packets), np.uint8)
    content.arrays["images/starts"] = starts


def _add_clouds(
    content: Content,
    clouds: SegmentedClouds,
    shown: Fit,
    mesh: ObjectMesh | None,
    moments: np.ndarray,
    zup: np.ndarray,
) -> None:
    """Add quantised points of person and object by frame, and the offset of each frame.

    At most 2500 points of the person and 800 of the object are drawn at random in each frame.
    """
    random = np.random.default_rng(0)
    parts: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for t in moments:
        with torch.no_grad():
            body = shown.model.forward(shown.parameters.frames(slice(int(t), int(t) + 1)))
        near = body.vertices[0, ::7].double().numpy()  # points far from the meshes are left out
        if mesh is not None and np.isfinite(shown.translation[t]).all():
            at = mesh.vertices @ shown.rotation[t].T + shown.translation[t]
            near = np.concatenate([near, at])
        for part, points, most in zip(parts, clouds.at(int(t), near), (2500, 800), strict=True):
            kept = points
            if len(points) > most:
                kept = points[np.sort(random.choice(len(points), most, replace=False))]
            part.append(apply(zup, kept.astype(np.float64)))
    for name, part in zip(("person", "object"), parts, strict=True):
        steps, low, step = quantised(np.concatenate(part))
        content.arrays[f"clouds/{name}"] = steps
        content.arrays[f"clouds/{name}_starts"] = np.cumsum([0, *map(len, part)]).astype(np.uint32)
        content.header.setdefault("clouds", {})[name] = {"low": low, "step": step}


def _add_truth(content: Content, true: Truth, zup: np.ndarray) -> None:
    """Add the true body in at most 60 frames, and the true object in all frames."""
    if true.vertices is not None:
        chosen = sample_evenly(np.ones(len(true.vertices), bool), 60)
        vertices = apply(zup, true.vertices[chosen].reshape(-1, 3).astype(np.float64))
        steps, low, step = quantised(vertices.reshape(len(chosen), -1, 3))
        # differences between frames compress to half the size of positions; they may wrap around
        moved = np.diff(steps, axis=0, prepend=np.zeros_like(steps[:1]))
        content.arrays["truth/vertices"] = moved
        content.header["truth"] = {"moments": chosen.tolist(), "low": low, "step": step}
        content.header["versions"]["truth"] = VERSIONS["truth"]
    if true.has_object and "truth" in content.header:
        content.arrays["truth/object_vertices"] = true.object_vertices.astype(np.float32)
        content.arrays["truth/object_faces"] = true.object_faces.astype(np.uint32)
        _add_poses(content, "truth", true.rotation, true.translation, zup)


def quantised(points: np.ndarray) -> tuple[np.ndarray, list[float], float]:
    """Quantise points (..., 3) to 16 bits: points = low + step * steps.

    Returns the steps (..., 3) uint16, ``low`` (3,) and ``step``, metres.
    """
    flat = points.reshape(-1, 3)
    low = flat.min(0) if len(flat) else np.zeros(3)
    extent = float((flat.max(0) - low).max()) if len(flat) else 1.0
    step = max(extent, 1e-6) / 65535
    return np.rint((points - low) / step).astype(np.uint16), low.tolist(), step
