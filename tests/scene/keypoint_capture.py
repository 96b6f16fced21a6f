"""Studio captures of which only the keypoints are made: no image, no file.

Motion, exposure times, lenses, poses and detector errors are the studio's own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d

from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.scene.subject_views import find_subject_views
from intercap_core.studio.hands import part_of
from intercap_core.studio.interactions import interaction_named
from intercap_core.studio.keypoints import Detector
from intercap_core.studio.recording import COVER_M, Kinect
from intercap_core.studio.render import scene_of
from intercap_core.studio.skeleton import local_rotations
from intercap_core.studio.stage import StudioStage
from tests.helpers.fitted_capture import object_entry
from tests.helpers.synthetic_people import DelayedPeople

COVER_EVERY_S = 0.2  # interval at which occlusion is computed


@dataclass(frozen=True)
class KeypointCapture:
    """``people[t][c]`` lists the image's people (135, 3), None if the set has no image; ``rig``
    as claimed, ``true`` as it is; ``times`` (T,) s; true ``offset`` (C,) s and ``slip`` (T, C)."""

    people: list[list[list[np.ndarray] | None]]
    rig: Rig
    true: Rig
    times: np.ndarray
    fps: float
    offset: np.ndarray
    slip: np.ndarray


def keypoint_capture(
    interaction: str,
    *,
    seed: int,
    frames: int = 45,
    fps: int = 15,
    noise: float = 1.0,
    family: str = "a",
    slips: str = "silent",
    cameras: int = 6,
    subject: str = "s05",
) -> KeypointCapture:
    """Make one capture; the same arguments give the same numbers."""
    capture = StudioCapture(interaction=interaction, subject=subject, seed=seed, frames=frames)
    settings = StudioSettings.model_validate(
        dict(captures={}, fps=fps, noise=noise, noise_family=family, cameras=cameras, slips=slips)
    )
    stage = StudioStage(
        capture, settings, object_entry(interaction_named(interaction).object_class)
    )
    detector = Detector.build(stage.noise, stage.frames)
    kinects = [Kinect(stage, index, settings.colour_mode) for index in range(cameras)]
    shown = [_points(stage, kinect.exposures) for kinect in kinects]
    hidden = _hidden(stage, [points for points, _ in shown])
    turned = stage.rig.master_from_stage[:3, :3]
    people: list[list[list[np.ndarray] | None]] = [[None] * cameras for _ in range(frames)]
    for c, (kinect, (points, pelvis)) in enumerate(zip(kinects, shown, strict=True)):
        in_master = stage.to_master(points)
        subject_points = detector.detect(
            kinect.true, in_master, turned @ pelvis, hidden[c], np.zeros((len(in_master), 2), bool)
        )
        found = detector.people(kinect.true, subject_points)
        for t in kinect.sets:
            people[t][c] = found[t]
    offset = np.array([k.exposures[0] + k.stage.rig.slip[0, k.index] / fps for k in kinects])
    rig = stage.rig
    return KeypointCapture(
        people, rig.claimed, rig.true, stage.set_times, fps, offset - offset[0], rig.slip
    )


def _points(stage: StudioStage, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The true keypoints (N, 135, 3) and pelvis rotations (N, 3, 3) in the stage at recording
    ``times`` (N,); flesh is not pressed in."""
    chart, subject = stage.fitted.keypoint_map, stage.subject
    corners = subject.faces[subject.fitted_face[chart.vertex_ids]]
    ids, place = np.unique(corners, return_inverse=True)
    played = stage.interaction.perform(stage.interaction.script_times(times, stage.duration))
    turned = stage.stage_from_script[:3, :3]
    world = turned @ played.world
    pelvis = apply(stage.stage_from_script, played.pelvis)
    posed = part_of(subject, ids).skin(local_rotations(world), pelvis - subject.rest_joints[0])
    seen = np.einsum(
        "nvkc,vk->nvc",
        posed.vertices[:, place.reshape(corners.shape)],
        subject.fitted_bary[chart.vertex_ids],
    )
    return chart.matrix @ np.concatenate([seen, posed.joints], 1), world[:, 0]


def _hidden(stage: StudioStage, points: list[np.ndarray]) -> np.ndarray:
    """Mask (C, T, 135) of occluded keypoints, from ``points`` (T, 135, 3) of each view."""
    cover = np.full(135, COVER_M["body"])
    cover[25:67], cover[67:] = COVER_M["hand"], COVER_M["face"]
    cover[[0, 15, 16, 17, 18]] = COVER_M["face"] * 2
    every = max(1, round(COVER_EVERY_S * stage.fps))
    looked = np.arange(0, stage.frames, every)
    moments = stage.at(stage.set_times[looked])
    eyes = apply(invert(stage.rig.master_from_stage), stage.rig.true.master_from_colour[:, :3, 3])
    hidden = np.zeros((len(points), stage.frames, 135), bool)
    for n, t in enumerate(looked):
        pose, prop = moments.stage_from_object[n], stage.prop
        scene = scene_of(
            (moments.clothed[n], stage.subject.faces),
            (apply(pose, prop.vertices), prop.faces),
            (stage.room.vertices, stage.room.faces),
        )
        for c, eye in enumerate(eyes):
            way = points[c][t] - eye
            rays = np.concatenate([np.broadcast_to(eye, way.shape), way], 1).astype(np.float32)
            hit = scene.cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()
            distance = np.linalg.norm(way, axis=1)
            hidden[c, t : t + every] = hit * distance < distance - cover
    return hidden


def subject_keypoints(capture: KeypointCapture) -> np.ndarray:
    """The subject's keypoints (T, C, 135, 3) as the scene stage finds them; 0 = not seen."""
    people = DelayedPeople(capture.people, np.zeros(len(capture.rig), int))
    return find_subject_views(people, capture.rig, capture.times).keypoints
