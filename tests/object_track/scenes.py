"""Views, observers and tracks of captures, and small changes of poses."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.given_poses import GivenPose
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.tracker import Track, Tracker
from intercap_core.object_track.view import View, ViewGeometry
from tests.geometry.rigid.conftest import catalogue
from tests.helpers.object_capture import ObjectCapture

FIVE_DEGREES = float(np.radians(5))


def mesh_of(name: str) -> ObjectMesh:
    return ObjectMesh.load(catalogue()[name]).simplified(600)


def views_of(
    capture: ObjectCapture, t: int, blank: Collection[int] = (), timed: bool = True
) -> list[View]:
    """Views of frame t. In ``blank`` frames there is no depth and no detector."""
    views = []
    for c, camera in enumerate(capture.rig):
        depth, person, candidates = capture.image(t, c)
        late = float(capture.time_offset[c]) if timed else 0.0
        geometry = ViewGeometry.for_object(camera, capture.mesh.diameter, 2.5, time_offset_s=late)
        if t in blank:
            depth, candidates = np.zeros_like(depth), []
        masks = [(index, label, rle) for index, label, _, rle in candidates]
        views.append(View.build(geometry, depth, person, masks, t not in blank))
    return views


def images_of(
    capture: ObjectCapture, blank: Collection[int] = (), timed: bool = True
) -> list[list[View]]:
    return [views_of(capture, t, blank, timed) for t in range(len(capture.poses))]


def observer_of(
    capture: ObjectCapture, images: Sequence[list[View]] | None = None, **options: Any
) -> Observer:
    images = images_of(capture) if images is None else images
    labels = [[[k.label for k in view.candidates] for view in views] for views in images]
    given = {
        "mesh": capture.mesh,
        "times": capture.times,
        "joints": np.full((len(images), 135, 3), np.nan),
        "labels": (capture.label,),
        "up": capture.master_from_room[:3, 2],
    }
    return Observer(
        views=images.__getitem__, labels_by_view=labels, settings=ObjectTrackSettings(),
        **(given | options),
    )  # fmt: skip


def track_of(
    capture: ObjectCapture,
    *given: GivenPose,
    images: Sequence[list[View]] | None = None,
    **options: Any,
) -> Track:
    return Tracker(observer_of(capture, images, **options)).run(given)


def annotate(frame: int, pose: np.ndarray) -> GivenPose:
    """An annotated pose with standard deviations of 1 cm and 5 degrees."""
    return GivenPose(frame, pose, 0.01, FIVE_DEGREES)


def disturb(pose: np.ndarray, seed: int, metres: float = 0.01, degrees: float = 5.0) -> np.ndarray:
    """Move and turn a pose (4, 4) in a random direction."""
    axis, shift = np.random.default_rng(seed).normal(size=(2, 3))
    result = pose.copy()
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    result[:3, :3] = turn @ pose[:3, :3]
    result[:3, 3] += metres * shift / np.linalg.norm(shift)
    return result


def errors_of(mesh: ObjectMesh, track: Track, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (T,) of the centres, metres, and turns (T,), degrees, from the true poses."""
    found = np.array([frame.fit.pose for frame in track.frames])
    shift = np.array(
        [mesh.centre_at(a) - mesh.centre_at(b) for a, b in zip(found, poses, strict=True)]
    )
    turn = mesh.symmetry.rotation_error_deg(found[:, :3, :3], poses[:, :3, :3])
    return np.linalg.norm(shift, axis=1), turn


def frames_with(track: Track, flag: str) -> list[int]:
    return [t for t, frame in enumerate(track.frames) if getattr(frame, flag)]


class Still(ObjectCapture):
    """An object at rest."""

    def pose_at(self, t: float) -> np.ndarray:
        return super().pose_at(0.0)
