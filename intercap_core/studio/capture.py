"""Make one virtual capture: recordings, detections, calibration, truth and annotation.

Parameters named ``moment`` hold the true state at the T set times (:class:`.stage.StageState`).
The annotation has the errors that a person makes.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import rotation_exp, rotation_log
from intercap_core.geometry.rigid.open3d_core import o3d
from intercap_core.geometry.solve.time_series import runs
from intercap_core.inputs.documents import dump_yaml
from intercap_core.progress import Progress
from intercap_core.schemas import CONTACT_M, CONTACT_REGIONS, TRUTH
from intercap_core.studio.hand_held import CarriedKinect, write_walk_truth
from intercap_core.studio.keypoints import Detector
from intercap_core.studio.layouts import FOLDERS
from intercap_core.studio.masks import MaskSimulator
from intercap_core.studio.measured_detector import MeasuredDetector
from intercap_core.studio.recording import CameraRecord, Kinect
from intercap_core.studio.render import scene_of
from intercap_core.studio.rig import STAGGER_S
from intercap_core.studio.skeleton import unit
from intercap_core.studio.stage import StageState, StudioStage


def write_truth(
    path: Path,
    stage: StudioStage,
    moment: StageState,
    sequence: str,
    capture: StudioCapture,
    recorded: Sequence[CameraRecord],
) -> np.ndarray:
    """Write the truth artefact; ``moment`` is the state of the stage at the times of the T sets.

    Returns the true contact (T, R) of the object with each region of the body.
    """
    rig = stage.rig
    master = rig.master_from_stage
    pose = master @ moment.stage_from_object
    contact = region_contact(stage, moment)
    body_visible, object_visible = visible(stage, moment)
    seen = np.stack([camera.object_pixels for camera in recorded], 1)
    whole = np.stack([camera.object_whole for camera in recorded], 1)
    # a view sees the object if it shows at least 40 pixels and 5 % of it
    views = (seen >= 40) & (seen >= 0.05 * np.maximum(whole, 1))
    normal, broken = master[:3, 2], stage.failures.broken  # the stage's z axis
    with artefacts.write(
        path,
        TRUTH,
        sequence=sequence,
        interaction=capture.interaction,
        subject=capture.subject,
        object=stage.prop.name,
        ground_offset=float(-normal @ master[:3, 3]),
        fps=float(stage.fps),
        room=stage.furnishing,
        faults=", ".join(
            # with the name of the camera if the fault concerns one
            f"{kind} {rig.true.names[broken[kind]]}" if kind in broken else kind
            for kind in capture.faults
        ),
    ) as file:
        if stage.passer_by:
            file.attributes["passer_by"] = stage.passer_by.subject.name
        if stage.subject.sole_m:
            file.attributes["sole_m"] = stage.subject.sole_m
        file.put("times", stage.set_times)
        file.put("body_vertices", stage.to_master(moment.body))
        file.put("body_faces", stage.subject.faces)
        file.put("correspondence_face", stage.subject.fitted_face)
        file.put("correspondence_weights", stage.subject.fitted_bary)
        file.put("joints", stage.to_master(moment.joints))
        file.put("fingertips", stage.to_master(moment.tips))
        if stage.prop:
            file.put("object_vertices", stage.prop.vertices)
            file.put("object_faces", stage.prop.faces)
            file.put("rotation", pose[:, :3, :3])
            file.put("translation", pose[:, :3, 3])
            file.put("object_views", views.sum(1))
        file.put("region_names", CONTACT_REGIONS)
        file.put("region_contact", contact)
        file.put("camera_names", rig.true.names)
        file.put("master_from_colour", rig.true.master_from_colour)
        file.put("time_offset", rig.offset_s + STAGGER_S * np.arange(len(rig.offset_s)))
        file.put("slip", rig.slip)
        file.put("recorded", np.stack([camera.colour for camera in recorded], 1))
        file.put("depth_bias", [camera.depth_bias for camera in recorded])
        file.put("depth_recorded", np.stack([camera.depth for camera in recorded], 1))
        file.put("ground_normal", normal)
        if stage.interaction.leaves_floor:
            file.put("support_height", support_height(stage, moment))
        file.put("body_visible", body_visible)
        if stage.prop:
            file.put("object_visible", object_visible)
    return contact


def region_contact(stage: StudioStage, moment: StageState) -> np.ndarray:
    """Mask (T, R): a point of the region's skin is within ``CONTACT_M`` of the object."""
    regions = stage.fitted.regions
    result = np.zeros((len(moment.body), len(CONTACT_REGIONS)), bool)
    if not stage.prop:
        return result
    for t, pose in enumerate(moment.stage_from_object):
        points = stage.subject.on_fitted_topology(moment.body[t : t + 1])[0]
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        near = ((local > stage.bounds[0] - 0.01) & (local < stage.bounds[1] + 0.01)).all(1)
        touching = np.zeros(len(points), bool)
        touching[near] = stage.prop.surface.signed_distance(local[near]) <= CONTACT_M
        result[t] = [touching[regions[name]].any() for name in CONTACT_REGIONS]
    return result


