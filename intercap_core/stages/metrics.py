"""Stage ``metrics``: distances between body, object and depth points, and errors against truth."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.joints import BODY_JOINTS
from intercap_core.config import MetricsSettings, digest
from intercap_core.evaluation import motion, object_pose
from intercap_core.evaluation import truth as truths
from intercap_core.evaluation.flags import exchanged
from intercap_core.evaluation.measurement import HandledObject, Measurement, Values
from intercap_core.evaluation.physics.judge import judge_physics
from intercap_core.evaluation.scene_errors import displacement
from intercap_core.evaluation.segmented import read_clouds
from intercap_core.evaluation.stage_errors import StageErrors
from intercap_core.evaluation.tracks import BodyTrack, read_body, read_object
from intercap_core.evaluation.verdict.hold_out import JudgedPart
from intercap_core.evaluation.verdict.judge import reach_verdict
from intercap_core.flags import OF_BODY, PARTS, Cause, Flags
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.memory import return_freed_memory
from intercap_core.schemas import (
    JOINT,
    METRICS,
    PERSON,
    SCENE,
)
from intercap_core.sequence_inputs import FitSettings, SequenceModels, SequencePaths

log = logging.getLogger(__name__)


def run(
    *,
    paths: SequencePaths,
    models: SequenceModels,
    fit_settings: FitSettings,
    settings: MetricsSettings,
    output: Path,
    truth: Path | None = None,
) -> None:
    """Measure the joint result of one sequence, estimate its error, test its physics, and compare
    all stages with truth.

    Object and contact metrics are omitted if the sequence has no object, or if the object was found
    in no frame. In the second case its errors against truth are infinite.

    Raises UserError if an input artefact is missing, broken or does not match the others.

    Args:
        fit_settings: settings of the fits, for the refits of the held-out evaluation.
        truth: truth file of a virtual recording; None = no truth.
    """
    body_track = read_body(paths.joint, "joint", models.body_models, models.gender)
    with (
        artefacts.read(paths.scene, SCENE) as setting,
        artefacts.read(paths.joint, JOINT) as fitted,
    ):
        made_by = {k: v for k, v in fitted.attributes.items() if k == "made_by"}
        rig = Rig.from_artefact(setting).moved(fitted["master_from_colour"])
    with artefacts.write(output, METRICS, settings_digest=digest(settings), **made_by) as writer:
        # Clouds and truth grow with the recording and are released before the verdict. Rig and body
        # are not: their cached ray tables are used again.
        values, flags, attributes = _measure(
            paths, models, settings, truth, rig, body_track, writer
        )
        writer.attributes.update(attributes)
        body_distance = values.pop("body_distance", None)
        for key in sorted(values):
            writer.put(key, values.pop(key))
        flags.write(writer)
        verdict: Values = {}
        # The error model of the verdict was fitted to results of this program, so imported results
        # have none.
        if settings.hold_out and not made_by:
            return_freed_memory()
            verdict |= reach_verdict(paths, models, fit_settings)
            for key, value in sorted(verdict.items()):
                writer.put(f"verdict/{key}", value)
        if body_distance is not None and models.object_ is not None:
            estimated = None
            if JudgedPart.OBJECT in verdict.get("part_names", ()):
                part = verdict["part_names"].index(JudgedPart.OBJECT)
                estimated = verdict["error_frame"][part]
            mesh = ObjectMesh.load(models.object_)
            physics, note = judge_physics(mesh, paths, body_distance, flags, estimated)
            for key, value in sorted(physics.items()):
                writer.put(f"physics/{key}", value)
            writer.attributes["physics_note"] = note


def _measure(
    paths: SequencePaths,
    models: SequenceModels,
    settings: MetricsSettings,
    truth: Path | None,
    rig: Rig,
    body_track: BodyTrack,
    writer: artefacts.Writer,
) -> tuple[Values, Flags, dict[str, object]]:
    """Datasets of the metrics artefact except the verdict, its flags and its attributes.

    Distances by vertex are not returned but appended to ``writer``. ``rig`` and ``body_track`` are
    those of the joint fit.
    """
    object_, body_models, gender = models.object_, models.body_models, models.gender
    mesh = None if object_ is None else ObjectMesh.load(object_)
    object_track = read_object(paths.joint, "joint")
    with (
        Frames.open(paths.frames) as recording,
        artefacts.read(paths.scene, SCENE) as setting,
        artefacts.read(paths.joint, JOINT) as fitted,
    ):
        images = recording.showing(setting["image_of"])
        clouds = read_clouds(
            images, rig, fitted["depth_bias"], setting["image_of"],
            detections=paths.detections, person=paths.person, object_track=paths.object_track,
        )  # fmt: skip
        known = None
        if truth is not None:
            vertices = body_track.model.num_vertices
            known = truths.Truth.load(truth, images.time_s, images.fps, vertices)
        handled = None
        if mesh is not None and object_track.known:
            handled = HandledObject(mesh, object_track)
        measured = Measurement(handled, body_track, clouds, rig, settings.contact_mm * 1e-3)
        ground = setting["ground_point"], setting["ground_normal"]
        values = measured.over_frames(ground, known, writer)
        true_distance, true_facing, facing = (
            values.pop(key, None) for key in ("true_distance", "true_facing", "facing")
        )
        _warn_of_foreign_truth(truth, values)
        values |= _motion(body_track, handled, images.fps)
        if handled is not None:
            values["contact_probability"] = fitted["contact_probability"]
        if known is not None:
            tracked = read_object(paths.object_track, "object_track")
            first_body = read_body(paths.body_fit, "body_fit", body_models, gender)
            errors = StageErrors(
                known, true_distance, true_facing, mesh, measured.threshold, images.fps
            )
            values |= errors.of_object("object_track", tracked)
            values |= errors.of_body("body_fit", first_body, tracked)
            values |= errors.of_object("joint", object_track)
            values |= errors.of_body("joint", body_track, object_track, facing)
            values |= errors.about_truth(body_track.model.regions) | _extrinsics_errors(
                setting, fitted["master_from_colour"], known
            )
        flags = _flags(images, paths, has_object=object_ is not None)
        return (
            values,
            flags,
            {
                "sequence": images.sequence,
                "subject": models.subject.subject,
                "object": object_.name if object_ else "",
                "fps": images.fps,
                "has_truth": known is not None,
            },
        )


def _motion(body_track: BodyTrack, handled: HandledObject | None, fps: float) -> Values:
    """Accelerations (T,) of the body's joints and of the object, metres per frame^2 at 30 fps."""
    joints = body_track.joints[:, BODY_JOINTS]
    values: Values = {"acceleration_body": motion.acceleration(joints, fps)}
    if handled is not None:
        track, point = handled.track, handled.mesh.centre_of_mass
        centre = object_pose.posed_point(track.rotation, track.translation, point)
        values["acceleration_object"] = motion.acceleration(centre[:, None], fps)
    return values


