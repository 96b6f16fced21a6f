"""Fit of the object's pose in one frame, started by the annotator, and 3D points at pixels."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.annotate.opened import Opened
from intercap_core.annotation import ObjectPose
from intercap_core.config import ObjectTrackSettings
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.geometry.camera.clouds import master_points
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import Renderer
from intercap_core.geometry.solve.thread_pool import threads_of_job
from intercap_core.object_track.fit import FittedPose, MotionPrior, assess_all, fit_pose
from intercap_core.object_track.likelihood import SEEN_LOG_RATIO
from intercap_core.object_track.recording import TRACKING_FACES, ObjectRecording
from intercap_core.object_track.view import FitContext, View
from intercap_core.schemas import SCENE

NEEDED = ("frames", "detections", "scene", "person")


def snap(opened: Opened, entry: ObjectEntry, pose: ObjectPose) -> dict[str, Any]:
    """Fit the object's pose in a frame to depth and masks of all views, from this start.

    Returns, for JSON:
        ``rotation_vector``, ``translation``: master_from_object, radians and metres.
        ``overlap``: mean IoU over the ``views`` (number) that show the object.
        ``seen``: the images support the pose.
        ``moved_m``, ``turned_rad``: difference to the start.

    Raises UserError if a result of an earlier stage is missing.
    """
    missing = [stage for stage in NEEDED if not opened.has(stage)]
    if missing:
        raise UserError(f"a fit to the images needs stage {missing[0]!r}; run it first")
    settings = opened.project.config.object_track
    rotation = Rotation.from_rotvec(pose.rotation_vector).as_matrix()
    start = rigid(rotation, np.array(pose.translation))
    with opened.images(by_set=True) as images:
        mesh = opened.cached("mesh", (), lambda: ObjectMesh.load(entry).simplified(TRACKING_FACES))
        detected = opened.cached(
            "detections", ("detections",), lambda: Detections.load(opened.paths["detections"])
        )
        source = opened.cached(
            "recording",
            NEEDED,
            lambda: ObjectRecording(
                images, detected, opened.paths["scene"], opened.paths["person"], mesh.diameter
            ),
        )
        views = source.views(pose.frame)
    fit = _fitted(mesh, views, start, settings, entry.labels)
    turned = Rotation.from_matrix(fit.pose[:3, :3] @ start[:3, :3].T).magnitude()
    middle = mesh.centre_at(fit.pose) - mesh.centre_at(start)
    return {
        "rotation_vector": Rotation.from_matrix(fit.pose[:3, :3]).as_rotvec().round(6).tolist(),
        "translation": fit.pose[:3, 3].round(5).tolist(),
        "overlap": round(fit.mean_overlap, 3),
        "views": fit.support,
        "seen": bool(fit.log_ratio > SEEN_LOG_RATIO),
        "moved_m": round(float(np.linalg.norm(middle)), 5),
        "turned_rad": round(float(turned), 5),
    }


def _fitted(
    mesh: ObjectMesh,
    views: list[View],
    start: np.ndarray,
    settings: ObjectTrackSettings,
    labels: tuple[str, ...],
) -> FittedPose:
    """Fit from ``start`` (4, 4); if the images do not support the result, also from shifted starts.

    The shifts are 0.35, 0.7 and 1.2 diameters of the mesh in the 26 directions of a cube's faces,
    edges and corners. The four most likely of these starts are fitted. Returns the most likely fit.
    """
    context = FitContext(
        mesh, labels, settings.min_overlap, settings.background_term, Renderer(threads_of_job())
    )

    def fitted(pose: np.ndarray) -> FittedPose:
        return fit_pose(context, views, pose, prior=MotionPrior(pose))

    best = fitted(start)
    if best.log_ratio > SEEN_LOG_RATIO:
        return best
    steps = np.array(list(itertools.product((-1, 0, 1), repeat=3)), float)
    steps = steps[np.abs(steps).sum(1) > 0]
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    shifts = np.concatenate([mesh.diameter * distance * steps for distance in (0.35, 0.7, 1.2)])
    around = np.repeat(start[None], len(shifts), 0)
    around[:, :3, 3] += shifts
    assessed = assess_all(context, views, around)
    most_likely = np.argsort([-fit.log_ratio for fit in assessed], kind="stable")[:4]
    fits = [best, *(fitted(around[k]) for k in most_likely)]
    return max(fits, key=lambda fit: fit.log_ratio)


def point_under(opened: Opened, camera: str, frame: int, x: float, y: float) -> list[float]:
    """Return the point (3,), master frame, metres, at a pixel of the colour image as recorded.

    It is measured by depth, or else the ray is intersected with the floor. Raises UserError if
    neither is possible.
    """
    with opened.images() as images:
        rig = images.rig
        bias = np.zeros(len(rig))
        normal = point = np.full(3, np.nan)
        if opened.has("scene"):
            with artefacts.read(opened.paths["scene"], SCENE) as scene:
                rig, bias = Rig.from_artefact(scene), scene["depth_bias"]
                normal, point = scene["ground_normal"], scene["ground_point"]
        if camera not in rig.names:
            raise UserError(f"there is no camera {camera!r}; expected one of {rig.names}")
        c = rig.names.index(camera)
        lens, pixel = rig[c].colour, np.array([x, y])
        depth = images.depth(frame, c) if rig[c].depth is not None else None
    if not (0 <= x < lens.width and 0 <= y < lens.height):
        raise UserError(f"x {x:g}, y {y:g} is outside of the image of camera {camera}")
    if not np.isfinite(rig[c].master_from_colour).all():
        raise UserError(f"camera {camera}: its pose is unknown, so no point can be placed with it")
    if depth is not None:
        points = master_points(depth, rig[c]).points.astype(np.float64)
        seen = apply(rig[c].colour_from_master, points)
        away = np.linalg.norm(lens.project(seen) - pixel, axis=1)
        # measured points within 5 pixels of the click
        near = np.flatnonzero((away < 5.0) & lens.inside_model(seen))
        if len(near):
            ahead = seen[near, 2]
            kept = near[ahead < ahead.min() + 0.03]  # points within 30 mm are one surface
            middle = np.median(seen[kept], axis=0)
            # subtract the depth bias along the ray
            middle *= 1 - float(np.nan_to_num(bias[c])) / middle[2]
            return apply(rig[c].master_from_colour, middle[None])[0].round(4).tolist()
    ray = rig[c].master_from_colour[:3, :3] @ lens.unproject(pixel)
    origin = rig[c].master_from_colour[:3, 3]
    along = float(normal @ ray)
    if np.isfinite(along) and abs(along) > 1e-6:
        far = float(normal @ (point - origin)) / along
        if far > 0:
            return (origin + far * ray).round(4).tolist()
    raise UserError(
        f"camera {camera} has no depth at this pixel of frame {frame}; click next to it, or use "
        "another camera"
    )