def support_height(stage: StudioStage, moment: StageState) -> np.ndarray:
    """Height (T, 2), metres, of the room's highest surface below the left and the right sole.

    Rays go down from 3 cm above the skin of the foot.
    """
    room, regions = stage.room, stage.fitted.regions
    scene = scene_of((room.vertices, room.faces))
    result = np.zeros((len(moment.body), 2))
    for t, points in enumerate(stage.subject.on_fitted_topology(moment.body)):
        for side, foot in enumerate(("left_foot", "right_foot")):
            start = points[regions[foot]] + (0, 0, 0.03)
            down = np.broadcast_to([0.0, 0.0, -1.0], start.shape)
            rays = np.concatenate([start, down], 1).astype(np.float32)
            far = scene.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
            result[t, side] = (start[:, 2] - far).max()
    return result


def visible(stage: StudioStage, moment: StageState) -> tuple[np.ndarray, np.ndarray]:
    """Masks of body vertices (T, V), clothed, and object vertices (T, Vo) that any camera sees.

    A vertex is visible if it faces the camera, is in its image, and nothing occludes the ray.
    """
    prop, faces = stage.prop, stage.subject.faces
    count = moment.clothed.shape[1]
    result = np.zeros((len(moment.clothed), count + len(prop.vertices)), bool)
    stage_from_master = np.linalg.inv(stage.rig.master_from_stage)
    passing = stage.passer_by.at(stage.set_times) if stage.passer_by else None
    for t, pose in enumerate(moment.stage_from_object):
        moved = prop.vertices @ pose[:3, :3].T + pose[:3, 3]
        drawn = [(moved, prop.faces)] if prop else []
        points = np.concatenate([moment.clothed[t], moved])
        normals = np.concatenate(
            [stage.subject.normals(moment.clothed[t][None])[0],
             stage.prop_normals @ pose[:3, :3].T]
        )  # fmt: skip
        room = stage.room
        if passing and passing.present[t]:
            drawn.append((passing.clothed[t], faces))
        scene = scene_of((moment.clothed[t], faces), *drawn, (room.vertices, room.faces))
        for camera in stage.rig.true:
            place = stage_from_master @ camera.master_from_colour
            to_eye = place[:3, 3] - points
            ids = np.flatnonzero(~result[t] & ((to_eye * normals).sum(1) > 0))
            local = (points[ids] - place[:3, 3]) @ place[:3, :3]
            ids = ids[np.asarray(camera.colour.sees(local))]
            start = points[ids] + 0.001 * normals[ids]
            rays = np.concatenate([start, place[:3, 3] - start], 1).astype(np.float32)
            hidden = scene.test_occlusions(o3d.core.Tensor.from_numpy(rays), tnear=0.0, tfar=1.0)
            result[t, ids] = ~hidden.numpy()
    return result[:, :count], result[:, count:]