def _flags(images: Frames, paths: SequencePaths, *, has_object: bool) -> Flags:
    """Flags of the joint result, and those of missing images and of exchanged sides."""
    with artefacts.read(paths.person, PERSON) as artefact:
        missing = artefact["missing"]
    with artefacts.read(paths.joint, JOINT) as artefact:
        of_joint, joints = Flags.read(artefact), artefact["joints"]
    unseen = np.asarray(~images.available.any(1))
    swapped = exchanged(joints)
    text = "left and right of the {} may be exchanged: they jump there and back"
    causes: list[Cause] = [
        (unseen, "no images", PARTS),
        (missing & ~unseen, "person seen in fewer than two views, without depth", OF_BODY),
        (swapped["legs"], text.format("legs"), ["body"]),
        (swapped["arms"], text.format("arms"), OF_BODY),
    ]
    return Flags.of(len(joints), causes, has_object=has_object) | of_joint


def _extrinsics_errors(
    scene: artefacts.Artefact, refined: np.ndarray, truth: truths.Truth
) -> Values:
    """Displacement (C,) of the cameras from the truth: as given, after ``scene``, after ``joint``.

    See :func:`.scene_errors.displacement`. NaN for the master and absent cameras.

    Args:
        refined: (C, 4, 4) master-from-colour transforms of the joint fit.
    """
    names = scene.text("camera_names")
    if not set(names) <= set(truth.camera_names):
        return {}
    order = [truth.camera_names.index(name) for name in names]
    true = truth.master_from_colour[order]
    master = names.index(str(scene.attributes["master"]))
    counted = scene["present"] & (np.arange(len(names)) != master)
    return {
        f"truth/extrinsics_{when}": np.where(counted, displacement(poses, true, master), np.nan)
        for when, poses in (
            ("before", scene["master_from_colour_start"]),
            ("after", scene["master_from_colour"]),
            ("joint", refined),
        )
    }


def _warn_of_foreign_truth(path: Path | None, values: Values) -> None:
    """Warn if the true body and object are far from the segmented points.

    The truth is then probably of another recording. No error is raised, because a recording whose
    segmentation is wrong throughout looks the same and must remain in the figures.
    """
    keys = [f"truth/{name}_floor" for name in ("body", "object")]
    floor = [values[key] for key in keys if key in values]
    apart = [float(np.nanmedian(v)) for v in floor if np.isfinite(v).any()]
    if apart and min(apart) > 0.06:  # clothing, noise and occlusion leave some 10 mm
        log.warning(
            "%s: its body and object are at least %.0f mm from the segmented points; unless all "
            "detections are wrong, it is the truth of another recording",
            path,
            1e3 * min(apart),
        )
