"""The floor and the up direction of a recording, from all their sources."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig, ring_centre
from intercap_core.geometry.camera.transforms import apply
from intercap_core.scene.ground import (
    GroundPlane,
    annotated_ground,
    describe_raised_feet,
    fit_ground,
    fit_ground_to_feet,
    standing_on_floor,
    stated_ground,
)
from intercap_core.scene.subject_views import SubjectViews, triangulate_views
from intercap_core.scene.surfaces import BACKGROUND_CELL_M, DepthSurface
from intercap_core.scene.up import (
    ANNOTATED_POINT_M,
    FLOOR_DEG,
    FOOT_PLACE_M,
    STATED_DEG,
    UpDirection,
    balance_levels,
    camera_levels,
    compare_with_stated,
    estimate_up,
    floor_levels,
    rough_up,
)

_TOES_AND_HEELS = slice(19, 25)
AnnotatedFloor = Sequence[tuple[float, float, float]]  # points of the master's frame, metres


def floor_and_up(
    source: Frames,
    rig: Rig,
    ground: GroundPlane,
    subject: SubjectViews,
    floor: AnnotatedFloor | None,
) -> tuple[GroundPlane, UpDirection, list[str]]:
    """The floor, the up direction, and notes about the floor.

    A measured floor (``ground``) is kept. Otherwise it is the stated floor or, if the feet
    contradict that or none is stated, the floor under the feet. ``floor``: annotated floor points.
    """
    stated = source.stated_up, source.stated_floor
    middle = ring_centre(rig)
    if ground.found:
        off = FLOOR_DEG
        if floor is not None:
            levels = floor_levels(np.array(floor, np.float64), ANNOTATED_POINT_M)
            off = float(np.degrees(np.linalg.norm(levels[0].sigma))) if levels else np.nan
        up = UpDirection(ground.normal, "floor", off)
    else:
        joints = triangulate_views(subject.keypoints, rig).joints
        ground, up = floor_under_feet(rig, joints, source.gravity, source.stated_up)
        if np.isfinite(stated[1]).all():
            denied = ground.found and compare_with_stated(
                ground.point, ground.normal, *stated, middle
            )
            if not denied:
                ground = stated_ground(*stated)
                up = UpDirection(stated[0], "stated", STATED_DEG)
    notes = [ground.note]
    if ground.found and ground.source != "feet":
        notes.append(describe_raised_feet(subject.joints[:, _TOES_AND_HEELS], ground))
    if ground.found:
        notes += compare_with_stated(ground.point, ground.normal, *stated, middle)
    return ground, up, list(filter(None, notes))


def floor_under_feet(
    rig: Rig, joints: np.ndarray, gravity: np.ndarray, stated_up: np.ndarray | None = None
) -> tuple[GroundPlane, UpDirection]:
    """Floor under the feet of a person, and up direction without a measured floor.

    The up direction is the stated one, else that of all evidence together.

    Args:
        joints: (T, K, 3) of the person, master frame, metres; NaN = unknown.
        gravity: (C, 3) down in each colour camera; NaN = not measured.
        stated_up: (3,) up in the master's frame; None or NaN = not stated.
    """
    feet = joints[:, _TOES_AND_HEELS]
    up = rough_up(rig, gravity, stated_up)
    if up.source != "stated":
        standing, _ = standing_on_floor(feet, up.direction)
        evidence = [
            *camera_levels(rig, gravity),
            *floor_levels(standing, FOOT_PLACE_M),
            *balance_levels(joints),
        ]
        up = estimate_up(up, evidence)
    return fit_ground_to_feet(feet, up), up


def measured_floor(
    source: Frames,
    rig: Rig,
    surfaces: dict[int, DepthSurface],
    bias: np.ndarray,
    tolerance_m: float,
    floor: AnnotatedFloor | None,
) -> GroundPlane:
    """Fit the floor to the background, or to the annotated points if there are any.

    Args:
        surfaces: background of each camera, depth frame.
        bias: (C,) depth biases, metres.
        tolerance_m: largest distance of inliers, metres.
        floor: annotated points; None = not annotated.
    """
    points, normals = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for c, surface in surfaces.items():
        pose = rig[c].master_from_depth
        points.append(apply(pose, surface.points - bias[c] * surface.rays))
        normals.append(surface.normals @ pose[:3, :3].T)
    everything = np.concatenate(points)
    up = rough_up(rig, source.gravity, source.stated_up)
    if floor is not None:
        try:
            at = np.array(floor, np.float64)
            return annotated_ground(at, everything, up, tolerance_m=tolerance_m)
        except UserError as error:
            raise UserError(f"sequence {source.sequence}: {error}") from None
    return fit_ground(
        everything,
        np.concatenate(normals),
        rig,
        up,
        tolerance_m=tolerance_m,
        # Points of n cameras may overlap on one floor. Each therefore stands for 1 / n of a cell's
        # area, as if all cameras saw all of it.
        cell_m=BACKGROUND_CELL_M / np.sqrt(max(1, len(surfaces))),
    )