def erring_annotation(
    stage: StudioStage, moment: StageState, contact: np.ndarray
) -> dict[str, Any]:
    """An annotation with the errors of a person who annotates.

    Contact intervals are off by up to 5 frames, the object's pose by 10 mm and 5 degrees, and
    points on the floor by 10 mm; noise below 1 scales these limits.
    """
    rng, scale = stage.noise.rng("annotation"), min(stage.noise.scale, 1.0)

    def off(size: float) -> np.ndarray:
        return unit(rng.normal(size=3)) * rng.uniform(0, size) * scale

    intervals = []
    for region, name in enumerate(CONTACT_REGIONS):
        for start, end in runs(contact[:, region]):
            reach = round(5 * scale)
            first = int(np.clip(start + rng.integers(-reach, reach + 1), 0, stage.frames - 1))
            last = int(np.clip(end + 1 + rng.integers(-reach, reach + 1), first + 1, stage.frames))
            interval = {"part": name, "start": first, "end": last, "uncertain": "both"}
            intervals.append(interval)
    frame = int(rng.integers(0, max(1, stage.frames // 5)))
    pose = stage.rig.master_from_stage @ moment.stage_from_object[frame]
    rotation = rotation_exp(np.radians(off(5.0))) @ pose[:3, :3]
    floor = []
    for angle in np.arange(4) * np.pi / 2 + rng.uniform(0, 1):
        point = np.array([1.2 * np.cos(angle), 1.2 * np.sin(angle), 0.0])
        floor.append((stage.to_master(point) + off(0.010)).round(5).tolist())
    if not stage.prop:
        return {"floor": floor}
    return {
        "contact": intervals,
        "object_pose": {
            "frame": frame,
            "rotation_vector": rotation_log(rotation).round(6).tolist(),
            "translation": (pose[:3, 3] + off(0.010)).round(6).tolist(),
        },
        "floor": floor,
    }


def erring_starts(stage: StudioStage, sigma: float) -> dict[str, Any]:
    """Stated times of the cameras' first images, with errors of ``sigma`` seconds."""
    rng = stage.noise.rng("stated starts")
    clock = float(rng.uniform(0, 86_400))
    starts = {}
    for c, name in enumerate(stage.rig.true.names):
        lost = stage.rig.missing[c]
        first = min(t for t in range(0, stage.frames, stage.every[c]) if t not in lost)
        taken = stage.set_times[first] - stage.rig.late_s[c]
        starts[name] = round(clock + float(taken + rng.normal(0, sigma)), 4)
    return {"starts": starts, "starts_sigma": max(sigma, 0.001)}


log = logging.getLogger(__name__)

MANIFEST = "capture.json"
MARK = ".virtual"  # marks a folder that the studio may delete


def make_capture(
    capture: StudioCapture,
    settings: StudioSettings,
    *,
    sequence: str,
    objects: ObjectEntry | None,
    output: Path,
) -> None:
    """Write the folder of one capture; equal arguments give equal bytes.

    Writes recordings and calibration in the layout of ``capture`` and truth.h5; keypoints and
    candidates unless the camera is hand-held. Writes annotation.yaml if the capture annotates or
    states starts, and last capture.json with the SHA-256 of every file.

    Args:
        objects: entry of the tracked object, None for a person alone.

    Raises:
        UserError: for a subject, interaction, object or fault that the studio does not have, and if
            ``output`` holds other files.
    """
    output = Path(output)
    if output.exists():
        ours = (output / MANIFEST).is_file() or (output / MARK).is_file()
        if not ours and any(output.iterdir()):
            raise UserError(
                f"{output}: is not empty and was not made by the studio; choose another folder, or "
                "delete it"
            )
        shutil.rmtree(output)
    output.mkdir(parents=True)
    (output / MARK).touch()
    stage = StudioStage(capture, settings, objects)
    folder = FOLDERS[capture.layout](output, capture, stage.failures.broken)
    if capture.camera == "hand_held":
        poses = CarriedKinect(stage, 0, settings.colour_mode).record_walk(folder)
        folder.write_calibration(stage.rig.claimed, settings.fps)
        write_walk_truth(output / "truth.h5", stage, poses, sequence, capture.interaction)
        _write_manifest(output, sequence)
        return
    kind = Detector if capture.keypoints == "simulated" else MeasuredDetector
    detector = kind.build(stage.noise, stage.frames, capture.keypoint_bias)
    segmenter = MaskSimulator(
        stage.noise, stage.frames, stage.prop.name, passer_by=stage.passer_by is not None
    )
    recorded = []
    progress = Progress(log, "recorded", len(stage.rig.true), "cameras")
    for index in range(len(stage.rig.true)):
        kinect = Kinect(stage, index, settings.colour_mode)
        recorded.append(kinect.record(folder, detector, segmenter))
        progress.step()
    folder.write_calibration(stage.rig.claimed, settings.fps)
    moment = stage.at(stage.set_times)
    contact = write_truth(output / "truth.h5", stage, moment, sequence, capture, recorded)
    annotation = erring_annotation(stage, moment, contact) if capture.annotate else {}
    if capture.states_starts is not None:
        annotation |= erring_starts(stage, capture.states_starts)
    if annotation:
        text = dump_yaml(annotation, sort_keys=True)
        (output / "annotation.yaml").write_text(text)
    _write_manifest(output, sequence)


def _write_manifest(folder: Path, sequence: str) -> None:
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.name not in (MANIFEST, MARK))
    digests = {}
    for path in files:
        with open(path, "rb") as handle:
            digest = hashlib.file_digest(handle, "sha256").hexdigest()
        digests[path.relative_to(folder).as_posix()] = digest
    content = {"sequence": sequence, "files": digests}
    temporary = folder / f".{MANIFEST}.part"
    temporary.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")
    temporary.replace(folder / MANIFEST)
