"""Registration of placed cameras on everything at once: surfaces, joints and boards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from intercap_core.formats.detections.read import PeopleOfImages
from intercap_core.formats.recordings.frames import Frames
from intercap_core.scene.background import camera_background
from intercap_core.scene.constraints import BodyConstraint, body_views
from intercap_core.scene.moments import find_moments
from intercap_core.scene.registration import (
    MOVING,
    STATIC,
    Constraint,
    Registration,
    RigEstimate,
)
from intercap_core.scene.surfaces import background_surfaces, moving_surfaces

# Standard deviations of the placed cameras' rotations, rad, and translations, metres: twice the
# errors of cameras placed by lifted joints, so that the surfaces decide.
PRIOR = (np.radians(2.0), 0.05)
SHARED_ERRORS = 3.0  # factor on the variance, as in stage `scene`: points of a surface err together


@dataclass(frozen=True, eq=False)
class Refined:
    """Result of the registration."""

    poses: np.ndarray
    """(C, 4, 4) master_from_colour."""
    covariance: np.ndarray
    """(C, 6, C, 6) of rotations about the cameras' centres and translations; 0 = fixed."""
    surfaces_mm: tuple[float, float]
    """Mean over pairs of cameras of the median distance of held-out points, before and after."""
    background_m: dict[tuple[int, int], float]
    """Median distance of held-out points of the background by pair (a, b), a < b, metres."""


def refine_on_surfaces(
    frames: Frames, people: PeopleOfImages, master: int, terms: Sequence[Constraint]
) -> Refined | None:
    """Refine the poses of the cameras of ``frames`` on surfaces, joints and further ``terms``.

    Returns None if no two cameras share a surface, or if held-out points of the surfaces do not get
    nearer to each other.
    """
    rig, last = frames.rig, frames.num_sets - 1
    moments = find_moments(people, rig, frames.time_s, frames.fps, frames.available, master=master)
    moment = np.clip(np.arange(frames.num_sets)[:, None] - moments.slip, 0, last)
    backgrounds = [
        camera_background(frames, c, moments.subject.joints[moment[:, c]]) for c in range(len(rig))
    ]
    moving = moving_surfaces(frames, rig, moments.image_of, backgrounds)
    layers = {STATIC: [background_surfaces(rig, backgrounds)], MOVING: moving}
    registration = Registration(rig, layers, master, moments.starts.offset_sigma, PRIOR)
    start = RigEstimate.start(rig, moments.starts.offset)
    views = body_views(moments.subject, frames.time_s)
    body = [BodyConstraint(views, rig)] if views.suffice else []
    timing = moments.timing.information, moments.timing.vector
    given = registration.solve(start, (), timing, free_poses=False).estimate
    found = registration.solve(start, [*body, *terms], timing)

    def distance_mm(at: RigEstimate) -> float:
        kinds = [registration.median_residuals(at, kind).values() for kind in (STATIC, MOVING)]
        medians = [1e3 * median for kind in kinds for median in kind]
        return float(np.mean(medians)) if medians else float("nan")

    before, after = distance_mm(given), distance_mm(found.estimate)
    if not after < before:
        return None
    covariance = SHARED_ERRORS * found.covariance[:, :6, :, :6]
    background = registration.median_residuals(found.estimate, STATIC)
    return Refined(
        found.estimate.poses,
        covariance,
        (before, after),
        {(min(pair), max(pair)): median for pair, median in background.items()},
    )
